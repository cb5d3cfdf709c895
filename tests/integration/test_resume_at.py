"""`gcode resume-at`: what is left of a job, moves for moves, and a safe way to where it begins."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_forks import until

from gcode.check import find_refusals
from gcode.cli import main
from gcode.errors import CheckRefusedError, GcodeError, InputError, ReadError
from gcode.firmware import EmulatedPrinterProcess, FirmwareCore
from gcode.moves import Program
from gcode.profiles import EnvelopeSlice, PrinterProfile, PrintSetup, load_setup
from gcode.resumption import Resumption, resume_at
from tests.commands import here

DATA = os.environ.get("AMREPAIR_DATA")


def setup_for(printer: str, *, fast: bool = False) -> PrintSetup:
    """Profiles; a fast hotend with a second tool where the job wants one."""
    setup = load_setup(printer, "pla")
    if not fast:
        return setup
    return PrintSetup(
        setup.printer.model_copy(update={"max_volumetric_mm3_s": 26.0, "macros": ("T1",)}),
        setup.material.model_copy(update={"max_volumetric_mm3_s": 26.0}),
        setup.process,
    )


def with_printer(setup: PrintSetup, **changes: object) -> PrintSetup:
    return PrintSetup(setup.printer.model_copy(update=changes), setup.material, setup.process)


@dataclass
class Ran:
    """What an emulated printer did: one row a move, start, end, filament, speed."""

    head: Float[np.ndarray, "n 8"]
    body: Float[np.ndarray, "m 8"]
    replies: str


def run(lines: list[str], split: int, printer: PrinterProfile, first: list[str]) -> Ran:
    """Let a printer carry out `first`, then the lines, in two parts."""
    core = FirmwareCore(printer, printer.dialect)
    core.power_up()
    said = []

    def feed(part: list[str]) -> Float[np.ndarray, "n 8"]:
        for line in part:
            core.feed(line.encode("utf-8", "replace") + b"\n")
            core.run()
        core.drain()
        said.append(core.take_output())
        rows = np.array(core.machine.planner.executed).reshape(-1, 9)[:, :8]
        del core.machine.planner.executed[:]
        return rows

    feed(first)
    head, body = feed(lines[:split]), feed(lines[split:])
    return Ran(head, body, b"".join(said).decode("latin-1"))


def head_length(made: Resumption, job: Program) -> int:
    """Lines of the program that bring the machine there; the job's own follow unchanged."""
    rest = job.text.rstrip().split("\n")[made.first_line :]
    lines = made.checked.program.text.split("\n")
    at = len(lines) - 1 - 3 - len(rest)
    assert lines[at : at + len(rest)] == rest
    assert lines[at + len(rest) :] == ["M104 S0", "M140 S0", "M107", ""]
    return at


def judge(made: Resumption, job: Program, setup: PrintSetup) -> Ran:
    """The strongest thing there is to say: from there on the nozzle does what it had done."""
    printer = setup.printer
    standing_mm = made.standing.top_mm
    at = head_length(made, job)
    lines = made.checked.program.text.split("\n")
    stood = ["G28", f"G1 Z{standing_mm:.3f}", "G1 X20 Y30"]
    ran = run(lines, at, printer, stood)
    begun = ["G28", f"M140 S{made.bed_c}", f"M109 S{made.hotend_c}"]  # what START_PRINT does
    true = run(job.text.split("\n"), made.first_line, printer, begun)
    assert len(true.body) > 20
    assert ran.body[: len(true.body)] == pytest.approx(true.body, abs=2e-4)
    assert len(ran.body) == len(true.body)
    assert "cold extrusion" not in ran.replies
    assert "Extrude below" not in ran.replies
    # The way there: above everything, but to prime where nothing stands, and down at the end.
    head = ran.head
    low = head[:, [2, 5]].min(axis=1) < standing_mm + 1.9
    low[0] = False  # the lift itself
    start = true.body[0, :3]
    came_down = np.abs(head[:, [0, 3]] - start[0]).max(axis=1) < 1e-3
    came_down &= np.abs(head[:, [1, 4]] - start[1]).max(axis=1) < 1e-3
    for x, y in head[low & ~came_down][:, 3:5]:
        ix, iy = np.floor((np.array([x, y]) - made.standing.origin_mm) / made.standing.cell_mm)
        assert made.standing.z_mm[int(iy), int(ix)] == 0
    assert head[0, 5] >= standing_mm + 2  # up first
    assert head[-1, 3:6] == pytest.approx(start, abs=1e-3)
    pushed_mm = head[:, 6].clip(0).sum()
    assert pushed_mm >= printer.prime_length_mm
    assert not any(line.startswith("G28") and "Z" in line for line in lines)
    return ran


