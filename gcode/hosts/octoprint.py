"""A printer behind an OctoPrint server: REST for what is asked for, the push socket for news.

OctoPrint holds the wire: it numbers, resends and waits, and it prints on by itself when we are
gone. This adapter uploads a program, has it printed, and tells truthfully how that ended. Parking
in a pause is left to the server's own pause script, which knows where its queue stands.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from gcode.errors import LinkError, PortBusyError, PrinterError
from gcode.hosts.octoprint_session import OctoPrintSession
from gcode.hosts.octoprint_state import BUSY_STATES
from gcode.hosts.port import Capabilities, PrintableProgram, Temperatures
from gcode.hosts.safety import SAFE_COMMANDS
from gcode.hosts.server import Left, ServerPrinter, ServerReach
from gcode.hosts.upload import JobFile
from gcode.hosts.web import LIFT_COMMANDS, number_or_none, part_of, sentence
from gcode.protocol import events as ev


class OctoPrintPrinter(ServerPrinter[OctoPrintSession]):
    """A printer that an OctoPrint server drives; parameters of `ServerPrinter`.

    The key's owner must be allowed to print, to control and to see the terminal.
    """

    files = "/api/files/local"
    _capabilities: Capabilities | None = None
    _resends_before = 0

    def _new_session(self, reach: ServerReach) -> OctoPrintSession:
        return OctoPrintSession(reach)

    def _greet(self, ready: Callable[[], None]) -> None:
        if "Moonraker" in str(self._session.web.get("/api/version").get("text")):
            raise LinkError(
                f"{self.address.base} is a Moonraker that answers as OctoPrint; write "
                f"moonraker+{self.address.base}."
            )
        ready()
        self._session.listen()

    def _left(self, prefix: str) -> Left | None:
        rows = self._session.web.get(self.files).get("files")
        rows = [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
        mine = [row for row in rows if str(row.get("path")).startswith(prefix)]
        if not mine:
            return None
        newest = max(mine, key=lambda row: number_or_none(row.get("date")) or 0.0)
        name = str(newest["path"])
        flags = self._session.status()["state"]["flags"]
        if self._session.printing()[0] == name and any(flags.get(f) for f in BUSY_STATES):
            return Left(name, "printing")
        prints = part_of(newest, "prints")
        last = part_of(prints, "last")
        if not prints.get("success") and not prints.get("failure"):
            return Left(name, "waiting")
        ended_s = number_or_none(last.get("date"))
        return Left(name, "done" if last.get("success") else "failed", ended_s)

    def motors_held(self) -> bool:
        """Taken for granted: OctoPrint does not know."""
        return True

    # ------------------------------------------------------------------ questions

    def _refuse_unless_ready(self) -> None:
        flags = self._session.status()["state"]["flags"]
        self._session.state.flags = dict(flags)
        if any(flags.get(name) for name in ("printing", "paused", "pausing", "cancelling")):
            name, percent = self._session.printing()
            raise PortBusyError(
                f"{self.address.name} is printing {name!r} already ({percent:.0f} %); wait for it, "
                f"or cancel it there."
            )

    def capabilities(self) -> Capabilities:
        """Return what the firmware says of itself (M115), asked for once."""
        if self._capabilities is None:
            self._capabilities = Capabilities.told(self._session.ask("M115"))
        return self._capabilities

    def temperatures(self) -> Temperatures:
        """Return the temperatures that OctoPrint polls; ask (M105) where it has none yet."""
        heaters = part_of(self._session.status(), "temperature")
        pairs = {
            name: (number_or_none(heater.get("actual")), number_or_none(heater.get("target")))
            for name, heater in heaters.items()
            if isinstance(heater, dict)
        }
        if pairs.get("tool0", (None,))[0] is None:
            for reply in self._session.ask("M105"):
                if isinstance(reply, ev.TemperatureReport):
                    names = {"T": "tool0", "B": "bed"} | {f"T{k}": f"tool{k}" for k in reply.heads}
                    for name, heater in reply.heaters.items():
                        pairs[names.get(name, name)] = (heater.current_c, heater.target_c)
        tools = [pairs[f"tool{k}"] for k in range(len(pairs)) if f"tool{k}" in pairs]
        # which is chosen OctoPrint does not tell
        hotend_c, hotend_target_c = max(
            tools, key=lambda pair: pair[1] or 0.0, default=(None, None)
        )
        bed_c, bed_target_c = pairs.get("bed", (None, None))
        if hotend_c is None:
            raise LinkError(f"The printer of {self.address.name} reports no hotend temperature.")
        return Temperatures(
            float(hotend_c),
            float(hotend_target_c or 0.0),
            float(bed_c) if bed_c is not None else None,
            float(bed_target_c or 0.0) if bed_c is not None else None,
            tuple(float(target_c or 0.0) for _, target_c in tools) if len(tools) > 1 else (),
        )

    def position_mm(self) -> tuple[float, float, float]:
        """Ask for the logical position (M114), read from the server's terminal."""
        for reply in self._session.ask("M114"):
            if isinstance(reply, ev.PositionReport):
                return reply.x_mm, reply.y_mm, reply.z_mm
        raise LinkError(f"The printer of {self.address.name} does not answer M114.")

    def finish_moves(self) -> None:
        """Return when every buffered move has been made (M400)."""
        self._session.ask("M400", wait_s=None)

    def command(self, text: str) -> None:
        """Send one command of the host's own, and wait for its `ok`."""
        self._session.ask(text)

    # ------------------------------------------------------------------ printing

    def _upload(self, job: JobFile) -> None:
        """Put the file on the server and compare what lies there."""
        self._session.web.expect(
            201,
            "take the file; is its disk full?",
            "POST",
            self.files,
            files={"file": (job.name, job.data)},
            timeout_s=self._timing.upload_s,
        )
        there = self._session.web.get(f"{self.files}/{job.name}")
        size, digest = there.get("size"), there.get("hash")
        if size != len(job.data) or digest not in {None, job.sha1}:
            raise LinkError(
                f"{self.address.name} holds another file than was sent ({size} bytes of "
                f"{len(job.data)}); a plugin may alter uploads: switch it off."
            )

    def _start(self, job: JobFile) -> None:
        self._resends_before = self._session.state.resends
        self._session.state.follow(job.name)
        try:
            answer = self._session.web.request(
                "POST", f"{self.files}/{job.name}", json={"command": "select", "print": True}
            )
        except LinkError as error:
            raise self._lost(job, f"whether it began is not known: {error}") from error
        if answer.status_code == 409:
            raise PortBusyError(
                f"{self.address.name} does not start the print ({sentence(answer)}); somebody "
                f"else uses it."
            )
        if answer.status_code != 204:
            raise LinkError(f"{self.address.name} does not start the print ({sentence(answer)}).")

    def _outcome(self, job: JobFile) -> bool:
        state = self._session.state
        outcome = state.outcome or "PrintFailed"
        if outcome == "PrintFailed":
            lines = self._uncertain(job)
            if state.error:
                raise PrinterError(
                    f"{self.address.name} reports a fault of its printer: {state.error}; {lines}."
                )
            raise self._lost(job, f"it lost its printer ({state.trouble})")
        return outcome == "PrintDone"

    def _look(self, job: JobFile) -> None:
        known = self._patiently(job, self._session.look)
        if not known:
            text = self._session.state.text
            raise self._lost(job, f"it no longer prints the file (its state is {text!r})")

    def _uncertain(self, job: JobFile) -> str:
        read = self._session.state.file_position
        return (
            f"lines {job.first + 1} to {job.end} are uncertain (it had read up to line "
            f"{job.line_at(read) + 1})"
        )

    def _reached(
        self, checked: PrintableProgram, job: JobFile, *, ok: bool
    ) -> tuple[int, int, int]:
        resends = max(0, self._session.state.resends - self._resends_before)
        return (job.end, job.commands, resends) if ok else (job.first, 0, resends)

    # ------------------------------------------------------------------ pause, abort, stop

    def pause(self) -> None:
        """Have OctoPrint pause, which parks the nozzle if its pause script does."""
        self._job({"command": "pause", "action": "pause"}, "pause")

    def resume(self) -> None:
        """Have OctoPrint go on."""
        self._job({"command": "pause", "action": "resume"}, "resume")

    def _job(self, command: dict[str, str], what: str) -> None:
        self._session.web.expect(204, what, "POST", "/api/job", json=command)

    def _cancel(self) -> bool:
        self._refuse_anothers()
        answer = self._session.web.request("POST", "/api/job", json={"command": "cancel"})
        if answer.status_code == 204:
            self._await_rest()
        elif answer.status_code != 409:  # else it prints nothing
            raise LinkError(f"{self.address.name} does not cancel it ({sentence(answer)}).")
        return True

    def _lift(self) -> None:
        self._session.command(*LIFT_COMMANDS)

    def _refuse_anothers(self) -> None:
        flags = self._session.status()["state"]["flags"]
        name, _ = self._session.printing()
        our_file = self._session.state.file.rpartition("/")[2]  # a name has no folder
        ours = name in {our_file, "None", ""}  # what nobody names passes for ours
        if any(flags.get(f) for f in BUSY_STATES) and not ours:
            raise self._anothers(name)

    def _await_rest(self) -> None:
        until_s = self._clock() + self._timing.answer_s
        while any(
            self._session.status()["state"]["flags"].get(f) for f in ("printing", "cancelling")
        ):
            if self._clock() > until_s:
                raise LinkError(
                    f"{self.address.name} has not cancelled the print within "
                    f"{self._timing.answer_s:g} s; stop the printer there."
                )
            self.wait(0.1)

    def emergency_stop(self) -> None:
        """Have M112 sent past the queue; the printer must be reset afterwards."""
        self._session.command("M112")

    def heaters_off(self) -> None:
        """Switch every hotend, bed and fan off, acknowledged."""
        self._cools_ours()
        self._session.ask(*SAFE_COMMANDS)
        heads = 0
        with contextlib.suppress(LinkError):  # it reports no temperature
            heads = len(self.temperatures().targets_c)
        if heads:  # its word for the hotend means the one that is chosen
            self._session.ask(*(f"M104 T{k} S0" for k in range(heads)))
