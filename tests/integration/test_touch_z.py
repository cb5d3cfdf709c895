"""Z by touch on an emulated printer that has lost it: true within 0.03 mm, and gone on with."""

from __future__ import annotations

import contextlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from touch_job import HEIGHT_MM, LAYERS, X_MM, Y_MM, touch_job

from gcode.cli import main
from gcode.errors import PrinterError
from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts.serial import SerialPrinter
from gcode.hosts.touching import touch_z
from gcode.profiles import load_setup
from gcode.resumption import Touching, plan_touch, resume_at
from gcode.surfaces import HeightField

LAYER = 3
TOP_MM = LAYER * HEIGHT_MM
GOAL_MM = 0.03


def plan_for(printer: str, folder: Path, *, slope: float = 0.0) -> tuple[Touching, Path]:
    """What to touch, and what truly stands there: a slope rises along X, mm a mm."""
    setup = load_setup(printer, "pla")
    plan = plan_touch(touch_job(setup.printer.dialect), setup, above_mm=4.0, layer=LAYER)
    field = plan.standing
    x_mm = field.origin_mm[0] + (np.arange(field.shape[1]) + 0.5) * field.cell_mm
    raised = np.where(field.z_mm > 0, field.z_mm + slope * (x_mm - 80.0), 0.0)
    path = folder / "standing.npz"
    HeightField(field.origin_mm, field.cell_mm, raised, field.seen).write(path)
    return plan, path


@pytest.mark.parametrize(
    ("printer", "truly_above_mm", "seed"),
    [
        ("generic_marlin", 4.0, 0),
        ("generic_marlin", 3.1, 1),  # by eye it is within a millimetre
        ("generic_marlin", 4.9, 2),
        ("generic_reprap", 4.7, 3),
        ("generic_klipper", 3.3, 4),
    ],
)
def test_z_is_found_and_the_job_goes_on_at_its_true_height(
    printer: str, truly_above_mm: float, seed: int, tmp_path: Path
) -> None:
    setup = load_setup(printer, "pla")
    plan, standing = plan_for(printer, tmp_path)
    lost_mm = TOP_MM + truly_above_mm  # the firmware says 0 there
    rest = resume_at(touch_job(setup.printer.dialect), setup, layer=LAYER)
    with EmulatedPrinterProcess(
        setup.printer.dialect,
        printer=setup.printer,
        standing=standing,
        lost_mm=lost_mm,
        seed=seed,
    ) as emulator:
        with SerialPrinter(emulator.port, dialect=setup.printer.dialect) as host:
            found = touch_z(host, plan, 4.0)
            state = emulator.state()
            z_mm = state["position_mm"][2]  # type: ignore[index]
            error_mm = state["logical_z_mm"] - (z_mm + lost_mm)
            assert abs(error_mm) < GOAL_MM
            assert abs(error_mm) < 1.5 * found.uncertainty_mm  # two standard deviations, and a half
            assert state["deepest_mm"] < GOAL_MM  # it never pressed
            assert found.first_shift_mm == pytest.approx(truly_above_mm - 4.0, abs=GOAL_MM)
            emulator.take_motion()
            assert host.print(rest.checked).ok
            host.finish_moves()
        motion = emulator.take_motion()
    (x0, x1), (y0, y1) = X_MM, Y_MM
    low, high = np.array([x0, y0]) - 0.01, np.array([x1, y1]) + 0.01
    ends_mm = motion.end_mm[:, :2]
    laid = (motion.filament_mm > 0) & np.all((ends_mm >= low) & (ends_mm <= high), axis=1)
    laid &= np.abs(motion.end_mm[:, 0] - motion.start_mm[:, 0]) > 0.9 * (x1 - x0)  # its rows
    tops_mm = motion.end_mm[laid, 2] + lost_mm
    wanted_mm = np.arange(LAYER + 1, LAYERS + 1) * HEIGHT_MM
    assert np.abs(tops_mm[:, None] - wanted_mm).min(axis=1).max() < GOAL_MM
    assert len(np.unique(tops_mm.round(1))) == len(wanted_mm)


def test_a_probe_that_never_triggers_stops_at_the_planned_depth(tmp_path: Path) -> None:
    setup = load_setup("generic_marlin", "pla")
    plan, standing = plan_for("generic_marlin", tmp_path)
    with (
        EmulatedPrinterProcess(
            printer=setup.printer, standing=standing, lost_mm=TOP_MM + 4.0, dead_probe=True
        ) as emulator,
        SerialPrinter(emulator.port) as host,
    ):
        with pytest.raises(PrinterError, match=r"Nothing was felt down to Z-0\.9 mm"):
            touch_z(host, plan, 4.0)
        state = emulator.state()
        allowed_mm = plan.options.doubt_mm + plan.options.over_mm
        assert state["deepest_mm"] == pytest.approx(allowed_mm, abs=1e-6)
        assert state["position_mm"][2] + 4.0 > 0  # type: ignore[index]  # lifted off the part
        assert (state["hotend_target_c"], state["bed_target_c"]) == (0.0, 0.0)


