"""The printer's own probe as a scanner: an emulated printer touches what it has printed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from probe_job import plate, standing

from amrepair.cli import main
from amrepair.loop import Stop
from amrepair.loop.probing import PortFeeler, ProbeScanner
from amrepair.loop.travel import park
from amrepair.scans import ScanRequest
from amrepair.simulate.run import PreparedRun
from gcode.errors import PrinterError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts.serial import SerialPrinter
from gcode.resumption.head import state_at_rest

LAYER = 9


@pytest.fixture(scope="module")
def run() -> PreparedRun:
    return plate()


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("part") / "plate.stl"
    trimesh.creation.box(extents=(24.0, 18.0, 2.0)).export(path)
    return path


def stop_of(run: PreparedRun) -> Stop:
    layer = run.job.layers[LAYER]
    return Stop(LAYER, layer.end_line, layer.z_mm)


def amrepair(
    words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["amrepair", *words.split()])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr()
    return int(end.value.code or 0), said.out, said.err


def test_a_void_is_touched_found_and_filled(
    part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A void of some 10 mm³ in two layers, by at most sixty touches a look; then replayed."""
    words = (
        f"simulate {part} --printer generic_marlin --scanner probe --seed 1 "
        f"--defect void:diameter=7,layers=2 --out {tmp_path} --json"
    )
    code, out, _ = amrepair(words, monkeypatch, capsys)
    result = json.loads(out)
    (truth,) = result["truth"]
    assert code == 0
    assert 5.0 < truth["missing_mm3"] < 16.0
    assert result["iterations"] >= 1
    assert result["repaired_ratio"] > 0.6
    assert truth["added_mm3"] < 0.1 * truth["missing_mm3"]
    looks = result["touches"]
    assert len(looks) == len(result["stops"])
    assert looks[0]["off"] > 3
    assert all(4 <= look["touches"] <= 60 for look in looks)
    assert all(0.004 < look["sigma_mm"] < 0.03 for look in looks)
    assert all(look["seconds"] > 2.0 * look["touches"] for look in looks)  # of the printer's clock
    code, out, _ = amrepair(f"replay {tmp_path} --json", monkeypatch, capsys)
    assert code == 0


@pytest.mark.slow
@pytest.mark.parametrize("printer", ["generic_klipper", "generic_reprap"])
def test_every_firmware_with_a_touch_finds_it(
    printer: str,
    part: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = (
        f"simulate {part} --printer {printer} --scanner probe --seed 1 "
        f"--defect void:diameter=7,layers=2 --out {tmp_path} --json"
    )
    code, out, _ = amrepair(words, monkeypatch, capsys)
    assert code == 0
    assert json.loads(out)["repaired_ratio"] > 0.6


def test_a_probe_that_does_not_trigger_ends_the_run_in_one_sentence(
    run: PreparedRun, tmp_path: Path
) -> None:
    stop = stop_of(run)
    path = tmp_path / "standing.npz"
    standing(run, stop, rough_mm=0.0, seed=0).write(path)
    printer = run.setup.printer
    program, rest = park(run.setup, state_at_rest(run.job, stop.line))
    with (
        EmulatedPrinterProcess(printer=printer, standing=path, dead_probe=True) as emulator,
        SerialPrinter(emulator.port) as host,
    ):
        for command in ("G28", f"M109 S{rest.hotend_c:g}", f"M140 S{rest.bed_c:g}", "G1 Z20"):
            host.command(command)
        host.print(program)
        scanner = ProbeScanner(PortFeeler(host, run.setup), run.job, run.setup)
        with pytest.raises(PrinterError, match=r"Nothing was felt down to Z1 mm") as error:
            scanner.scan(ScanRequest(stop.label, LAYER, stop.z_mm))
        assert str(error.value).count(". ") == 0
        state = emulator.state()
    assert state["deepest_mm"] == pytest.approx(printer.feeler.depth_mm, abs=1e-6)
    assert state["position_mm"][2] > stop.z_mm  # type: ignore[index]
    assert (state["hotend_target_c"], state["bed_target_c"]) == (0.0, 0.0)


def test_touches_are_cold_true_and_told(run: PreparedRun, tmp_path: Path) -> None:
    """A step of 0.3 mm: what is felt is what stands there; the nozzle is as hot as before after."""
    stop = stop_of(run)
    path, record = tmp_path / "standing.npz", tmp_path / "record.txt"
    field = standing(run, stop, (0.0, 0.0, 30.0, 0.3), rough_mm=0.0, seed=0)
    field.write(path)
    program, rest = park(run.setup, state_at_rest(run.job, stop.line))
    told: list[tuple[str, float, float]] = []
    with (
        EmulatedPrinterProcess(printer=run.setup.printer, standing=path, record=record) as emulator,
        SerialPrinter(emulator.port) as host,
    ):
        for command in ("G28", f"M109 S{rest.hotend_c:g}", "G1 Z20"):
            host.command(command)
        host.print(program)
        scanner = ProbeScanner(
            PortFeeler(host, run.setup), run.job, run.setup,
            progress=lambda stage, done, total: told.append((stage, done, total)),
        )  # fmt: skip
        scan = scanner.scan(ScanRequest(stop.label, LAYER, stop.z_mm))
        state = emulator.state()
    heights = scan.points_mm[:, 2]
    assert np.abs(heights - (stop.z_mm - 0.3)).max() < 5 * run.setup.printer.feeler.sigma_mm
    assert state["hotend_target_c"] == rest.hotend_c
    assert state["position_mm"] == pytest.approx(rest.position_mm, abs=1e-3)
    commands = record.read_text().splitlines()
    touches = [k for k, line in enumerate(commands) if line.startswith("G38.2")]
    assert len(touches) == scanner.felt[0].touches <= 60
    cold, hot = commands.index("M109 R70"), f"M109 S{rest.hotend_c:g}"
    assert cold < touches[0]
    assert hot not in commands[cold : touches[-1]]
    assert hot in commands[touches[-1] :]
    counted = [int(done) for stage, done, total in told if stage == f"touch {stop.label}"]
    assert counted == list(range(1, len(touches) + 1))
    assert any("touches in" in stage for stage, *_ in told)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("--printer ender_3", "has no probe that feels plastic"),
        ("--printer prusa_mk4", "has no probe that feels plastic"),
    ],
)
def test_a_printer_without_a_probe_is_refused_before_any_work(
    words: str,
    why: str,
    part: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = f"simulate {part} {words} --scanner probe --out {tmp_path / 'run'}"
    code, _, error = amrepair(command, monkeypatch, capsys)
    assert code == 2
    assert why in " ".join(error.split())
    assert not (tmp_path / "run").exists()
