"""What is left of a job, written anew, by the lines of the job's file, which a server still reads.

A server's printer reads on in its file; other commands are sent in the place of those in it. So
lines and looks of the file keep their numbers, and what the printer gets is, line by line, the
program that was checked. How a server is told is in `octoprint_job`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from gcode.errors import LinkError
from gcode.hosts.port import PrintableProgram
from gcode.protocol import command_in

AT = "@"
"""Begins a line that is the server's, not the printer's: it is never left out."""


@dataclass(frozen=True, slots=True)
class Edit:
    """Commands that are sent in the place of the file's lines [first, end), where they have some.

    Attributes
    ----------
    end
        After a line that has a command: once that is read, these are sent.
    """

    first: int
    end: int
    commands: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Rewritten:
    """A program in the place of a job's last lines.

    Attributes
    ----------
    line_of
        (m + 1,) by line of the job, and its end: the program's line that stands for it; below 0
        before what is written anew.
    """

    checked: PrintableProgram
    line_of: Int[np.ndarray, " m"]

    @property
    def total(self) -> int:
        """Lines of the program."""
        return self.checked.program.line_count

    def ours(self, line: int) -> int:
        """The program's line for one of the job's."""
        return max(0, int(self.line_of[min(line, len(self.line_of) - 1)]))

    def theirs(self, line: int) -> int:
        """The first of the job's lines for one of the program's."""
        return int(np.searchsorted(self.line_of, line))

    def edits(self, job: Sequence[str]) -> list[Edit]:
        """What is sent in the place of what, in order.

        Parameters
        ----------
        job
            (m,) the file's lines.

        Raises
        ------
        LinkError
            If a command would have to be sent where the file has none.
        """
        text = self.checked.lines(0, self.total)
        found: list[Edit] = []
        last = -1  # of the file's commands
        ahead: list[str] = []  # what is to be sent with the next of them
        for line in range(int(np.searchsorted(self.line_of, 0)), len(job)):
            first, end = self.line_of[line : line + 2]
            sent = [c for c in map(command_in, text[first:end]) if c and not c.startswith(AT)]
            looks = job[line].startswith(AT)
            own = "" if looks else command_in(job[line])
            if own:
                last, sent, ahead = line, [*ahead, *sent], []
                if sent != [own]:
                    found.append(Edit(line, line + 1, tuple(sent)))
            elif sent and last >= 0:  # with the command before it: before a look, too
                _add(found, last, command_in(job[last]), sent)
            else:
                ahead += sent
            if looks:
                if ahead:
                    raise LinkError(f"{ahead[0]!r} is to be sent before line {line + 1}, a look")
                last = -1
        if ahead:
            raise LinkError(f"the file ends before {ahead[0]!r}, which is to be sent after it")
        return _joined(found, job)


def _add(found: list[Edit], line: int, own: str, sent: list[str]) -> None:
    """More with a command of the file's, which is itself sent where no edit says otherwise."""
    if found and found[-1].end == line + 1:
        found[-1] = Edit(line, line + 1, (*found[-1].commands, *sent))
    else:
        found.append(Edit(line, line + 1, (own, *sent)))


def _joined(found: list[Edit], job: Sequence[str]) -> list[Edit]:
    """What is left out, with what comes next, where nothing is sent between."""
    joined: list[Edit] = []
    for one in found:
        first = one.first
        if joined and not joined[-1].commands:
            between = job[joined[-1].end : first]
            if not any(line.startswith(AT) or command_in(line) for line in between):
                first = joined.pop().first
        joined.append(Edit(first, one.end, one.commands))
    return joined
