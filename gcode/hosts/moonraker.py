"""A printer behind a Moonraker server and Klipper: JSON-RPC over the websocket, HTTP for files.

Klipper reads the file itself and prints on by itself when we are gone. This adapter uploads a
program, has it printed, and tells truthfully how that ended. Parking in a pause is left to the
printer's own PAUSE macro. The emergency stop goes by HTTP, past every queue (a script would wait
its turn).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts.modes import commands_of
from gcode.hosts.moonraker_session import MoonrakerSession
from gcode.hosts.moonraker_state import MOONRAKER_ENDS, cause_of
from gcode.hosts.port import Capabilities, LinkLostError, PrintableProgram, Temperatures
from gcode.hosts.server import Left, ServerPrinter, ServerReach
from gcode.hosts.upload import JobFile
from gcode.hosts.web import LIFT_COMMANDS, number_or_none, sentence
from gcode.progress import Progress


class MoonrakerPrinter(ServerPrinter[MoonrakerSession]):
    """A printer that Klipper drives, reached through Moonraker; parameters of `ServerPrinter`."""

    files = "/server/files/gcodes"
    _aborted = False

    def _new_session(self, reach: ServerReach) -> MoonrakerSession:
        return MoonrakerSession(reach)

    def _greet(self, ready: Callable[[], None]) -> None:
        ready()

    def _left(self, prefix: str) -> Left | None:
        session, state = self._session, self._session.state
        rows = session.listed("/server/files/list", root="gcodes")
        mine = [r for r in rows if str(r.get("path")).startswith(prefix)]
        if not mine:
            return None
        name = str(max(mine, key=lambda row: number_or_none(row.get("modified")) or 0.0)["path"])
        session.look()
        if state.print_file == name and state.busy:
            return Left(name, "printing")
        if state.print_file == name and state.print_state in MOONRAKER_ENDS:
            return Left(name, "done" if state.print_state == "complete" else "failed")
        about = session.listed("/server/files/metadata", filename=name)
        if about and all(row.get("print_start_time") is None for row in about):
            return Left(name, "waiting")
        return Left(name, "failed")  # it was begun, and Klipper has done something else since

    def motors_held(self) -> bool:
        """Whether Klipper still knows X, Y and Z as homed."""
        homed = self._session.query({"toolhead": ["homed_axes"]}).get("toolhead", {})
        return set("xyz") <= set(str(homed.get("homed_axes", "")))

    def _refuse_unless_ready(self) -> None:
        self._session.look()
        state = self._session.state
        if state.stopped:
            raise PrinterError(
                f"Klipper behind {self.address.name} has stopped ({_why(state.klippy_message)}); "
                f"mend the cause and run FIRMWARE_RESTART."
            )
        if state.busy:
            raise PortBusyError(
                f"{self.address.name} is printing {state.print_file!r} already; wait for it, or "
                f"cancel it there."
            )

    # ------------------------------------------------------------------ questions

    def capabilities(self) -> Capabilities:
        """Return Klipper's version, and what its configuration lets us use."""
        info = self._session.call("printer.info")
        version = info.get("software_version", "") if isinstance(info, dict) else ""
        found = self._session.call("printer.objects.list")
        objects = found.get("objects") if isinstance(found, dict) else ()
        objects = objects if isinstance(objects, list) else []
        caps = {name.upper(): name in objects for name in ("virtual_sdcard", "pause_resume")}
        configured = self._session.query({"configfile": ["settings"]}).get("configfile", {})
        if settings := configured.get("settings"):
            caps["ARCS"] = "gcode_arcs" in settings
        return Capabilities(f"Klipper {version}".strip(), {**caps, "EMERGENCY_STOP": True})

    def temperatures(self) -> Temperatures:
        """Ask for temperatures."""
        wanted: dict[str, list[str] | None] = {
            "extruder": ["temperature", "target"],
            "heater_bed": ["temperature", "target"],
            "toolhead": ["extruder"],
            "heaters": ["available_heaters"],
        }
        status = self._session.query(wanted)
        there = status.get("heaters", {}).get("available_heaters")
        there = there if isinstance(there, list) else []
        named = ["extruder", *(f"extruder{k}" for k in range(1, len(there)))]
        names = [name for name in named if name in there]
        if len(names) > 1:
            wanted = {name: ["temperature", "target"] for name in names}
            status |= self._session.query(wanted)
        chosen = str(status.get("toolhead", {}).get("extruder") or "extruder")
        hotend_c, hotend_target_c = _warmth(status.get(chosen, {}))
        bed_c, bed_target_c = _warmth(status.get("heater_bed", {}))
        if hotend_c is None:
            raise LinkError(
                f"{self.address.name} reports no temperature of an [extruder]; check printer.cfg."
            )
        return Temperatures(
            hotend_c,
            hotend_target_c,
            bed_c,
            None if bed_c is None else bed_target_c,
            tuple(_warmth(status.get(name, {}))[1] for name in names if len(names) > 1),
        )

    def position_mm(self) -> tuple[float, float, float]:
        """Ask for the logical position."""
        place = self._session.query({"gcode_move": ["gcode_position"]}).get("gcode_move", {})
        told = place.get("gcode_position")
        axes = [number_or_none(value) for value in told[:3]] if isinstance(told, list) else []
        known = [value for value in axes if value is not None]
        if len(known) != 3:
            raise LinkError(f"{self.address.name} does not tell where the nozzle is.")
        return known[0], known[1], known[2]

    def finish_moves(self) -> None:
        """Return when every buffered move has been made (M400)."""
        self.command("M400")

    def command(self, text: str) -> None:
        """Run a script of the host's own; return when Klipper has carried it out."""
        self._session.call("printer.gcode.script", {"script": text}, limit_s=None)

    # ------------------------------------------------------------------ printing

    def _upload(self, job: JobFile) -> None:
        """Put the file on the server, which compares its checksum."""
        self._session.web.expect(
            201,
            "take the file; is its disk full?",
            "POST",
            "/server/files/upload",
            files={"file": (job.name, job.data)},
            data={"root": "gcodes", "checksum": job.sha256},
            timeout_s=self._timing.upload_s,
        )

    def _start(self, job: JobFile) -> None:
        self._aborted = False
        with self._session.news:
            self._session.state.follow(job.name)
        try:
            self._session.call("printer.print.start", {"filename": job.name}, limit_s=None)
        except PrinterError:
            raise
        except LinkError as error:
            if not self._began(job):
                raise self._lost(job, f"whether it began is not known: {error}") from error

    def _began(self, job: JobFile) -> bool:
        """Whether a print whose start was not confirmed is under way after all."""
        try:
            self._look(job)
        except LinkLostError:
            return False
        return True

    def _follow(self, job: JobFile, progress: Progress) -> bool:
        """Wait for the print's end, which may have come before we listened."""
        self._look(job)
        return super()._follow(job, progress)

    def _outcome(self, job: JobFile) -> bool:
        state = self._session.state
        if state.outcome in {"complete", "cancelled"}:
            return state.outcome == "complete"
        why = state.klippy_message if state.stopped else state.message
        raise PrinterError(
            f"{self.address.name} reports a fault: {_why(why)}; {self._uncertain(job)}."
        )

    def _look(self, job: JobFile) -> None:
        """Ask what became of the print; a Klipper that restarted has forgotten it."""
        state = self._session.state
        self._patiently(job, self._session.look)
        if state.printing_ours:
            return
        if self._aborted:  # a cancel macro may reset the file
            state.outcome = "cancelled"
            return
        raise self._lost(
            job, f"Klipper no longer knows the file (its state is {state.print_state!r})"
        )

    def _uncertain(self, job: JobFile) -> str:
        taken = job.line_at(self._session.state.file_position)
        return (
            f"lines {job.first + 1} to {job.end} are uncertain (Klipper had taken up to line "
            f"{taken} into its queue)"
        )

    def _reached(
        self, checked: PrintableProgram, job: JobFile, *, ok: bool
    ) -> tuple[int, int, int]:
        # Klipper carries out every line that it has taken, so the position is a lower bound.
        next_line = job.end if ok else job.line_at(self._session.state.file_position)
        return next_line, sum(1 for _ in commands_of(checked, job.first, next_line)), 0

    # ------------------------------------------------------------------ pause, abort, stop

    def pause(self) -> None:
        """Have Klipper pause, which parks the nozzle if its PAUSE macro does."""
        self._session.call("printer.print.pause", limit_s=None)

    def resume(self) -> None:
        """Have Klipper go on."""
        self._session.call("printer.print.resume", limit_s=None)

    def _cancel(self) -> bool:
        self._refuse_anothers()
        if self._session.state.stopped:
            return False  # a Klipper that shut down has switched everything off
        if self._session.state.busy:
            self._aborted = True
            self._session.call("printer.print.cancel", limit_s=self._timing.lost_s)
        return True

    def _lift(self) -> None:
        homed = self._session.query({"toolhead": ["homed_axes"]}).get("toolhead", {})
        if "z" in str(homed.get("homed_axes", "")):
            self.command("\n".join(LIFT_COMMANDS))

    def _refuse_anothers(self) -> None:
        self._session.look()
        state = self._session.state
        if state.busy and state.print_file not in {"", state.file}:
            raise self._anothers(state.print_file)

    def emergency_stop(self) -> None:
        """Stop Klipper now, by its own endpoint; FIRMWARE_RESTART it afterwards."""
        answer = self._session.web.request("POST", "/printer/emergency_stop")
        if answer.status_code != 200:
            raise LinkError(
                f"{self.address.name} refuses the emergency stop ({sentence(answer)}): switch the "
                f"printer off."
            )

    def heaters_off(self) -> None:
        """Switch every heater and the fan off."""
        self._cools_ours()
        script = {"script": "TURN_OFF_HEATERS\nM107"}
        # It waits its turn behind what heats or moves: who would be safe is told if that is long.
        self._session.call("printer.gcode.script", script, limit_s=self._timing.lost_s)


def _warmth(heater: dict[str, Any]) -> tuple[float | None, float]:
    """Temperature of a heater, None where it is not told, and its target, °C."""
    target_c = number_or_none(heater.get("target"))
    return number_or_none(heater.get("temperature")), target_c or 0.0


def _why(text: str) -> str:
    return cause_of(text)[:200] or "no reason given"
