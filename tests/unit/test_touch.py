"""Z by touch: what is planned, what the checker lets pass, what the emulated nozzle feels."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from touch_job import HEIGHT_MM, SPARSE_LAYER, X_MM, Y_MM, touch_job

from gcode.check import Touch, find_refusals
from gcode.check.checker import judge
from gcode.errors import InputError, PrinterError, ProfileError
from gcode.firmware import FirmwareCore
from gcode.firmware.contact import ProbeContact
from gcode.hosts.touching import felt
from gcode.moves import Program
from gcode.profiles import PrintSetup, load_setup
from gcode.resumption.touch import TouchOptions, plan_touch
from gcode.surfaces import HeightField

TOP_MM = 3.0
PLANNED = (Touch(100.0, 100.0, TOP_MM, TOP_MM - 0.3),)


@pytest.fixture(scope="module")
def setup() -> PrintSetup:
    return load_setup("generic_marlin", "pla")


def standing(top_mm: float = TOP_MM) -> HeightField:
    z_mm = np.zeros((220, 220))
    z_mm[90:111, 90:111] = top_mm
    return HeightField(np.zeros(2), 1.0, z_mm, np.ones_like(z_mm, dtype=bool))


def touching(touch: str, *, before: str = "G1 X100 Y100 F6000", first: str = "") -> Program:
    lines = [first, "G21", "G90", "M83", "G1 Z13 F300", "G28 X Y", before, touch, "G1 Z13 F300"]
    return Program("\n".join(filter(None, lines)) + "\n", "marlin")


def refused(program: Program, setup: PrintSetup, touches: tuple[Touch, ...] = PLANNED) -> str:
    verdict = judge(program, setup, as_built=standing(), touches=touches)
    return "; ".join(map(str, verdict.refusals))


def test_a_planned_touch_passes(setup: PrintSetup) -> None:
    assert refused(touching("G38.2 Z2.7 F120"), setup) == ""


@pytest.mark.parametrize(
    ("program", "why"),
    [
        (touching("G38.2 Z2.5 F120"), "below its planned depth"),
        (touching("G38.2 Z-1 F120"), "below its planned depth"),
        (touching("G38.2 Z2.7 F120", before="G1 X101 Y100 F6000"), "where none is planned"),
        (touching("G38.2 Z2.7 F120", before="M105"), "where none is planned"),
        (touching("G38.2 X90 Z2.7 F120"), "not straight down"),
        (touching("G38.2 Z2.7"), "not straight down"),
        (touching("G38.2 F120"), "not straight down"),
        (touching("G91\nG38.2 Z-5 F120\nG90"), "not straight down"),
        (touching("G38.2 Z2.7 F1200"), "too fast"),
        (touching("G38.2 Z2.7 F120", first="M104 S200"), "hot nozzle"),
        (touching("G38.3 Z2.7 F120"), "unknown or not allowed: G38.3"),
        (touching("G30"), "probing over a standing part: G30"),
        (touching("G29"), "probing over a standing part"),
    ],
)
def test_any_other_touch_is_refused(program: Program, why: str, setup: PrintSetup) -> None:
    assert why in refused(program, setup)


def test_without_a_plan_there_is_no_touch(setup: PrintSetup) -> None:
    (refusal,) = find_refusals(touching("G38.2 Z2.7 F120"), setup, as_built=standing())
    assert "G38.2" in str(refusal)


def test_the_head_is_swept_down_to_what_it_feels(setup: PrintSetup) -> None:
    """A wall beside the place, higher than the flat: the heater block would hit it."""
    field = standing()
    z_mm = field.z_mm.copy()
    z_mm[90:111, 101:111] = 12.0
    walled = HeightField(field.origin_mm, field.cell_mm, z_mm, field.seen)
    program = touching("G38.2 Z2.7 F120").text.replace("Z13", "Z22")
    verdict = judge(Program(program, "marlin"), setup, as_built=walled, touches=PLANNED)
    assert verdict.refusals


def test_the_flat_is_found_from_the_jobs_beads(setup: PrintSetup) -> None:
    plan = plan_touch(touch_job(), setup, above_mm=4.0, layer=SPARSE_LAYER)
    assert plan.layer.z_mm == pytest.approx(SPARSE_LAYER * HEIGHT_MM)
    assert plan.flat_mm == pytest.approx(Y_MM[1] - Y_MM[0], abs=0.5)  # beads reach half a width out
    half_mm = TouchOptions().flat_mm / 2 - 0.3  # by the beads' rims and a cell
    assert np.all(plan.places_mm >= np.array([X_MM[0], Y_MM[0]]) + half_mm)
    assert np.all(plan.places_mm <= np.array([X_MM[1], Y_MM[1]]) - half_mm)
    assert np.linalg.norm(np.diff(plan.places_mm, axis=0)) > 5.0
    touches = [line for line in plan.coarse.program.text.split("\n") if "G38" in line]
    assert touches == ["G38.2 Z-0.9 F120"]  # 1.5 mm below: a thin part ends in the bed's own room
    assert "G28 X Y" in plan.fine.program.text


def test_the_mesh_is_on_where_the_job_goes_on_with_it(setup: PrintSetup) -> None:
    """Z felt without it would be wrong by the bed's own height there."""
    plain = touch_job()
    levelled = Program(plain.text.replace("G28\n", "G28\nG29\n"), "marlin")
    for job, meshed in ((plain, False), (levelled, True)):
        plan = plan_touch(job, setup, above_mm=4.0, layer=2)
        assert ("G28 X Y\nM420 S1\n" in plan.fine.program.text) is meshed


