"""A job that OctoPrint prints from its own file, with our plugin in it: see `served_job`.

The plugin holds the job at its looks, so that nothing of it is sent until we let it go on. What is
printed at a look is handed over whole: the plugin sends it, line by line, and counts. So a program
that was begun is finished though we are killed, and what OctoPrint forgets when it is restarted is
its whole print.
"""

from __future__ import annotations

import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Int

from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts.job_text import JobText
from gcode.hosts.modes import commands_of
from gcode.hosts.octoprint import OctoPrintPrinter
from gcode.hosts.octoprint_session import OctoPrintSession
from gcode.hosts.port import NothingMetError, PrintableProgram
from gcode.hosts.rewritten import Rewritten
from gcode.hosts.served_job import AGENT, ServedJob, UnderWay, number_of
from gcode.hosts.server import ServerReach
from gcode.hosts.web import LIFT_COMMANDS, json_object, part_of, sentence
from gcode.progress import Progress, silent

PLUGIN = f"/plugin/{AGENT}"
OTHER_AGENT_GOES_S = 8.0
"""An agent that was killed is missed by then, and another may come."""
HERE_EVERY_S = 2.0
BOM = b"\xef\xbb\xbf"


class OctoPrintJob(ServedJob[OctoPrintSession], OctoPrintPrinter):
    """A printer whose job OctoPrint prints by itself; parameters of `ServerPrinter`."""

    def _new_session(self, reach: ServerReach) -> OctoPrintSession:
        self._held_back = threading.Event()
        self._id = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:6]}"
        self._heard, self._here_s = 0, -HERE_EVERY_S
        self._page: dict[str, str] = {}
        self._asked_about: dict[str, Any] = {}
        return OctoPrintSession(reach, plugin=AGENT)

    def _refuse_unless_ready(self) -> None:
        """It is there to be served while it prints, and when nothing is printed."""

    # ------------------------------------------------------------------ the plugin

    def _state(self) -> dict[str, Any]:
        """How the plugin stands; it hears that we are here."""
        return self._tell("here", **self._page)

    def _tell(self, what: str, **said: Any) -> dict[str, Any]:
        """Ask the plugin for something; its state after that.

        Raises
        ------
        PortBusyError
            If another agent serves the printer.
        PrinterError
            If the plugin refuses.
        """
        body = {"agent": self._id, **said}
        answer = self._session.web.request("POST", f"{PLUGIN}/{what}", json=body)
        if answer.status_code == 404:
            raise LinkError(
                f"{self.address.name} has no amrepair plugin; install amrepair into OctoPrint's "
                "environment ('pip install --no-deps amrepair') and restart it."
            )
        if answer.status_code == 423:
            raise PortBusyError(
                f"another agent named {AGENT!r} serves the printer behind {self.address.name}; "
                "end that one first."
            )
        if answer.status_code == 409:
            raise PrinterError(f"{self.address.name}: {sentence(answer)}")
        told = json_object(answer)
        if answer.status_code != 200 or told is None:
            raise LinkError(f"{self.address.name} does not answer {what} ({sentence(answer)}).")
        self._asked_about, self._here_s = told, self._clock()
        return told

    def require_partner(self) -> None:
        """Refuse a server without our plugin, or whose plugin another agent serves.

        Raises
        ------
        PortBusyError
            If that agent does not go within `OTHER_AGENT_GOES_S`.
        """
        until_s = self._clock() + OTHER_AGENT_GOES_S
        while True:
            try:
                calls = self._state()["calls"]
            except PortBusyError:
                if self._clock() > until_s:
                    raise
                time.sleep(self._timing.poll_s)
            else:
                self._heard = max((row["number"] for row in calls), default=0)
                return

    @contextmanager
    def showing(self, page: str, token: str | None) -> Iterator[None]:
        """Have the run's live page shown in the tab."""
        self._page = {"page": page, "token": token or ""}
        try:
            self._state()
            yield
        finally:
            self._page = {}

    def show(self, what: str, **said: Any) -> None:
        """Have something shown in the tab."""
        self._tell(what, **said)

    def calls(self, wait_s: float) -> list[dict[str, Any]]:
        """What people have asked for in the tab since the last time; waits for some."""
        session = self._session
        with session.news:
            session.news.wait_for(lambda: bool(self._new_calls()), wait_s)
        if self._clock() - self._here_s > HERE_EVERY_S:
            try:
                self._state()
            except LinkError:
                return []
        found = self._new_calls()
        if found:
            self._heard = found[-1]["number"]
        return found

    def _new_calls(self) -> list[dict[str, Any]]:
        rows = [*self._session.state.told.get("calls", ()), *self._asked_about.get("calls", ())]
        new = {row["number"]: row for row in rows if row["number"] > self._heard}
        return [new[number] for number in sorted(new)]

    # ------------------------------------------------------------------ which job

    @property
    def _downloads(self) -> str:
        return "/downloads/files/local"

    def _text_of(self, data: bytes) -> JobText:
        """As OctoPrint counts its bytes: those of what it has read as UTF-8."""
        text = data.removeprefix(BOM).decode("utf-8", "replace")
        return JobText(text.encode("utf-8"))

    def under_way(self) -> UnderWay | None:
        """The print that OctoPrint has begun and not ended; None where there is none."""
        told = part_of(self._state(), "print")
        if not told or told.get("ended"):
            return None
        return UnderWay(str(told["path"]), str(told["id"]))

    def pass_by(self) -> None:
        """Go on without a look."""
        self._tell("go_on", behind=0)

    def forget_steps(self) -> None:
        """What an earlier run had printed is none of this one's."""
        self._tell("forget")

    # ------------------------------------------------------------------ printing

    def _refresh(self) -> None:
        if not self._session.listening:
            self._session.listen()
        self._state()

    def _rest(self) -> tuple[bool, int]:
        told = part_of(self._state(), "print")
        byte = int(told.get("byte") or 0)
        return bool(told.get("rests")), self._text.line_at(byte)

    def _has_it(self) -> bool:
        return bool(part_of(self._asked_about, "print").get("path") == self._name)

    def _pending(self) -> bool:
        return False

    def _go_on(self, line: int, first: int) -> None:
        behind = self._text.start(first) if first != line else 0
        self._tell("go_on", behind=behind, edits=self._edits(max(line, first)))

    def rewrite(self, rest: PrintableProgram, line_of: Int[np.ndarray, " m"]) -> None:
        """From where the nozzle rests, have this program printed in the place of the job's rest."""
        self._rest_anew = Rewritten(rest, line_of)
        self._edits(0)  # refused before anything goes on

    def _edits(self, line: int) -> list[tuple[int, int, list[str]]]:
        """Bytes of the file, and what is sent in the place of its commands there, from a line on.

        Commands are known by the byte behind their line.
        """
        if self._rest_anew is None:
            return []
        return [
            (self._text.start(e.first), self._text.start(e.end), list(e.commands))
            for e in self._rest_anew.edits(self._text.rows)
            if e.first >= line
        ]

    def _how_it_ended(self, end: int) -> bool | None:
        told = part_of(self._asked_about, "print")
        ended = told.get("ended")
        if not ended or told.get("path") != self._name:
            return None
        if ended == "cancelled":
            return False
        if ended == "done":
            return self._complete(end, "are lines with @ taken out of it?")
        raise PrinterError(f"{self.address.name}: the print of {self._name} failed ({ended})")

    # ------------------------------------------------------------------ at rest

    def _print_at_rest(self, checked: PrintableProgram, lines: range, progress: Progress) -> None:
        """Hand a program over, and wait until the plugin has had it printed."""
        commands = [text for _, text in commands_of(checked, lines.start, lines.stop)]
        if commands:
            self._hand_over(number_of(checked), commands, progress)

    def _hand_over(
        self, number: int, commands: Sequence[str], progress: Progress, *, touches: bool = False
    ) -> str:
        """Have commands printed at the look; what the firmware said against a touch."""
        send, lines = uuid.uuid4().hex, list(commands)
        self._asked(
            lambda: self._tell("program", number=number, send=send, lines=lines, touches=touches)
        )
        while True:
            told = part_of(self._asked(self._state), "program")
            if told.get("number") != number:
                raise PrinterError(
                    f"{self.address.name} has let go of what was printed at the look: the print "
                    "was cancelled, or OctoPrint or its printer restarted; nothing is printed twice"
                )
            progress("printing", float(told["done"]), float(len(commands)))
            if told["over"]:
                return str(told.get("wrong") or "")
            self.wait(self._timing.poll_s)

    # ------------------------------------------------------------------ touches

    def require_touches(self) -> None:
        """Any firmware that knows its dialect's touch will do; one that does not says so."""

    def touch(
        self, checked: PrintableProgram, lines: range, *, progress: Progress = silent
    ) -> float:
        """Carry out lines, the last of them a touch; where it met something, mm in G-code's Z."""
        commands = [text for _, text in commands_of(checked, lines.start, lines.stop)]
        said = self._hand_over(number_of(checked), commands, progress, touches=True)
        if not said:
            return self._asked(self.position_mm)[2]
        self._hand_over(0, LIFT_COMMANDS, silent, touches=True)
        self.heaters_off()
        if "nknown command" in said:
            raise PrinterError(
                f"The printer's firmware does not know {commands[-1].split()[0]} ({said}), so "
                "nothing was touched; the nozzle was lifted and the heaters are off."
            )
        raise NothingMetError(f"the firmware says: {said}")

    def _reached_at_rest(self, checked: PrintableProgram, lines: range) -> int:
        told = part_of(self._asked_about, "program")
        return lines.stop if told.get("number") == number_of(checked) else lines.start

    def _settled(self) -> None:
        """The plugin finishes what it was given."""
        while True:
            self._refresh()
            told = part_of(self._asked_about, "program")
            if not told or told["over"]:
                return
            self.wait(self._timing.poll_s)

    def _heat_of_before(self) -> tuple[tuple[float, ...], float]:
        told = part_of(self._asked_about, "heat")
        return tuple(float(c) for c in told.get("hotends") or ()), float(told.get("bed") or 0.0)

    # ------------------------------------------------------------------ pause, safety

    def pause(self) -> None:
        """Hold what is printed at a look; have OctoPrint pause where the job goes on."""
        if part_of(self._state(), "print").get("rests"):
            self._tell("pause", value=True)
        else:
            super().pause()

    def resume(self) -> None:
        """Go on."""
        if part_of(self._state(), "print").get("rests"):
            self._tell("pause", value=False)
        else:
            super().resume()

    def heaters_off(self) -> None:
        """Switch heaters off where our job rests; one that OctoPrint prints goes on.

        What they were set to stays with the plugin, for whoever goes on.
        """
        told = part_of(self._state(), "print")
        if told and not told.get("ended") and not told.get("rests"):
            return
        hotends_c, bed_c = self._heat_at_look
        self._tell("off", hotends=list(hotends_c), bed=bed_c)

    def leave(self, way_back: Sequence[PrintableProgram]) -> None:
        """What leads back to the job, for somebody who lets it go on without us.

        None to a job that is written anew: only we know what stands there.
        """
        if self._rest_anew is not None:
            return
        lines = [
            text for one in way_back for _, text in commands_of(one, 0, one.program.line_count)
        ]
        self._tell("leave", lines=lines)
