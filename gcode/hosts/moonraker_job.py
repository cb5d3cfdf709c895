"""A job that Klipper prints from its own file, reached through Moonraker: see `served_job`.

What is printed at a look goes to the paused printer as short scripts. Before each stands a step of
the printer's own macro, which counts it and refuses it where the job goes on or another step is
due.
"""

from __future__ import annotations

import threading
from typing import Any

from gcode.check.touches import TOUCH_COMMANDS
from gcode.errors import LinkError, PrinterError
from gcode.hosts.modes import commands_of
from gcode.hosts.moonraker import MoonrakerPrinter
from gcode.hosts.moonraker_session import MoonrakerSession
from gcode.hosts.moonraker_state import STOPPED, cause_of
from gcode.hosts.port import NothingMetError, PrintableProgram
from gcode.hosts.served_job import AGENT, ServedJob, UnderWay, either_c, number_of
from gcode.hosts.server import ServerReach
from gcode.hosts.web import LIFT_COMMANDS
from gcode.progress import Progress, silent

METHOD = "amrepair_call"
STEP_MACRO = "_AMREPAIR_STEP"
TOUCH_KEY = f"gcode_macro {TOUCH_COMMANDS['klipper']}"
STEP_LINES = 40
"""Lines a script: some seconds of moves, which Klipper has queued long before they are made."""
WRITTEN_S = 3.0
"""By then a server has long written a new print down; one that it was restarted in it calls
interrupted, and goes on with."""