@pytest.mark.skipif(DATA is None, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize(
    ("name", "printer", "layer"),
    [
        pytest.param("plant-sign", "generic_marlin", 9, marks=pytest.mark.slow),
        ("prusaslicer-cube", "prusa_mk3s", 37),
        pytest.param("prusaslicer-cube", "generic_reprap", 60, marks=pytest.mark.slow),
        pytest.param("screw", "generic_marlin", 110, marks=pytest.mark.slow),
        ("vase", "ender_3", 300),
        pytest.param("cura_slicer", "voron_2_4", 12, marks=pytest.mark.slow),
        pytest.param("orca_slicer", "voron_2_4", 170, marks=pytest.mark.slow),
    ],
)
def test_every_slicers_job_goes_on_move_for_move(name: str, printer: str, layer: int) -> None:
    setup = setup_for(printer, fast=name == "orca_slicer")
    text = (Path(str(DATA)) / "gcode" / f"{name}.gcode").read_text(errors="replace")
    job = Program(text, setup.printer.dialect)
    made = resume_at(job, setup, layer=layer)
    assert made.primed == "on the bed"
    judge(made, job, setup)
    assert find_refusals(made.checked.program, setup, as_built=made.standing) == ()


def tower(height_mm: float, *, relative: bool = False, extra: tuple[str, ...] = ()) -> Program:
    """Squares on squares, 0.2 mm apart: absolute E, a fan and a factor set on the way."""
    lines = ["M190 S60", "M109 S210", "G28", "G90", "M82", "G92 E0", *extra]
    e = 0.0
    for k in range(round(height_mm / 0.2)):
        z = 0.2 * (k + 1)
        lines += [";LAYER_CHANGE", f"G1 E{e - 0.8:.5f} F2100", f"G1 X90 Y90 Z{z:.2f} F7200"]
        lines.append(f"G1 E{e:.5f} F2100")
        if k == 2:
            lines += ["M106 S127", "M221 S95", "M204 S800", "M900 K0.04"]
        for x, y in ((110, 90), (110, 110), (90, 110), (90, 90)):
            e += 0.7
            lines.append(f"G1 X{x} Y{y} E{e:.5f} F1800")
    lines += ["M104 S0", "M140 S0", "M107", "G1 X5 Y200 F3000"]
    return Program("\n".join(lines) + "\n", "marlin")


def test_modes_factors_and_extruder_come_back() -> None:
    setup, job = setup_for("generic_marlin"), tower(4.0)
    made = resume_at(job, setup, layer=10)
    ran = judge(made, job, setup)
    text = made.checked.program.text
    head = text.split("\n")[: head_length(made, job)]
    assert head.index("M221 S95") > head.index("G28 X Y")
    assert {"M106 S127", "M204 S800", "M900 K0.04", "M82"} <= set(head)
    assert head[-1] == "M82"
    assert f"G92 E{0.7 * 40:g}" in head
    assert made.hotend_c == 210.0
    assert made.bed_c == 60.0
    assert ran.body[:, 6].clip(0).sum() == pytest.approx((0.7 * 4 + 0.8) * 10 * 0.95, abs=1e-6)


@pytest.mark.parametrize(
    ("z_mm", "layer"), [(2.0, 10), (1.93, 10), (2.08, 10), (2.11, 11), (0.15, 1), (3.85, 19)]
)
def test_a_measured_height_means_the_nearest_layer(z_mm: float, layer: int) -> None:
    made = resume_at(tower(4.0), setup_for("generic_marlin"), z_mm=z_mm)
    assert made.layer.index == layer
    assert made.standing.top_mm == pytest.approx(0.2 * layer)


def test_a_mesh_that_marlin_would_forget_is_switched_on_again() -> None:
    setup = setup_for("generic_marlin")
    with_mesh = resume_at(tower(2.0, extra=("G29",)), setup, layer=5).checked.program.text
    assert with_mesh.index("M420 S1") > with_mesh.index("G28 X Y")
    assert "M420" not in resume_at(tower(2.0), setup, layer=5).checked.program.text


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"layer": 0}, InputError, "send the whole job"),
        ({"layer": 20}, InputError, "layers 0 to 19"),
        ({"layer": -1}, InputError, "layers 0 to 19"),
        ({"z_mm": 3.95}, InputError, "nothing is left to print"),
        ({"z_mm": -5.0}, InputError, "send the whole job"),
        ({}, InputError, "either a height or a layer"),
        ({"layer": 3, "z_mm": 2.0}, InputError, "either a height or a layer"),
    ],
)
def test_what_is_no_place_in_the_job_is_refused(
    options: dict[str, float], error: type[GcodeError], said: str
) -> None:
    with pytest.raises(error, match=said) as caught:
        resume_at(tower(4.0), setup_for("generic_marlin"), **options)  # type: ignore[arg-type]
    assert str(caught.value).count(". ") == 0  # one sentence


