"""`check`: all rules over one program; the only maker of a `CheckedProgram`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from gcode.check.contact import Contact, contact_of
from gcode.check.findings import Moves, Policy, Refusal, Text, Touch
from gcode.check.hanging import JobBridges, hanging
from gcode.check.proof import CheckedProgram, CheckReport, _prove
from gcode.check.rules import Judge
from gcode.check.sweep import sweep
from gcode.check.words import KNOWN_COMMANDS
from gcode.errors import CheckRefusedError, InputError
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.surfaces import HeightField

SAY_EVERY_LINES = 20_000  # some hundredths of a second
OUR_MARK = re.compile(r"^;AMREPAIR:", re.MULTILINE)  # before each script that our writer puts in


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a program was found to be.

    Attributes
    ----------
    refusals
        In the program's order; empty where nothing speaks against it.
    report
        What was judged, by which policy, with its warnings and what was added at the end.
    contact
        Where the head first touches what stands there; None where it does not, or nothing stands.
    moves
        All moves with known ends, for a picture; None where nothing stands that they might touch.
    """

    refusals: tuple[Refusal, ...]
    report: CheckReport
    contact: Contact | None = None
    moves: Moves | None = None


def policy_of(program: Program) -> Policy:
    """Whose program it is: strict for our own, by the marks that our writer leaves in it."""
    return Policy.STRICT if OUR_MARK.search(program.text) else Policy.DANGER


def find_refusals(
    program: Program,
    setup: PrintSetup,
    *,
    as_built: HeightField | None = None,
    initial: ModalState | None = None,
    policy: Policy = Policy.STRICT,
    patch: bool | JobBridges = False,
) -> tuple[Refusal, ...]:
    """Everything that speaks against printing a program, in its order; see `check`."""
    return judge(
        program, setup, as_built=as_built, initial=initial, policy=policy, patch=patch
    ).refusals


def check(
    program: Program,
    setup: PrintSetup,
    *,
    as_built: HeightField | None = None,
    initial: ModalState | None = None,
    policy: Policy = Policy.STRICT,
    leave_heaters: bool = False,
    touches: tuple[Touch, ...] = (),
    patch: bool | JobBridges = False,
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
    policy
        `policy_of` tells which suits a file. By `DANGER` the report has warnings, and heaters that
        the program leaves on are switched off by lines at its end.
    leave_heaters
        The program may leave its heaters on.
    touches
        Where the program may feel for what stands there (G38.2), and how deep; nowhere else.
    patch
        It fills something in `as_built`: what it lays over air is judged as well; by what its job
        bridges too, where that is known.

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
    verdict = judge(
        program, setup, as_built=as_built, initial=initial, policy=policy,
        leave_heaters=leave_heaters, touches=touches, patch=patch, progress=progress,
    )  # fmt: skip
    refusals = verdict.refusals
    if refusals:
        more = f" (and {len(refusals) - 1} more)" if len(refusals) > 1 else ""
        raise CheckRefusedError(f"The checker refuses the program: {refusals[0]}{more}.", refusals)
    if verdict.report.added:
        text = "\n".join([program.text.rstrip("\n"), *verdict.report.added, ""])
        program = Program(text, program.dialect)
    return _prove(program, setup.printer.id, verdict.report)


def judge(
    program: Program,
    setup: PrintSetup,
    *,
    as_built: HeightField | None = None,
    initial: ModalState | None = None,
    policy: Policy = Policy.STRICT,
    leave_heaters: bool = False,
    touches: tuple[Touch, ...] = (),
    patch: bool | JobBridges = False,
    progress: Progress = silent,
) -> Verdict:
    """What `check` goes by, for whoever wants to know and not to print."""
    if program.dialect not in KNOWN_COMMANDS:
        raise InputError(
            f"There is no dialect '{program.dialect}' to check; "
            f"there are {', '.join(KNOWN_COMMANDS)}."
        )
    if as_built is not None:
        _ = setup.printer.head  # nobody judges what a head of unknown shape would hit
    top_mm = as_built.top_mm if as_built is not None else None
    one = Judge(program, setup, top_mm, initial, policy, touches)
    text = Text.of(program.text)
    if as_built is not None:
        one.moves.with_room_for(len(text))  # a table that grows is held twice while it does
    number, said = 1, 0
    while number <= len(text):
        number = one.follow(text, number, min(len(text), said + SAY_EVERY_LINES) + 1)
        if number - said > SAY_EVERY_LINES:
            if as_built is None:
                one.moves.forget()
            progress("check", float(number - 1), float(len(text)))
            said = number - 1
        elif number <= len(text):
            one.read(number, text.line(number))
            number += 1
    one.end(text, leave_heaters=leave_heaters)
    progress("check", float(len(text)), float(len(text)))
    refusals, clearance_mm = list(one.refusals), math.inf
    contact = None
    if as_built is not None:
        progress("sweep", 0.0, 1.0)
        hits, clearance_mm = sweep(one.moves, text, setup.printer, as_built)
        progress("sweep", 1.0, 1.0)
        refusals += hits
        if patch is not False:
            job = patch if isinstance(patch, JobBridges) else None
            refusals += hanging(one.moves, text, setup, as_built, job)
        if hits:
            contact = contact_of(hits[0], one.moves, setup.printer, as_built)
    refusals.sort(key=lambda refusal: refusal.line)
    report = CheckReport(
        commands=one.commands,
        moves=one.moves.told,
        swept=as_built is not None,
        least_clearance_mm=clearance_mm if math.isfinite(clearance_mm) else None,
        policy=policy,
        warnings=one.warnings.told(),
        added=one.added,
    )
    return Verdict(tuple(refusals), report, contact, one.moves if as_built is not None else None)
