"""The `Printer` port: what any machine can be asked for, whatever carries the bytes.

Its adapters are modules beside this one: `serial`, `octoprint`, `moonraker` and `file`. A printer
prints checked programs only; it does not judge, make or alter them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int

from gcode.errors import LinkError, PrinterError
from gcode.moves import Program
from gcode.progress import Progress, silent
from gcode.protocol.events import Capability, FirmwareInfo


@runtime_checkable
class PrintableProgram(Protocol):
    """What a host needs of a `CheckedProgram`."""

    @property
    def program(self) -> Program:
        """The program's text and dialect."""

    def lines(self, first: int, end: int) -> Sequence[str]:
        """Lines of the half-open range [first, end)."""


@dataclass(frozen=True, slots=True)
class Temperatures:
    """Current and target temperatures, °C; the bed is None where there is none.

    Attributes
    ----------
    hotend_c, hotend_target_c
        Of the chosen head; where the printer does not say which is chosen, of the head with the
        highest target.
    targets_c
        The targets of all heads, where there are several.
    """

    hotend_c: float
    hotend_target_c: float
    bed_c: float | None
    bed_target_c: float | None
    targets_c: tuple[float, ...] = ()

    @property
    def hotend_targets_c(self) -> tuple[float, ...]:
        """The target of each head."""
        return self.targets_c or (self.hotend_target_c,)

    @property
    def set_c(self) -> tuple[float, ...]:
        """The targets of the heaters that are not off."""
        return tuple(c for c in (*self.hotend_targets_c, self.bed_target_c) if c)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a firmware says of itself (M115)."""

    firmware: str
    caps: dict[str, bool] = field(default_factory=dict)

    @classmethod
    def told(cls, answers: Iterable[object]) -> Capabilities:
        """Read from the answers to M115."""
        firmware, caps = "", {}
        for answer in answers:
            if isinstance(answer, FirmwareInfo):
                firmware = answer.name
            elif isinstance(answer, Capability):
                caps[answer.name] = answer.enabled
        return cls(firmware, caps)


@dataclass(frozen=True, slots=True)
class PrintReport:
    """The result of one `print` call.

    Attributes
    ----------
    ok
        Whether every line is acknowledged, and proved to have been received.
    lines_acked
        Program lines acknowledged (comments and empty lines are never sent).
    first_line, next_line
        The first program line asked for, and the first not known to be executed.
    round_trip_s
        Percentiles 50, 95 and 99 of the time from a line to its `ok`.
    """

    ok: bool
    lines_acked: int
    bytes_sent: int
    seconds: float
    next_line: int
    first_line: int
    resends: int = 0
    stalls: int = 0
    spare_oks: int = 0
    round_trip_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    warnings: tuple[str, ...] = ()


@runtime_checkable
class PullsAtRest(Protocol):
    """A printer on which pauses run a macro of the user, which may pull filament back."""

    def pulled_at_rest_mm(self) -> float:
        """Length of filament that the pause has pulled back, beyond what the job itself had."""


@runtime_checkable
class LeavesOut(Protocol):
    """A printer whose server prints the job and can leave out an object of it by itself."""

    def leave_out(self, name: str) -> None:
        """Print nothing more of the object with this name in the job."""


class NothingMetError(PrinterError):
    """A touch went as deep as it may and met nothing; heaters are off, the nozzle is lifted."""


class PrintsOnError(LinkError):
    """Heaters were told to switch off, and the print that heats them could not be cancelled."""


class LinesInDoubtError(LinkError):
    """Lines of a program may or may not have been executed; they are named, counted from 0.

    Attributes
    ----------
    last_executed_line
        The last program line known to be executed, -1 if none.
    last_sent_line
        No line after this one was ever sent: those between are in doubt.
    """

    def __init__(self, message: str, last_executed_line: int, last_sent_line: int) -> None:
        super().__init__(message)
        self.last_executed_line = last_executed_line
        self.last_sent_line = last_sent_line


class LinkLostError(LinesInDoubtError):
    """The link was lost in mid-job; `why` says what happened to it, in a few words."""

    def __init__(
        self, message: str, last_executed_line: int, last_sent_line: int, *, why: str = ""
    ) -> None:
        super().__init__(message, last_executed_line, last_sent_line)
        self.why = why


class ResumeRefusedError(LinesInDoubtError):
    """A job cannot be resumed."""


@runtime_checkable
class Printer(Protocol):
    """A machine that prints."""

    def connect(self) -> None:
        """Open the link and agree on line numbers.

        Raises
        ------
        LinkError
            If the printer cannot be reached.
        PortBusyError
            If another sender holds it.
        """

    def close(self) -> None:
        """Close the link; harmless when not connected."""

    def capabilities(self) -> Capabilities:
        """Return what the firmware says it can do."""

    def temperatures(self) -> Temperatures:
        """Ask for temperatures."""

    def position_mm(self) -> tuple[float, float, float]:
        """Ask for the logical position, mm."""

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        """Print a checked program, or the part `lines` of it; return when all is acknowledged.

        Several calls in a row make up one job.

        Raises
        ------
        LinkLostError
            If lines are in doubt, naming the interval.
        PrinterError
            If the printer reports a fault of its own.
        """

    def finish_moves(self) -> None:
        """Return when every buffered move has been made (M400)."""

    def pause(self) -> None:
        """Stop after the current line, lift the nozzle; called from another thread than `print`."""

    def resume(self) -> None:
        """Move back to where the pause began, and continue."""

    def abort(self) -> None:
        """End the job: send nothing more, switch heaters off, lift the nozzle."""

    def emergency_stop(self) -> None:
        """Stop everything now; the printer must be reset afterwards."""

    def heaters_off(self) -> None:
        """Switch hotend, bed and fan off."""


@runtime_checkable
class MakesSafe(Protocol):
    """A printer that is left safe whatever it is at, though it may say nothing for minutes."""

    def make_safe(self) -> None:
        """Heaters off and nozzle lifted, by any means left; says loudly if it cannot."""


@runtime_checkable
class TellsTouches(Printer, Protocol):
    """A printer whose server tells where a touch ended."""

    def require_touches(self) -> None:
        """Refuse a printer that knows no touches.

        Raises
        ------
        LinkError
            With what it lacks.
        """

    def touch(
        self, checked: PrintableProgram, lines: range, *, progress: Progress = silent
    ) -> float:
        """Carry out lines of which the last is a touch; the Z at which it met something, mm.

        Raises
        ------
        PrinterError
            If it met nothing: the nozzle is lifted then, and the heaters are off.
        """


@runtime_checkable
class GoesOnAnew(Printer, Protocol):
    """A printer whose server prints the job and can take a rewritten rest of it."""

    def rewrite(self, rest: PrintableProgram, line_of: Int[np.ndarray, " m"]) -> None:
        """Have this program printed, from where the nozzle rests, in place of the job's rest.

        Parameters
        ----------
        line_of
            (m + 1,) for each line of the job, and for its end, the line of the new program that
            replaces it; negative for lines before the rewritten part.
        """
