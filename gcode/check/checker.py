"""`check`: applies all rules to one program. Nothing else can make a `CheckedProgram`.

The text is followed line by line with the machine's state (`motion`, `rules`). Where something
stands on the bed, the tool head is then swept along all moves (`sweep`), and what a patch lays over
air is judged (`hanging`).
"""

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
    """The result of judging a program.

    Attributes
    ----------
    refusals
        The reasons against printing it, in the program's order; empty where there are none.
    report
        What was judged and by which policy, with warnings and with lines added at the end.
    contact
        Where the head first touches what stands there; None where it touches nothing.
    moves
        All moves with known ends, for a picture; None where nothing stands on the bed.
    """

    refusals: tuple[Refusal, ...]
    report: CheckReport
    contact: Contact | None = None
    moves: Moves | None = None


def policy_of(program: Program) -> Policy:
    """The policy that suits a program: strict for our own, known by the marks of our writer."""
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
    """All reasons against printing a program, in its order; see `check`."""
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
    """Judge a program, and prove that it may be printed.

    Parameters
    ----------
    setup
        The printer that the program is for, and its material.
    as_built
        The heights of what stands on the bed, build frame. The tool head is swept against it, and
        the program must not home Z.
    initial
        The machine's state before the first line, for a program in mid-job. None stands for a
        machine that is cold and not homed; with `as_built`, one whose Z is still true.
    policy
        How strictly to judge; `policy_of` tells which policy suits a file. By `DANGER` some
        refusals become warnings, and heaters left on are switched off by lines added at the end.
    leave_heaters
        Whether the program may leave its heaters on.
    touches
        Where, and how deep, the program may feel with the nozzle for what stands there (G38.2).
    patch
        Whether the program fills something in `as_built`, so that what it lays over air is judged
        as well; and where it is known, what the patch's job bridges.

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
    """Judge a program without proving anything: for those who want to know, not to print."""
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
