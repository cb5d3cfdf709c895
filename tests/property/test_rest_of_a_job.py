"""What is left of a job without some objects, against an interpreter of a few lines of its own."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from objects_job import Block, labelled

from amrepair.loop.travel import park
from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles import PrintSetup, load_setup
from gcode.reader import Job, objects_of, read_job
from gcode.resumption.rest import OVER_PART_MM, rest_without
from gcode.resumption.standing import standing_field

WORD = re.compile(r"([GMXYZEFS])(-?[\d.]+)")
SETUPS = {"m486": "prusa_mk3s", "klipper": "generic_klipper"}
BLOCKS = {
    "alike": [Block(0, 0, (8, 8, 1.0)), Block(14, 0, (8, 8, 1.0)), Block(28, 0, (8, 8, 1.0))],
    "of different heights": [Block(0, 0, (8, 8, 1.4)), Block(14, 4, (8, 8, 0.8))],
}


@dataclass
class Machine:
    """Moves as firmware makes them: what it lays, has pulled back, and hears besides."""

    at: np.ndarray = field(default_factory=lambda: np.zeros(3))
    absolute: bool = True
    absolute_e: bool = True
    e: float = 0.0
    back: float = 0.0
    beads: list[tuple[float, ...]] = field(default_factory=list)
    travels: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    heard: list[str] = field(default_factory=list)
    begun_back: list[float] = field(default_factory=list)

    def run(self, lines: list[str]) -> Machine:
        for raw in lines:
            line = raw.partition(";")[0].strip()
            name = line.split(" ")[0]
            words = {k: float(v) for k, v in WORD.findall(line)[1:]}
            if name in {"G90", "G91"}:
                self.absolute = name == "G90"
            elif name in {"M82", "M83"}:
                self.absolute_e = name == "M82"
            elif name == "G92":
                self.e = words.get("E", self.e)
            elif name in {"G0", "G1"}:
                self.move(words)
            elif line and not line.startswith(("M486", "EXCLUDE")):
                self.heard.append(line)
        return self

    def move(self, words: dict[str, float]) -> None:
        end = self.at.copy()
        for k, axis in enumerate("XYZ"):
            if axis in words:
                end[k] = words[axis] if self.absolute else end[k] + words[axis]
        pushed = 0.0
        if "E" in words:
            pushed = words["E"] - self.e if self.absolute_e else words["E"]
            self.e += pushed
        if pushed > 0 and np.hypot(*(end - self.at)[:2]) > 0:
            self.begun_back.append(self.back)
            row = (*self.at, *end, pushed)
            self.beads.append(tuple(round(float(v), 3) for v in row))
        elif pushed == 0 and not np.array_equal(end, self.at):
            self.travels.append((self.at, end))
        self.back = max(0.0, self.back - pushed)
        self.at = end


@cache
def made(which: str, marks: str, relative: bool) -> tuple[PrintSetup, Job]:
    setup = load_setup(SETUPS[marks], "pla", "repair_0.20")
    program = labelled(BLOCKS[which], setup, marks)
    text = program.text if relative else with_absolute_e(program.text)
    return setup, read_job(Program(text, program.dialect), dialect=program.dialect)


def with_absolute_e(text: str) -> str:
    """The same job, E counted from the beginning."""
    e, out = 0.0, []
    for line in text.split("\n"):
        new = "M82" if line.strip() == "M83" else line
        found = re.search(r"E(-?[\d.]+)", line) if line.startswith("G1 ") else None
        if found is not None:
            e += float(found.group(1))
            new = line.replace(found.group(), f"E{e:.5f}")
        elif line.startswith("G92 E"):
            e = float(line[5:].partition(";")[0])
        out.append(new)
    return "\n".join(out)


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_the_others_are_laid_as_they_were_and_nothing_of_what_was_given_up(
    data: st.DataObject,
) -> None:
    which = data.draw(st.sampled_from(sorted(BLOCKS)))
    marks = data.draw(st.sampled_from(sorted(SETUPS)))
    setup, job = made(which, marks, data.draw(st.booleans()))
    objects, blocks = objects_of(job), BLOCKS[which]
    index = data.draw(st.integers(0, len(blocks) - 1))
    layer = data.draw(st.integers(0, len(job.layers) - 2))
    first = job.layers[layer].end_line
    lines = job.program.text.split("\n")
    own = np.array([blocks[index].holds(np.array(PLACE)) for PLACE in job.beads.end_mm[:, :2]])
    (number,) = set(objects.of_bead[own].tolist())
    state = job.state_after(first)
    _, parked = park(setup, state)
    standing = standing_field(job.beads, first, setup.printer)
    before = Machine().run(lines[:first])
    pulled_mm = before.back + setup.printer.retraction_mm
    ask = {"first": first, "parked": parked, "pulled_mm": pulled_mm, "standing": standing,
           "stops": [one.end_line for one in job.layers]}  # fmt: skip
    others = ~own & (job.beads.line >= first)
    if not others.any():
        with pytest.raises(InputError, match="nothing of the job would be left"):
            rest_without(job, [objects.names[number]], setup, **ask)
        return
    rest = rest_without(job, [objects.names[number]], setup, **ask)

    plain = Machine(np.array(state.position_mm), before.absolute, before.absolute_e, before.e,
                    before.back).run(lines[first:])  # fmt: skip
    left = Machine(np.array(parked.position_mm), True, False, 0.0, pulled_mm)
    left.run(rest.checked.program.text.split("\n"))
    kept = [b for b in plain.beads if not blocks[index].holds(np.array(b[3:5]))]
    assert len(left.beads) == len(kept)
    assert np.array(left.beads) == pytest.approx(np.array(kept), abs=2e-3)
    assert max(left.begun_back, default=0.0) < 1e-3, "a bead begins with its filament there"
    assert left.heard == plain.heard, "fans, temperatures, limits"
    inside = [
        min(start[2], end[2])
        for start, end in left.travels
        for share in np.linspace(0, 1, 60)
        if blocks[index].holds((start + share * (end - start))[:2], 0.0)
        and np.hypot(*(end - start)[:2]) > 0
    ]
    assert min(inside, default=np.inf) > standing.top_mm + 0.9 * OVER_PART_MM, "lifted over it"
    # where the job is looked at again, the machine is where the rest's own job says
    for one in job.layers[layer + 1 :]:
        place = int(rest.line_of[one.end_line])
        if place >= rest.job.program.text.count("\n"):
            continue
        there = Machine(np.array(parked.position_mm), True, False, 0.0, pulled_mm)
        there.run(rest.checked.program.text.split("\n")[: place - first])
        said = rest.job.state_after(place)
        assert there.at == pytest.approx(np.array(said.position_mm), abs=1e-3)
        assert there.e == pytest.approx(said.e_mm, abs=1e-3)
        assert (there.absolute, there.absolute_e) == (said.absolute_xyz, said.absolute_e)