def test_what_cannot_be_done_is_refused() -> None:
    setup = setup_for("generic_marlin")
    with pytest.raises(ReadError, match="shifts the coordinate system"):
        resume_at(tower(4.0, extra=("G92 X0",)), setup, layer=9)
    low = with_printer(setup, max_z_mm=4.0)
    with pytest.raises(InputError, match="no room to home"):
        resume_at(tower(4.0), low, layer=18)
    small = with_printer(setup, bed_size_mm=(100.0, 100.0), park_mm=(5.0, 95.0, 20.0))
    with pytest.raises(CheckRefusedError, match="out of reach"):
        resume_at(tower(4.0), small, layer=9)
    two = tower(2.0).text.replace("M104 S0", "").split("\n")
    second = [line.replace("X9", "X14").replace("X110", "X160") for line in two[6:]]
    two_towers = Program("\n".join([*two[:-5], "G92 E0", *second]), "marlin")
    with pytest.raises(InputError, match="one object after another"):
        resume_at(two_towers, setup, z_mm=1.0)
    with pytest.raises(CheckRefusedError, match="homing Z onto a standing part"):
        resume_at(Program(tower(4.0).text + "G28\n", "marlin"), setup, layer=9)


def test_where_the_head_does_not_fit_beside_the_part_it_is_primed_in_the_air() -> None:
    """A gantry as wide as the bed cannot come down beside a tower: it would hit it."""
    setup = setup_for("generic_marlin")
    gantry = EnvelopeSlice(
        part="gantry",
        z_from_mm=2.0,
        polygon_mm=((-300, -300), (300, -300), (300, 300), (-300, 300)),
    )
    setup = with_printer(setup, envelope=(*setup.printer.envelope[:1], gantry))
    job = tower(4.0)
    made = resume_at(job, setup, layer=15)
    assert made.primed == "in the air"
    judge(made, job, setup)
    assert resume_at(job, setup, layer=5).primed == "on the bed"


def test_a_full_bed_leaves_no_place_to_prime() -> None:
    lines = ["M190 S60", "M109 S210", "G28", "G90", "M83", "G1 Z0.2 F600", "G1 F1800"]
    for y in range(221):
        lines.append(f"G1 X{220 * (1 - y % 2)} Y{y} E0.01")
    lines += [f"G1 Z{0.2 * k:.1f} E0.01\nG1 X{110 + k % 2} Y100 E0.02" for k in range(2, 9)]
    lines += ["M104 S0", "M140 S0"]
    with pytest.raises(InputError, match="no bare place on the bed"):
        resume_at(Program("\n".join(lines), "marlin"), setup_for("generic_marlin"), layer=3)


