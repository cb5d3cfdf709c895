"""A given up object in Klipper itself (`klippy_batch`): its own EXCLUDE_OBJECT.

What the tool head is told to do is written down and held against the
job: the others as they were, of the given up one nothing more.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import klippy_batch
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from loop_bench import LAYER, PLACE_MM
from objects_job import Block, labelled, plate

from amrepair.loop.objects import Objects
from amrepair.loop.travel import park, way_back
from gcode.moves import ModalState
from gcode.profiles import load_setup
from gcode.reader import Job, read_job
from gcode.resumption.head import state_at_rest
from gcode.resumption.rest import rest_without
from gcode.resumption.standing import standing_field
from gcode.slicing.job import plan_part
from gcode.writer import write

pytestmark = klippy_batch.MARKS
BLOCKS = [Block(14.0 * k, 0.0, (8.0, 8.0, 1.2)) for k in range(3)]
FAILED = "BLOCK_1"
SETUP = load_setup("generic_klipper", "pla", "repair_0.20")
NOISE_MM = 1e-4  # digits of the program, and of what is printed here

CONFIG = """\
[exclude_object]
[extruder]
step_pin: gpio21
dir_pin: gpio22
microsteps: 16
rotation_distance: 8
nozzle_diameter: 0.4
filament_diameter: 1.75
heater_pin: gpio23
sensor_type: EPCOS 100K B57560G104F
sensor_pin: analog0
control: pid
pid_kp: 20
pid_ki: 1
pid_kd: 100
min_temp: 0
max_temp: 280
[heater_bed]
heater_pin: gpio24
sensor_type: EPCOS 100K B57560G104F
sensor_pin: analog1
control: watermark
min_temp: 0
max_temp: 130
[fan]
pin: gpio25
"""


@dataclass(frozen=True)
class Told:
    """What Klipper said, and (n, 4) where it sent the tool head, E in all."""

    said: list[str]
    moves: np.ndarray

    def beads(self, above_mm: float) -> np.ndarray:
        """(k, 5) level moves that push filament: start and end, and filament, mm."""
        start, end = self.moves[:-1], self.moves[1:]
        pushed = end[:, 3] - start[:, 3]
        level = np.hypot(*(end - start)[:, :2].T) > 0
        pick = level & (pushed > 0) & (end[:, 2] > above_mm + NOISE_MM)
        return np.column_stack([start[pick, :2], end[pick, :2], pushed[pick]])


def klippy(folder: Path, lines: list[str]) -> Told:
    """What Klipper makes of a program."""
    rows = klippy_batch.klippy(folder, CONFIG, lines, lowest_mm=-5)
    said = klippy_batch.said(rows)
    wrong = [row for row in said if row.startswith("!!") or "nknown command" in row]
    assert not wrong, wrong[:3]
    moves = np.array([row.split()[1:] for row in rows if row.startswith("MOVE ")], dtype=float)
    assert len(moves) > 100, rows[-20:]
    return Told(said, moves)


@pytest.fixture(scope="module")
def job() -> Job:
    program = labelled(BLOCKS, SETUP, "klipper")
    return read_job(program, dialect=program.dialect)


@pytest.fixture(scope="module")
def whole(job: Job, tmp_path_factory: pytest.TempPathFactory) -> Told:
    lines = job.program.text.split("\n")
    return klippy(tmp_path_factory.mktemp("whole") / "run", lines)


def at_the_stop(job: Job) -> tuple[int, list[str], list[str], ModalState]:
    """The line at which it stops, the way to the park and back, and the state there."""
    line = job.layers[LAYER].end_line
    state = state_at_rest(job, line)
    aside, parked = park(SETUP, state)
    back = way_back(SETUP, state, parked)
    return (
        line, aside.program.text.split("\n"), [p.program.text for p in back], parked,
    )  # fmt: skip


def the_others(told: Told, job: Job) -> np.ndarray:
    """Beads above the stop that the given up one has no part in."""
    beads = told.beads(job.layers[LAYER].z_mm)
    return beads[~BLOCKS[1].holds(beads[:, 2:4])]


def test_klipper_leaves_it_out_and_lays_the_others_as_they_were(
    job: Job, whole: Told, tmp_path: Path
) -> None:
    line, aside, back, _ = at_the_stop(job)
    lines = job.program.text.split("\n")
    leave = [f"EXCLUDE_OBJECT NAME={FAILED}"]  # as `leave_out` sends it
    told = klippy(tmp_path / "run", [*lines[:line], *aside, *leave, *back, *lines[line:]])
    assert any("Excluding object" in row for row in told.said), told.said
    every = whole.beads(job.layers[LAYER].z_mm)
    assert BLOCKS[1].holds(every[:, 2:4]).any()
    beads = told.beads(job.layers[LAYER].z_mm)
    assert not BLOCKS[1].holds(beads[:, 2:4]).any()
    wanted = the_others(whole, job)
    assert len(beads) == len(wanted)
    assert beads[:, 2:] == pytest.approx(wanted[:, 2:], abs=NOISE_MM)


def test_what_is_left_of_the_job_is_a_program_that_klipper_takes(
    job: Job, whole: Told, tmp_path: Path
) -> None:
    """As the loop sends it over Klipper's own port: written anew, marks and all."""
    line, aside, _, parked = at_the_stop(job)
    assert FAILED in Objects.of(job).left
    rest = rest_without(
        job, [FAILED], SETUP, first=line, parked=parked,
        pulled_mm=parked.pulled_mm,
        standing=standing_field(job.beads, line, SETUP.printer),
    )  # fmt: skip
    lines = job.program.text.split("\n")
    told = klippy(tmp_path / "run", [*lines[:line], *aside, *rest.checked.program.text.split("\n")])
    beads = told.beads(job.layers[LAYER].z_mm)
    wanted = the_others(whole, job)
    assert len(beads) == len(wanted)
    assert beads[:, 2:] == pytest.approx(wanted[:, 2:], abs=2e-3)
    # from the park on it passes over what stands of the given up one, above everything
    rests = np.abs(told.moves[:, :3] - parked.position_mm).max(axis=1) < NOISE_MM
    after = told.moves[int(np.flatnonzero(rests)[0]) :]
    over = BLOCKS[1].holds(after[:, :2], around_mm=0.0)
    assert not (over & (after[:, 2] < job.layers[LAYER].z_mm)).any()


def test_a_job_that_gcode_slice_has_labelled_is_klippers_too(tmp_path: Path) -> None:
    """Its labels are comments: nothing is left out by chance, and every millimetre is laid."""
    toolpath = plan_part(plate(BLOCKS).translate(PLACE_MM), SETUP).toolpath
    program = write(toolpath, SETUP, title="three")
    told = klippy(tmp_path / "run", program.text.split("\n"))
    job = read_job(program, dialect=program.dialect)
    assert len(Objects.of(job).left) == len(BLOCKS)
    pushed_mm = float(np.nansum(job.moves()[1]))
    assert told.moves[-1, 3] == pytest.approx(pushed_mm, abs=0.01)