def test_klipper_must_home_z_where_the_macro_does_not_say_that_it_is_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has lowered the height that Klipper believes in: nothing may go by it."""
    monkeypatch.setattr("gcode.hosts.serial._TOUCHED_NOTHING", re.compile("never said"))
    setup = load_setup("generic_klipper", "pla")
    plan, standing = plan_for("generic_klipper", tmp_path)
    with (
        EmulatedPrinterProcess(
            "klipper",
            printer=setup.printer,
            standing=standing,
            lost_mm=TOP_MM + 4.0,
            dead_probe=True,
        ) as emulator,
        SerialPrinter(emulator.port, dialect="klipper") as host,
    ):
        with pytest.raises(PrinterError, match=r"Nothing was felt within 11\.5 mm"):
            touch_z(host, plan, 4.0)
        lifted_mm = emulator.state()["position_mm"][2]  # type: ignore[index]
        with contextlib.suppress(PrinterError):
            host.command("G1 Z1 F600")
        host.finish_moves()
        assert emulator.state()["position_mm"][2] == lifted_mm  # type: ignore[index]


def test_a_firmware_without_the_touch_is_not_believed(tmp_path: Path) -> None:
    """Prusa's Buddy firmware is built without G38.2: it says so, and nothing moves."""
    setup = load_setup("generic_marlin", "pla")
    plan, standing = plan_for("generic_marlin", tmp_path)
    with (
        EmulatedPrinterProcess(
            "prusa", printer=setup.printer, standing=standing, lost_mm=TOP_MM + 4.0
        ) as emulator,
        SerialPrinter(emulator.port, dialect="marlin") as host,
    ):
        with pytest.raises(PrinterError, match=r"does not know G38\.2, so nothing was touched"):
            touch_z(host, plan, 4.0)
        state = emulator.state()
        assert state["deepest_mm"] == 0.0
        assert (state["hotend_target_c"], state["bed_target_c"]) == (0.0, 0.0)


def test_touches_that_do_not_agree_are_not_believed(tmp_path: Path) -> None:
    """A corner that has come off the bed: 0.3 mm over the part's length."""
    setup = load_setup("generic_marlin", "pla")
    plan, standing = plan_for("generic_marlin", tmp_path, slope=0.3 / 24.0)
    with (
        EmulatedPrinterProcess(
            printer=setup.printer, standing=standing, lost_mm=TOP_MM + 4.0
        ) as emulator,
        SerialPrinter(emulator.port) as host,
        pytest.raises(PrinterError, match=r"differ by 0\.[12]\d+ mm"),
    ):
        touch_z(host, plan, 4.0)


def test_a_warm_nozzle_touches_nothing(tmp_path: Path) -> None:
    setup = load_setup("generic_marlin", "pla")
    plan, standing = plan_for("generic_marlin", tmp_path)
    with (
        EmulatedPrinterProcess(
            printer=setup.printer, standing=standing, lost_mm=TOP_MM + 4.0
        ) as emulator,
        SerialPrinter(emulator.port) as host,
    ):
        host.command("M109 S150")
        with pytest.raises(PrinterError, match="would melt in"):
            touch_z(host, plan, 4.0)
        assert emulator.state()["deepest_mm"] == 0.0


def test_the_command_says_how_true_z_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    setup = load_setup("generic_marlin", "pla")
    _, standing = plan_for("generic_marlin", tmp_path)
    job = tmp_path / "job.gcode"
    job.write_text(touch_job().text)
    with EmulatedPrinterProcess(
        printer=setup.printer, standing=standing, lost_mm=TOP_MM + 3.5
    ) as emulator:
        words = f"touch {job} --layer {LAYER} --above-mm 4 --printer generic_marlin --json"
        monkeypatch.setattr(sys, "argv", ["gcode", *words.split(), "--port", emulator.port])
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code
        state = emulator.state()
    told = json.loads(capsys.readouterr().out)
    z_mm = state["position_mm"][2]  # type: ignore[index]
    assert abs(state["logical_z_mm"] - (z_mm + TOP_MM + 3.5)) < GOAL_MM
    assert told["layer"] == LAYER
    assert told["top_mm"] == pytest.approx(TOP_MM)
    assert told["first_shift_mm"] == pytest.approx(-0.5, abs=GOAL_MM)
    assert 0 < told["uncertainty_mm"] < GOAL_MM
