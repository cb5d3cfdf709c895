"""`check`: all rules over one program; the only maker of a `CheckedProgram`."""

from __future__ import annotations

import math

from gcode.check.findings import Refusal, Text
from gcode.check.proof import CheckedProgram, CheckReport, _prove
from gcode.check.rules import Judge
from gcode.check.sweep import sweep
from gcode.check.words import COMMANDS
from gcode.errors import CheckRefusedError, InputError
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.surfaces import HeightField

SAY_EVERY_LINES = 20_000  # some hundredths of a second


def find_refusals(
    program: Program,
    setup: PrintSetup,
    *,
    as_built: HeightField | None = None,
    initial: ModalState | None = None,
    progress: Progress = silent,
) -> tuple[Refusal, ...]:
    """Everything that speaks against printing a program, in its order; see `check`."""
    return _judge(program, setup, as_built, initial, progress)[0]


def check(
    program: Program,
    setup: PrintSetup,
    *,
    as_built: HeightField | None = None,
    initial: ModalState | None = None,
    progress: Progress = silent,
) -> CheckedProgram:
    """Judge a program.

    Parameters
    ----------
    setup
        The printer that it is for, and its material.
    as_built
        What stands on the bed, build frame; the tool head is swept against it, and Z is not homed.
    initial
        The machine's state before the first line, for a program within a job; None: a machine
        that is cold and not homed (with `as_built`: not homed in X and Y, its Z still true).

    Raises
    ------
    CheckRefusedError
        With every refusal; the message tells the first.

    Examples
    --------
    >>> import gcode
    >>> cold = gcode.Program("G28\\nG1 X50 Y50 E5 F1200\\n", "prusa")
    >>> try:
    ...     gcode.check_program(cold, gcode.load_setup())
    ... except gcode.GcodeError as error:
    ...     print(error)  # doctest: +ELLIPSIS
    The checker refuses the program: ...cold...
    """
    refusals, report = _judge(program, setup, as_built, initial, progress)
    if refusals:
        more = f" (and {len(refusals) - 1} more)" if len(refusals) > 1 else ""
        raise CheckRefusedError(f"The checker refuses the program: {refusals[0]}{more}.", refusals)
    return _prove(program, setup.printer.id, report)


def _judge(
    program: Program,
    setup: PrintSetup,
    as_built: HeightField | None,
    initial: ModalState | None,
    progress: Progress,
) -> tuple[tuple[Refusal, ...], CheckReport]:
    if program.dialect not in COMMANDS:
        raise InputError(
            f"There is no dialect '{program.dialect}' to check; there are {', '.join(COMMANDS)}."
        )
    lines = program.text.split("\n")
    top_mm = as_built.top_mm if as_built is not None else None
    judge = Judge(program, setup, top_mm, initial)
    text = Text.of(program.text)
    number, said = 1, 0
    while number <= len(lines):
        number = judge.follow(text, number, min(len(lines), said + SAY_EVERY_LINES) + 1)
        if number - said > SAY_EVERY_LINES:
            progress("check", float(number - 1), float(len(lines)))
            said = number - 1
        elif number <= len(lines):
            judge.read(number, lines[number - 1])
            number += 1
    judge.end(lines)
    progress("check", float(len(lines)), float(len(lines)))
    refusals, clearance_mm = list(judge.refusals), math.inf
    if as_built is not None:
        progress("sweep", 0.0, 1.0)
        hits, clearance_mm = sweep(judge.moves, lines, setup.printer, as_built)
        progress("sweep", 1.0, 1.0)
        refusals += hits
    refusals.sort(key=lambda refusal: refusal.line)
    report = CheckReport(
        commands=judge.commands,
        moves=judge.moves.count,
        swept=as_built is not None,
        least_clearance_mm=clearance_mm if math.isfinite(clearance_mm) else None,
    )
    return tuple(refusals), report