class KlipperJob(ServedJob[MoonrakerSession], MoonrakerPrinter):
    """A printer whose job Klipper prints by itself; parameters of `ServerPrinter`."""

    _unsure_s: float | None = None

    def _new_session(self, reach: ServerReach) -> MoonrakerSession:
        self._held_back = threading.Event()
        return MoonrakerSession(reach, agent=AGENT, methods=(METHOD,))

    def _refuse_unless_ready(self) -> None:
        """It is there to be served while it prints, and when nothing is printed."""
        self._session.listen()

    # ------------------------------------------------------------------ which job

    def under_way(self) -> UnderWay | None:
        """The print that Klipper has begun and not ended; None where there is none.

        Raises
        ------
        LinkError
            If the server cannot be reached, or no Klipper is behind it.
        """
        session, state = self._session, self._session.state
        session.look()
        if not state.busy or not state.print_file:
            return None
        found = session.call("server.history.list", {"limit": 1, "order": "desc"})
        jobs = found.get("jobs") if isinstance(found, dict) else None
        latest = jobs[0] if isinstance(jobs, list) and jobs else {}
        if latest.get("filename") != state.print_file:
            return None  # the server has not written it down yet
        if latest.get("status") == "in_progress":
            self._unsure_s = None
        elif self._unsure_s is None:
            self._unsure_s = self._clock()
        if self._unsure_s is not None and self._clock() - self._unsure_s < WRITTEN_S:
            return None  # an earlier print of this file, or a server that was restarted in this one
        return UnderWay(state.print_file, str(latest.get("job_id")))

    def pass_by(self) -> None:
        """Go on without a look."""
        self._session.call("printer.print.resume", limit_s=None)

    def forget_steps(self) -> None:
        """What an earlier run had counted is none of this one's."""
        names = ("program", "begun", "done", "hotend", "bed")
        self.command("\n".join(_set_step(name, 0) for name in names))

    def leave_out(self, name: str) -> None:
        """By Klipper's own [exclude_object]; told twice, it is left out once."""
        found = self._session.query({"exclude_object": ["objects"]}).get("exclude_object", {})
        known = [str(row.get("name")) for row in found.get("objects", ())]
        if name.upper() not in known:
            raise LinkError(
                f"the printer behind {self.address.name} knows no object {name!r}; write "
                "[exclude_object] into printer.cfg, and label objects in the slicer."
            )
        self.command(f"EXCLUDE_OBJECT NAME={name}")

    # ------------------------------------------------------------------ printing

    def _refresh(self) -> None:
        self._session.look()

    def _rest(self) -> tuple[bool, int]:
        told = self._session.query(
            {
                "virtual_sdcard": ["is_active", "file_position"],
                "print_stats": ["state"],
                "webhooks": ["state"],
            }
        )
        card = told.get("virtual_sdcard", {})
        paused = told.get("print_stats", {}).get("state") == "paused"
        line = self._text.line_at(int(card.get("file_position") or 0))
        gone = told.get("webhooks", {}).get("state") in STOPPED  # nothing there goes on any more
        return paused and not gone and not card.get("is_active", True), line

    def _has_it(self) -> bool:
        state = self._session.state
        return state.print_file == self._name and state.busy

    def _pending(self) -> bool:
        return bool(self._session.state.called)

    def _go_on(self, line: int, first: int) -> None:
        if first != line:  # what lies between was printed by us, and ended elsewhere
            self.command(f"SAVE_GCODE_STATE NAME=PAUSE_STATE\nM26 S{self._text.start(first)}")
        self._session.call("printer.print.resume", limit_s=None)

    def _how_it_ended(self, end: int) -> bool | None:
        state = self._session.state
        if not state.ended:
            return None
        if state.outcome == "cancelled":
            return False
        if state.outcome == "complete":
            return self._complete(end, "is amrepair.cfg included in printer.cfg?")
        why = state.klippy_message if state.stopped else state.message
        raise PrinterError(f"{self.address.name} reports a fault: {cause_of(why)[:200]}")

    # ------------------------------------------------------------------ at rest

    def _print_at_rest(self, checked: PrintableProgram, lines: range, progress: Progress) -> None:
        """Send a program to the paused printer, a step at a time."""
        program, first = number_of(checked), lines.start
        self._require_rest()
        while first < lines.stop:
            while self._held_back.is_set():
                self.wait(self._timing.poll_s)
            after = min(first + STEP_LINES, lines.stop)
            start = " START=1" if first == 0 else ""
            script = [f"{STEP_MACRO} PROGRAM={program} FROM={first} TO={after}{start}"]
            script += [command for _, command in commands_of(checked, first, after)]
            script.append(_set_step("done", after))
            self._carry_out("\n".join(script), program, first, after)
            progress("printing", float(after - lines.start), float(len(lines)))
            first = after

    def _carry_out(self, script: str, program: int, first: int, after: int) -> None:
        """Have a step carried out once, whatever becomes of the link meanwhile."""
        while True:
            try:
                self.command(script)
            except PrinterError:
                raise
            except LinkError:
                self._asked(self._settled)
                told = self._steps()
                if told["program"] == program and told["begun"] == told["done"] == after:
                    return
                if told["program"] == program and told["begun"] == after:
                    raise self._in_doubt(first, after) from None
                self._require_rest()
                continue
            return

    def _settled(self) -> None:
        self._session.look()
        self.command("M400")

    def _reached_at_rest(self, checked: PrintableProgram, lines: range) -> int:
        self._asked(self._settled)
        told = self._steps()
        if told["program"] != number_of(checked):
            return lines.start
        if told["begun"] != told["done"]:
            raise self._in_doubt(told["done"], told["begun"])
        return max(lines.start, min(told["done"], lines.stop))

    def _heat_of_before(self) -> tuple[tuple[float, ...], float]:
        told = self._macro()
        hotends = told.get("hotend") or 0  # of several heads a list
        each = hotends if isinstance(hotends, list) else [hotends]
        return tuple(float(c) for c in each), float(told.get("bed") or 0)

    def _steps(self) -> dict[str, int]:
        """What the printer's macro has counted."""
        told = self._macro()
        return {name: int(told.get(name) or 0) for name in ("program", "begun", "done")}

    def _macro(self) -> dict[str, Any]:
        key = f"gcode_macro {STEP_MACRO}"
        told = self._session.query({key: None}).get(key)
        if told is None:
            raise LinkError(
                f"the printer behind {self.address.name} has no macro {STEP_MACRO}; include "
                "amrepair.cfg ('amrepair agent --macros') in printer.cfg and restart Klipper."
            )
        return told

    def pulled_at_rest_mm(self) -> float:
        """Filament that the user's `PAUSE` has pulled back, as our macros measured it."""
        key = f"gcode_macro {STEP_MACRO}"
        told = self._session.query({key: ["pulled"]}).get(key, {})
        return max(0.0, float(told.get("pulled") or 0.0))

    def require_partner(self) -> None:
        """Refuse a printer without our macros."""
        self._steps()

    def _require_rest(self) -> None:
        rests, _ = self._asked(self._rest)
        if not rests:
            raise PrinterError("the print goes on or has ended; nothing is printed at its look.")
        if not self.motors_held():
            raise PrinterError(
                "the motors were let go while the print rested (Klipper's idle_timeout): where "
                "the nozzle is, is not known, and the print cannot be gone on with."
            )

    # ------------------------------------------------------------------ touches

    def require_touches(self) -> None:
        """Refuse a printer without the macro that bounds the depth of PROBE."""
        self._touches()

    def touch(
        self, checked: PrintableProgram, lines: range, *, progress: Progress = silent
    ) -> float:
        """Carry out lines, the last of them a touch; where it met something, mm in G-code's Z."""
        before, _ = self._asked(self._touches)
        try:
            self.print(checked, lines=lines, progress=progress)
        except PrinterError as error:
            if self._asked(self._rest)[0]:
                self.heaters_off()
                self.command("\n".join(LIFT_COMMANDS))
            raise NothingMetError(f"{error}") from error
        count, met_mm = self._asked(self._touches)
        if count != before + 1:
            raise PrinterError(
                f"{self.address.name} tells of {count - before} touches where one was made; is its "
                "macro AMREPAIR_TOUCH of this version?"
            )
        return met_mm

    def _touches(self) -> tuple[int, float]:
        """How many touches have met something since Klipper began, and where the last has."""
        told = self._session.query({TOUCH_KEY: None}).get(TOUCH_KEY, {})
        if "met" not in told:
            raise LinkError(
                f"the printer behind {self.address.name} has no macro AMREPAIR_TOUCH of this "
                "version; write it by 'gcode touch --klipper-macro FILE', include it in "
                "printer.cfg and restart Klipper."
            )
        return int(told["count"]), float(told["met"])

    # ------------------------------------------------------------------ pause, safety

    def pause(self) -> None:
        """Hold what is printed at a look; have Klipper pause where the job goes on."""
        self._held_back.set()
        if not self._rest()[0]:
            super().pause()

    def resume(self) -> None:
        """Go on."""
        self._held_back.clear()
        rests, line = self._rest()
        if rests and not self._text.is_look(line):
            super().resume()

    def heaters_off(self) -> None:
        """Switch heaters off where our job rests; one that Klipper prints goes on.

        What they were set to stays with the printer, for whoever goes on.
        """
        self._session.look()
        state = self._session.state
        if state.stopped or (state.busy and state.print_file != self._name):
            return  # off already, or somebody else's
        if state.busy:
            if not self._rest()[0]:
                return
            now, (hotends_c, bed_c) = self.temperatures(), self._heat_at_look
            each = [round(c) for c in either_c(now.hotend_targets_c, hotends_c)]
            was = {"hotend": each, "bed": [round(now.bed_target_c or bed_c)]}
            for name, values in was.items():
                if any(values):
                    self.command(_set_step(name, *values))
        super().heaters_off()

    # ------------------------------------------------------------------ macros

    def calls(self, wait_s: float) -> list[dict[str, Any]]:
        """What the printer's macros have asked for since the last time; waits for some."""
        session = self._session
        with session.news:
            session.news.wait_for(lambda: bool(session.state.called), wait_s)
            found = [params for _, params in session.state.called]
            session.state.called.clear()
        return found


def _set_step(name: str, *values: int) -> str:
    """The command that keeps a number, or several, with the printer."""
    value = ",".join(map(str, values))  # of several Klipper makes a tuple
    return f"SET_GCODE_VARIABLE MACRO={STEP_MACRO} VARIABLE={name} VALUE={value}"
