"""`CheckedProgram`: the proof that a program has passed. Only the checker can make one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn, SupportsIndex

from gcode.check.findings import Policy, Warned
from gcode.errors import LocalProtocolError
from gcode.moves import Program

_PROOF = object()


@dataclass(frozen=True, slots=True)
class CheckReport:
    """What was judged.

    Attributes
    ----------
    commands, moves
        How many there were.
    swept
        Whether the tool head was swept against what stands on the bed.
    least_clearance_mm
        The smallest distance by which a part of the head above the tip cleared it; None where
        nothing was swept.
    policy
        The policy by which it was judged.
    warnings
        What goes beyond the profiles' figures, where the policy permits that.
    added
        Lines that were added at its end because it left heaters on.
    """

    commands: int
    moves: int
    swept: bool
    least_clearance_mm: float | None
    policy: Policy = Policy.STRICT
    warnings: tuple[Warned, ...] = ()
    added: tuple[str, ...] = ()


class CheckedProgram:
    """A program that `gcode.check.check` has passed.

    Raises
    ------
    LocalProtocolError
        If anybody else makes, copies or unpickles one.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> program = gcode.Program(Path("job.gcode").read_text(), "prusa")
    >>> checked = gcode.check_program(program, gcode.load_setup())
    >>> checked.printer_id, checked.report.swept
    ('prusa_mk3s', False)
    """

    __slots__ = ("_lines", "_printer_id", "_program", "_report")

    def __init__(
        self, program: Program, printer_id: str, report: CheckReport, *, token: object = None
    ) -> None:
        if token is not _PROOF:
            raise LocalProtocolError(
                "Only gcode.check.check() makes a CheckedProgram; run it on the program."
            )
        self._program = program
        self._printer_id = printer_id
        self._report = report
        self._lines: tuple[str, ...] | None = None

    @property
    def program(self) -> Program:
        """The text, with lines added at its end, and its dialect."""
        return self._program

    @property
    def printer_id(self) -> str:
        """The profile that it was checked for."""
        return self._printer_id

    @property
    def report(self) -> CheckReport:
        """What was judged."""
        return self._report

    def lines(self, first: int, end: int) -> Sequence[str]:
        """Lines of the half-open range [first, end)."""
        if self._lines is None:  # for who sends it; to know that it is good takes none of them
            self._lines = tuple(self._program.text.split("\n"))
        return self._lines[first:end]

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise LocalProtocolError("A CheckedProgram is not copied or stored; check it anew.")


def _prove(program: Program, printer_id: str, report: CheckReport) -> CheckedProgram:
    """For `checker` alone."""
    return CheckedProgram(program, printer_id, report, token=_PROOF)
