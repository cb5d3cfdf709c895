"""What is left of a job without an object, sent by whoever reads the job's own file."""

from __future__ import annotations

import numpy as np
import pytest
from objects_job import Block, labelled
from test_octoprint_plugin import Wire

from amrepair.loop import Stop
from amrepair.loop.marked_stops import marked_stops
from amrepair.loop.objects import Course
from amrepair.loop.travel import park
from amrepair.postprocess import LooksAsked, mark
from gcode.hosts.job_text import JobText
from gcode.hosts.rewritten import Edit, Rewritten
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.protocol import command_in
from gcode.reader import Job, objects_of, read_job
from gcode.resumption.head import state_at_rest
from gcode.resumption.rest import Rest, rest_without
from gcode.resumption.standing import standing_field

SETUP = load_setup("generic_marlin", "pla", "repair_0.20")
BLOCKS = [Block(14.0 * k, 0.0, (8.0, 8.0, 1.6)) for k in range(3)]


@pytest.fixture(scope="module")
def job() -> Job:
    plain = labelled(BLOCKS, SETUP)
    text = mark(plain.text, "job.gcode", "octoprint", LooksAsked(every=2, final=False)).text
    return read_job(Program(text, plain.dialect), dialect=plain.dialect)


@pytest.fixture(scope="module")
def stops(job: Job) -> tuple[Stop, ...]:
    found = marked_stops(job, "job.gcode", start=0)
    assert len(found) >= 3
    return found


def without(job: Job, name: str, line: int, stops: list[int]) -> Rest:
    """As the loop writes it, from where the nozzle rests beside a look."""
    _, parked = park(SETUP, state_at_rest(job, line))
    return rest_without(
        job, [name], SETUP, first=line, parked=parked,
        pulled_mm=parked.pulled_mm,
        standing=standing_field(job.beads, line, SETUP.printer),
        stops=sorted({*(layer.end_line for layer in job.layers), *stops}),
    )  # fmt: skip


def commands(lines: list[str]) -> list[str]:
    return [c for c in map(command_in, lines) if c and not c.startswith("@")]


class Reader:
    """A wire on which the plugin reads a job."""

    def __init__(self, job: Job) -> None:
        text = job.program.text.encode()
        self.text, self.rows = JobText(text), JobText(text).rows
        self.wire = Wire(self.rows).begin()

    @property
    def line(self) -> int:
        return self.wire.next

    def go_on(self, anew: Rewritten) -> list[str]:
        """To the next look, or to the end; what was sent meanwhile."""
        edits = [(self.text.start(e.first), self.text.start(e.end), e.commands)
                 for e in anew.edits(self.rows) if e.first >= self.line]  # fmt: skip
        before = len(self.wire.executed)
        self.wire.held.go_on(edits=edits)
        self.wire.settle()
        while not self.wire.on_hold and self.line < len(self.rows):
            self.wire.settle()
        return commands(self.wire.executed[before:])


@pytest.mark.parametrize("name", ["0", "1", "2"])
def test_the_file_that_is_read_on_gives_the_program_that_was_checked(
    job: Job, stops: tuple[Stop, ...], name: str
) -> None:
    """From look to look, line by line; of the given up object nothing."""
    reader = Reader(job)
    while not reader.wire.on_hold:
        reader.wire.settle()
    line = stops[0].line
    assert reader.line == line
    rest = without(job, name, line, [stop.line for stop in stops])
    anew = Rewritten(rest.checked, rest.line_of - rest.first_line)
    at = 0
    for stop in (*stops[1:], None):
        sent = reader.go_on(anew)
        end = anew.total if stop is None else anew.ours(stop.line)
        if stop is not None:
            assert reader.line == anew.theirs(end) == stop.line
        assert sent == commands(list(rest.checked.lines(at, end)))
        at = end
    assert reader.line == len(reader.rows)


def test_a_second_object_is_given_up_later(job: Job, stops: tuple[Stop, ...]) -> None:
    reader = Reader(job)
    while not reader.wire.on_hold:
        reader.wire.settle()
    lines = [stop.line for stop in stops]
    rest = without(job, "1", lines[0], lines)
    course = Course(job).anew(rest)
    reader.go_on(Rewritten(rest.checked, rest.line_of - rest.first_line))
    now = course.line(lines[1])
    assert set(objects_of(rest.job).names) == {"0", "1", "2"}
    second = without(rest.job, "0", now, [course.line(line) for line in lines])
    anew = Rewritten(second.checked, course.own_lines(second) - second.first_line)
    assert anew.theirs(0) == reader.line == lines[1]
    at = 0
    for line in (*lines[2:], None):
        end = anew.total if line is None else anew.ours(line)
        assert reader.go_on(anew) == commands(list(second.checked.lines(at, end)))
        at = end
    left = read_job(second.job.program, dialect=SETUP.printer.dialect).beads
    high = left.end_mm[left.line >= now]
    assert BLOCKS[2].holds(high[:, :2]).all()


def test_what_is_sent_at_a_comment_goes_with_the_command_before_it() -> None:
    class Text:
        def __init__(self, rows: list[str]) -> None:
            self.rows = rows
            self.program = Program("\n".join(rows) + "\n", "marlin")

        def lines(self, first: int, end: int) -> list[str]:
            return self.rows[first:end]

    job = ["G1 X0", "G1 X1", "; a", "G1 X2", "G1 X3", "; b", "@amrepair scan", "G1 X4", ""]
    new = Text(["G1 X1", "G0 X9", "M106", "G1 X3", "G0 X8", "@amrepair scan", "G0 Z9", "G1 X4"])
    line_of = np.array([-1, 0, 1, 3, 3, 4, 5, 7, 8, 8])
    assert Rewritten(new, line_of).edits(job) == [
        Edit(1, 2, ("G1 X1", "G0 X9", "M106")),
        Edit(3, 5, ("G1 X3", "G0 X8", "G0 Z9")),
    ]