@pytest.mark.parametrize(
    ("printer", "above_mm", "layer", "why"),
    [
        ("prusa_mk3s", 4.0, 2, "speaks prusa"),
        ("prusa_mk4", 4.0, 2, "has no probe that feels plastic"),
        ("ender_3", 4.0, 2, "has no probe that feels plastic"),
        ("generic_marlin", 1.0, 2, "2 to 10 mm"),
        ("generic_marlin", 11.0, 2, "2 to 10 mm"),
        ("generic_marlin", float("nan"), 2, "2 to 10 mm"),
        ("generic_marlin", 4.0, SPARSE_LAYER + 1, "a touch needs a flat of 3 mm"),
        ("generic_marlin", 4.0, 0, "nothing stands"),
        ("generic_marlin", 4.0, 99, "no layer 99"),
    ],
)
def test_what_cannot_be_touched_is_refused(
    printer: str, above_mm: float, layer: int, why: str
) -> None:
    setup = load_setup(printer, "pla")
    job = touch_job(setup.printer.dialect)
    with pytest.raises((InputError, ProfileError), match=why):
        plan_touch(job, setup, above_mm=above_mm, layer=layer)


@pytest.mark.parametrize(("dead", "met"), [(False, True), (True, False)])
def test_the_emulated_nozzle_stops_at_what_it_feels(
    dead: bool, met: bool, setup: PrintSetup
) -> None:
    core = FirmwareCore(setup.printer, "marlin")
    core.power_up()
    core.machine.contact = ProbeContact(standing(), lost_mm=7.0, sigma_mm=0.0, dead=dead)
    core.take_output()
    for line in (b"G92 Z7", b"G28 X Y", b"G1 X100 Y100 F6000", b"G38.2 Z1.5 F120", b"M114"):
        core.feed(line + b"\n")
        core.run()
    said = core.take_output().decode()
    assert ("Failed to reach target" in said) is not met
    assert f"Z:{3.0 if met else 1.5:.2f}" in said
    assert core.machine.contact.deepest_mm == pytest.approx(0.0 if met else 1.5, abs=1e-9)


def klipper_touch(touch: str, *, hot: bool = False) -> Program:
    before = ["M104 S200"] if hot else []
    lines = ["G90", "M83", "G1 Z13 F300", "G28 X Y", "G1 X100 Y100 F6000", touch, "G1 Z13 F300"]
    return Program("\n".join([*before, *lines]) + "\n", "klipper")


@pytest.mark.parametrize(
    ("touch", "hot", "why"),
    [
        ("AMREPAIR_TOUCH DEPTH=10.3 SPEED=2", False, ""),
        ("AMREPAIR_TOUCH DEPTH=10.5 SPEED=2", False, "below its planned depth"),
        ("AMREPAIR_TOUCH SPEED=2", False, "not straight down"),
        ("AMREPAIR_TOUCH DEPTH=10.3", False, "too fast"),
        ("AMREPAIR_TOUCH DEPTH=10.3 SPEED=20", False, "too fast"),
        ("AMREPAIR_TOUCH DEPTH=10.3 SPEED=2 SAMPLES=3", False, "not straight down"),
        ("AMREPAIR_TOUCH DEPTH=10.3 SPEED=2", True, "hot nozzle"),
        ("PROBE", False, "probing over a standing part: PROBE"),
    ],
)
def test_klippers_touch_is_as_deep_as_planned(touch: str, hot: bool, why: str) -> None:
    klipper = load_setup("generic_klipper", "pla")
    told = refused(klipper_touch(touch, hot=hot), klipper)
    assert told == "" if not why else why in told


def test_a_flat_rests_on_the_highest_place_below_it() -> None:
    """A pit narrower than the flat is not felt, however deep; a wider one is."""
    z_mm = np.full((100, 100), 3.0)
    y, x = np.mgrid[:100, :100]
    away_mm = 0.1 * np.hypot(x - 49.5, y - 49.5)
    for pit_mm, felt_mm in ((0.45, 3.0), (0.7, 2.0)):
        field = HeightField(
            np.zeros(2), 0.1, np.where(away_mm < pit_mm, 2.0, z_mm), np.ones_like(z_mm, bool)
        )
        contact = ProbeContact(field, sigma_mm=0.0, tip_radius_mm=0.5)
        assert contact.met_at_mm(5.0, 5.0) == felt_mm
        beside = ProbeContact(field, sigma_mm=0.0, tip_radius_mm=0.5, offset_mm=(2.0, 0.0, -1.5))
        assert beside.met_at_mm(3.0, 5.0) == felt_mm + 1.5  # the nozzle stays above


def test_prusas_firmware_and_klipper_know_no_such_touch(setup: PrintSetup) -> None:
    for firmware in ("prusa", "klipper"):
        core = FirmwareCore(setup.printer, firmware)
        core.power_up()
        core.take_output()
        core.feed(b"G38.2 Z1 F120\n")
        core.run()
        assert b"nknown command" in core.take_output()


def test_touches_that_somebody_cancels_after_the_last_are_not_taken_for_made() -> None:
    """Regression: stopped on its way back from the last touch, it passed for done."""
    printer: Any = SimpleNamespace(
        touch=lambda *_, **__: 2.9, print=lambda *_, **__: SimpleNamespace(ok=False)
    )
    checked: Any = SimpleNamespace(program=touching("G38.2 Z2.7 F120"))
    with pytest.raises(PrinterError, match="The touches were stopped"):
        felt(printer, checked)
