"""The printer by way of the tape: what the tape says was sent is not sent again.

Everything that a run has the printer do goes through here, the touches of its own probe as well.
It does not know why something is sent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any, Protocol, runtime_checkable

from amrepair.errors import InputError, LoopError
from amrepair.loop.tape import REST, TOUCH, Sent, Tape, report_from_json
from gcode.check import CheckedProgram
from gcode.hosts.port import Printer, PrintReport, PullsAtRest, TellsTouches
from gcode.hosts.touching import felt
from gcode.progress import Progress, silent

PickUp = Callable[[Sequence[Sent], Progress], PrintReport | None]
"""Finds out where the printer is, and has it finish what it was sent last, telling how far."""
OF_THE_JOB = ("job", "rest")
"""Kinds of what is sent that are the job's own lines: who sends them tells where they ended."""


class Wire:
    """A printer, and the tape of what it was sent.

    Parameters
    ----------
    tape
        By default one that remembers nothing.
    pick_up
        Called before the first thing that the tape lacks, with all that was sent before.
    """

    def __init__(
        self, printer: Printer, tape: Tape | None = None, pick_up: PickUp | None = None
    ) -> None:
        self._printer, self._tape, self._pick_up = printer, tape or Tape(), pick_up
        self._sent: list[Sent] = []

    def send(
        self,
        kind: str,
        checked: CheckedProgram,
        first: int = 0,
        end: int | None = None,
        progress: Progress = silent,
    ) -> PrintReport | None:
        """Print lines [first, end) of a program, or find on the tape that they were.

        None where the tape is only read, or ends with their last line acknowledged.

        Raises
        ------
        LoopError
            If what is none of the job's own lines was cancelled at the printer.
        """
        if self._tape.only_read:
            return None
        end = checked.program.line_count if end is None else end
        done, report = self._begin(Sent(kind, checked, first, end, done=False), progress)
        if done is not None:
            return report_from_json(done["report"])
        if report is None:
            report = self._printer.print(checked, lines=range(first, end), progress=progress)
        if report.ok:
            self._printer.finish_moves()
            self._end(report=asdict(report))
        elif kind not in OF_THE_JOB:
            raise LoopError(
                f"the {kind} was stopped at its line {report.next_line + 1} of {end}, by whoever "
                "is at the printer; heaters were told to switch off"
            )
        return report

    def touch(self, checked: CheckedProgram, told: Callable[[], None]) -> list[float]:
        """Carry out a program of touches, or find on the tape where they met something.

        A program that a kill cut short is begun anew: it lays nothing, and may touch twice.

        Parameters
        ----------
        told
            Called at each touch.

        Returns
        -------
        list of float
            Z by the firmware, mm, of each touch in order.

        Raises
        ------
        InputError
            If the printer does not tell where a touch ended.
        gcode.errors.PrinterError
            If nothing is felt; the heaters are off then.
        """
        printer = touching(self._printer)
        end = checked.program.line_count
        done, _ = self._begin(Sent(TOUCH, checked, 0, end, done=False))
        if done is not None:
            for _ in done["met_mm"]:
                told()
            return [float(z_mm) for z_mm in done["met_mm"]]
        met_mm = felt(printer, checked, at_contact=told)
        self._end(met_mm=met_mm)
        return met_mm

    def note(self, event: str, **said: Any) -> dict[str, Any]:
        """What the tape has of an event; where it has nothing, what is said is put on it."""
        taped = self._tape.next(event)
        if taped is not None:
            return {key: taped[key] for key in said}
        self._tape.write(event, **said)
        return said

    def pulled_at_rest_mm(self) -> float:
        """Filament that the printer's own pause has pulled back; 0 where it has none of its own."""
        if not isinstance(self._printer, PullsAtRest):
            return 0.0
        taped = self._tape.next_if(REST)
        if taped is not None:
            return float(taped["pulled_mm"])
        if not self._tape.live:
            return 0.0  # a record of before it was told
        self.go_live()
        pulled_mm = self._printer.pulled_at_rest_mm()
        self._tape.write(REST, pulled_mm=pulled_mm)
        return pulled_mm

    def go_live(self, progress: Progress = silent) -> None:
        """Before the first thing that the tape lacks: where is the printer?"""
        if self._pick_up is not None:
            progress("connect", 0.0, 1.0)
            self._find(silent)
            progress("connect", 1.0, 1.0)

    def _find(self, progress: Progress) -> PrintReport | None:
        """The printer, and the report of what it has finished only now."""
        if self._pick_up is None:
            return None
        progress("printing", 0.0, 1.0)
        pick_up, self._pick_up = self._pick_up, None
        return pick_up(tuple(self._sent), progress)

    def _begin(
        self, one: Sent, progress: Progress = silent
    ) -> tuple[dict[str, Any] | None, PrintReport | None]:
        """What the tape has of the end of what is to be sent; else it is on the tape now.

        With it comes the report of whoever has finished it after a kill.
        """
        began = self._tape.next("send")
        if began is None:
            self._find(progress)
            self._tape.write(
                "send", kind=one.kind, sha256=one.checked.program.sha256, first=one.first,
                end=one.end,
            )  # fmt: skip
            self._sent.append(one)
            return None, None
        _require_same(began, one)
        if not self._tape.live:
            self._sent.append(replace(one, done=True))
            return self._tape.next("sent"), None
        self._sent.append(one)
        return None, self._find(progress)

    def _end(self, **said: Any) -> None:
        self._sent[-1] = replace(self._sent[-1], done=True)
        self._tape.write("sent", **said)


def touching(printer: Printer) -> TellsTouches:
    """The printer, as one that tells where a touch ended.

    Raises
    ------
    InputError
        If it does not.
    """
    if not isinstance(printer, TellsTouches):
        raise InputError(
            "--scanner probe needs the printer's own port (--port /dev/ttyACM0, or Klipper's "
            "/tmp/printer), or 'amrepair agent' beside its server: this server or file does not "
            "tell where a touch ended"
        )
    return printer


@runtime_checkable
class Mover(Protocol):
    """A scanner that has the printer move: what it sends is on the run's tape."""

    def send_by(self, wire: Wire) -> None:
        """Send by this wire from now on."""


def _require_same(began: dict[str, object], one: Sent) -> None:
    """A resumed run must come to the very lines that were sent."""
    said = (began["kind"], began["sha256"], began["first"], began["end"])
    if said != (one.kind, one.checked.program.sha256, one.first, one.end):
        raise LoopError(
            f"the record says that '{said[0]}' was sent there, lines {said[2]} to {said[3]} of "
            f"{str(said[1])[:12]}, this run comes to '{one.kind}', lines {one.first} to {one.end} "
            f"of {one.checked.program.sha256[:12]}; the job, the profiles or the program have "
            "changed"
        )