def test_the_command_line_makes_it_and_prints_it(tmp_path: Path) -> None:
    """From the file to the emulated printer: it stands at 2 mm, and the rest is printed."""
    job, out, field = tmp_path / "job.gcode", tmp_path / "rest.gcode", tmp_path / "stands.npz"
    job.write_text(tower(4.0).text)
    words = ["--printer", "generic_marlin"]
    where = ["-o", out, "--standing", field, "--json"]
    made = here("resume-at", job, "--z-mm", "2.0", *words, *where, program="gcode")
    assert made.returncode == 0, made.stderr
    told = json.loads(made.stdout)
    assert (told["layer"], told["standing_mm"], told["primed"]) == (10, 2.0, "on the bed")
    setup = setup_for("generic_marlin")
    with EmulatedPrinterProcess(printer=setup.printer) as emulator:
        fd = os.open(emulator.port, os.O_RDWR | os.O_NOCTTY)
        os.write(fd, b"G28\nG1 Z2.0 F600\nM400\n")
        until(lambda: emulator.state()["position_mm"] == [0.0, 0.0, 2.0])
        os.close(fd)
        emulator.take_motion()
        journal = tmp_path / "journal.sqlite"
        send = ("send", out, "--port", emulator.port, *words, "--journal", journal, "--json")
        refused = here(*send, program="gcode")  # nobody said that something stands there
        assert refused.returncode == 2
        done = here(*send, "--as-built", field, program="gcode")
        assert done.returncode == 0, done.stderr
        motion = emulator.take_motion()
        state = emulator.state()
    rest = (motion.end_mm[:, 2] > 2.1) & (motion.end_mm[:, 2] < 4.1) & (motion.filament_mm > 0)
    beads = rest & (np.linalg.norm(motion.end_mm - motion.start_mm, axis=1) > 1)
    assert int(beads.sum()) == 40
    assert motion.filament_mm[beads].sum() == pytest.approx(0.7 * 40 * 0.95)
    assert state["hotend_target_c"] == state["bed_target_c"] == 0


SLICED = "; profiles: ender_3, petg, standard_0.20"
CURAS = ";FLAVOR:Marlin\n;TIME:666\n;Layer height: 0.2\n;TARGET_MACHINE.NAME:Creality Ender-3"
AHEAD = (
    "; HEADER_BLOCK_START\n; CONFIG_BLOCK_START\n; printer_settings_id = Mine\n"
    "; printable_area = 0x0,220x0,220x220,0x220"
    "\n; CONFIG_BLOCK_END"
)


@pytest.mark.parametrize(
    ("head", "words", "printer"),
    [
        (SLICED, [], "Creality Ender-3"),
        (CURAS, [], "Creality Ender-3"),
        (AHEAD, [], "Mine"),
        ("; a job", ["--printer", "ender_3"], "Creality Ender-3"),
        (CURAS, ["--printer", "generic_marlin"], "Generic Marlin printer"),
    ],
)
def test_what_is_left_of_a_job_is_for_the_jobs_printer(
    head: str, words: list[str], printer: str, tmp_path: Path
) -> None:
    """regression: it was judged, and sent, as for the default printer."""
    job, out = tmp_path / "job.gcode", tmp_path / "rest.gcode"
    job.write_text(f"{head}\n{tower(4.0).text}")
    made = here("resume-at", job, "--layer", "10", *words, "-o", out, program="gcode")
    assert made.returncode == 0, made.stderr
    field = tmp_path / "stands.npz"
    resume_at(tower(4.0), setup_for("ender_3"), layer=10).standing.write(field)
    judged = here("check", out, "--as-built", field, "--json", program="gcode")
    told = json.loads(judged.stdout)
    assert (told["printer_name"], told["printer_from"]) == (printer, "job")
    assert told["other_printer"] is None
    assert "TIME:" not in out.read_text()  # it is not what is left of it


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--layer", "99", "-o", "OUT"], "layers 0 to 19"),
        (["--layer", "3", "-o", "/proc/nowhere/x.gcode"], "cannot be written"),
        (["--layer", "3", "-o", "OUT", "--standing", "x.tif"], "written as .npz"),
    ],
)
def test_bad_calls_end_in_one_sentence_and_write_nothing(
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    job, out = tmp_path / "job.gcode", tmp_path / "out.gcode"
    job.write_text(tower(4.0).text)
    words = [str(out) if word == "OUT" else word for word in words]
    words += ["--printer", "prusa_mk3s"]
    monkeypatch.setattr(sys, "argv", ["gcode", "resume-at", str(job), *words])
    with pytest.raises(SystemExit) as end:
        main()
    told = capsys.readouterr().err
    assert end.value.code == 2
    assert said in told
    assert len(told.strip().splitlines()) == 1
    assert not out.exists()
