"""Klipper as far as an agent meets it: its macros, its variables, its card, its pauses.

Written after Klipper's own klippy/gcode.py, extras/gcode_macro.py, pause_resume.py and
virtual_sdcard.py; the macros are the shipped file's, rendered by the same template engine with the
same settings. Lines that move or heat are handed on to whoever carries them out.
"""

from __future__ import annotations

import ast
import configparser
import contextlib
import shlex
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

from gcode.hosts.modes import Modes, follow

EXTENDED = "_"
POSITION_MIN_MM = -2.0  # of Z
SETTINGS = {"force_move": {"enable_force_move": True}}


class Place(NamedTuple):
    x: float
    y: float
    z: float
    e: float = 0.0


class CommandError(Exception):
    """What Klipper answers to a command that it refuses."""


class SmallKlipper:
    """One printer.

    Attributes
    ----------
    executed
        Every plain line that was carried out, in order, whoever sent it.
    said
        What its console showed.
    """

    def __init__(
        self,
        gcodes: Path,
        macros: str,
        *,
        carry_out: Callable[[str], None] = lambda line: None,
        respond: Callable[[str], None] = lambda text: None,
        call_remote: Callable[[str, dict[str, Any]], None] = lambda method, params: None,
        feel: Callable[[float, float], float | None] = lambda depth_mm, speed_mm_s: None,
        pause_s: float = 0.0,
    ) -> None:
        self.gcodes, self.pause_s = gcodes, pause_s
        self.carry_out, self.respond, self.call_remote = carry_out, respond, call_remote
        self.feel = feel  # how far down something is met, no deeper than it is told
        self._config = configparser.RawConfigParser(
            strict=False, inline_comment_prefixes=(";", "#"), delimiters=(":", "=")
        )
        self._config.read_string(macros)
        self._templates = jinja2.Environment("{%", "%}", "{", "}")
        self.executed: list[str] = []
        self.said: list[str] = []
        self.shut_down = ""  # why: then every script is refused with it
        self.mutex = threading.RLock()
        self.reset()

    def reset(self) -> None:
        """As after a restart: everything is forgotten, heaters are off, nothing is homed."""
        self.modes = Modes()
        self.homed = ""
        self.is_paused = self.must_pause = self.from_card = False
        self.file, self.data, self.position = "", b"", 0
        self.print_state, self.message = "standby", ""
        self.saved: dict[str, Modes] = {}
        self.display = ""
        self.shift_mm = self.probed_mm = 0.0  # Z in truth above the one believed in
        self.worker: threading.Thread | None = None
        self.variables: dict[str, dict[str, Any]] = {}
        for section in self._config.sections():
            kind, _, name = section.partition(" ")
            if kind == "gcode_macro":
                self.variables[name] = {
                    key.removeprefix("variable_"): ast.literal_eval(value)
                    for key, value in self._config[section].items()
                    if key.startswith("variable_")
                }

    # ------------------------------------------------------------------ objects

    def objects(self) -> dict[str, dict[str, Any]]:
        place = [self.modes.position_mm.get(axis, 0.0) for axis in "XYZE"]
        hotend, bed = self.modes.hotend_c, self.modes.bed_c
        return {
            "webhooks": {
                "state": "shutdown" if self.shut_down else "ready",
                "state_message": self.shut_down or "Printer is ready",
            },
            "print_stats": {
                "state": self.print_state, "filename": self.file, "message": self.message,
                "total_duration": 0.0, "print_duration": 0.0, "filament_used": 0.0,
                "info": {"total_layer": None, "current_layer": None},
            },
            "virtual_sdcard": {
                "file_path": str(self.gcodes / self.file) if self.file else None,
                "file_position": self.position,
                "file_size": len(self.data),
                "is_active": self.is_active,
                "progress": self.position / max(len(self.data), 1),
            },
            "pause_resume": {"is_paused": self.is_paused},
            "display_status": {"progress": 0.0, "message": self.display},
            "gcode_move": {
                "gcode_position": Place(*place), "position": Place(*place), "speed_factor": 1.0,
            },
            "toolhead": {
                "homed_axes": self.homed, "position": Place(*place),
                "axis_minimum": Place(0.0, 0.0, POSITION_MIN_MM),
            },
            "configfile": {"settings": SETTINGS},
            "probe": {"last_probe_position": Place(*place[:2], self.probed_mm)},
            "extruder": {"temperature": hotend or 21.0, "target": hotend},
            "heater_bed": {"temperature": bed or 21.0, "target": bed},
            **{f"gcode_macro {name}": dict(told) for name, told in self.variables.items()},
        }  # fmt: skip

    @property
    def is_active(self) -> bool:
        return self.worker is not None

    # ------------------------------------------------------------------ commands

    def run_script(self, script: str) -> None:
        """A client's script: as a whole, nothing between its lines."""
        with self.mutex:
            if self.shut_down:
                raise CommandError(self.shut_down)
            self._process(script)

    def _process(self, script: str) -> None:
        for line in script.split("\n"):
            command = line.partition(";")[0].strip()
            if command:
                try:
                    self._command(command)
                except CommandError as error:
                    self.tell(f"!! {error}")
                    raise

    def tell(self, text: str) -> None:
        self.said.append(text)
        self.respond(text)

    def _command(self, command: str) -> None:
        name = command.split(maxsplit=1)[0].upper()
        if f"gcode_macro {name}" in self._config:
            self._macro(name, command)
        elif name == "M117":
            self.display = command[4:].strip()
        elif name == "M26":
            if self.is_active:
                raise CommandError("SD busy")
            self.position = int(command.split("S")[1])
        elif handler := getattr(self, f"cmd_{name}", None):
            handler(self._words(command))
        elif name.isalpha() and len(name) > 1:
            self.tell(f'// Unknown command:"{name}"')
        else:
            self._plain(name, command)

    def _plain(self, name: str, command: str) -> None:
        if name in {"G0", "G1"} and not self.homed:
            raise CommandError("Must home axis first")
        if name == "G28":
            self.homed = "xyz"
        self.modes = follow(self.modes, command, "klipper")
        self.executed.append(command)
        self.carry_out(command)

    @staticmethod
    def _words(command: str) -> dict[str, str]:
        lexer = shlex.shlex(command.partition(" ")[2], posix=True)
        lexer.whitespace_split, lexer.commenters = True, "#;"
        try:
            pairs = [word.split("=", 1) for word in lexer]
            return {key.upper(): value for key, value in pairs}
        except ValueError as error:
            raise CommandError(f"Malformed command '{command}'") from error

    def _macro(self, name: str, command: str) -> None:
        template = self._templates.from_string(self._config[f"gcode_macro {name}"]["gcode"])

        def raised(message: str) -> None:
            raise CommandError(message)

        def remote(method: str, **params: Any) -> str:
            self.call_remote(method, params)
            return ""

        self._process(
            template.render(
                **self.variables[name],
                printer=self.objects(),
                params=self._words(command),
                action_raise_error=raised,
                action_respond_info=lambda text: self.tell(f"// {text}") or "",
                action_call_remote_method=remote,
            )
        )

    # ------------------------------------------------------------------ touches

    @property
    def z_mm(self) -> float:
        return self.modes.position_mm.get("Z", 0.0)

    def cmd_SET_KINEMATIC_POSITION(self, words: dict[str, str]) -> None:
        z_mm = float(words["Z"])
        self.shift_mm += self.z_mm - z_mm
        self.modes.position_mm["Z"] = z_mm
        self.carry_out(f"SET_KINEMATIC_POSITION Z={z_mm}")

    def cmd_PROBE(self, words: dict[str, str]) -> None:
        deep_mm = self.z_mm - POSITION_MIN_MM
        way_mm = self.feel(deep_mm, float(words["PROBE_SPEED"]))
        self.modes = replace(self.modes, position_mm={
            **self.modes.position_mm, "Z": self.z_mm - (deep_mm if way_mm is None else way_mm)
        })  # fmt: skip
        if way_mm is None:
            raise CommandError("No trigger on probe after full movement")
        self.probed_mm = self.z_mm

    def cmd_UPDATE_DELAYED_GCODE(self, words: dict[str, str]) -> None:
        script = self._config[f"delayed_gcode {words['ID']}"]["gcode"]
        threading.Timer(float(words["DURATION"]), self.run_script, (script,)).start()

    def cmd_TEMPERATURE_WAIT(self, words: dict[str, str]) -> None:
        self.carry_out("TEMPERATURE_WAIT " + " ".join(f"{k}={v}" for k, v in words.items()))

    def cmd_SET_GCODE_VARIABLE(self, words: dict[str, str]) -> None:
        told = self.variables.get(words["MACRO"])
        if told is None or words["VARIABLE"] not in told:
            raise CommandError(f"Unknown gcode_macro variable '{words['VARIABLE']}'")
        told[words["VARIABLE"]] = ast.literal_eval(words["VALUE"])

    def cmd_RESPOND(self, words: dict[str, str]) -> None:
        prefix = {"command": "//", "error": "!!"}.get(words.get("TYPE", ""), "echo:")
        self.tell(f"{words.get('PREFIX', prefix)} {words.get('MSG', '')}")

    def cmd_SAVE_GCODE_STATE(self, words: dict[str, str]) -> None:
        self.saved[words["NAME"]] = self.modes

    def cmd_PAUSE(self, words: dict[str, str]) -> None:
        if self.is_paused:
            self.tell("// Print already paused")
            return
        self.pause_card()
        self.saved["PAUSE_STATE"] = self.modes
        self.is_paused = True

    def cmd_RESUME(self, words: dict[str, str]) -> None:
        if not self.is_paused:
            self.tell("// Print is not paused, resume aborted")
            return
        was = self.saved["PAUSE_STATE"]
        place = was.position_mm
        now = replace(was, feed_mm_min=was.feed_mm_min)
        for line in now.restore(*(place.get(axis, 0.0) for axis in "XYZE")):
            self._plain(line.split()[0], line)
        self.resume_card()
        self.is_paused = False

    def cmd_CANCEL_PRINT(self, words: dict[str, str]) -> None:
        if self.file and self.print_state in {"printing", "paused"}:
            self.pause_card()
            self.print_state, self.position, self.data = "cancelled", 0, b""
        self.is_paused = False

    def cmd_TURN_OFF_HEATERS(self, words: dict[str, str]) -> None:
        for line in ("M104 S0", "M140 S0"):
            self._plain(line.split()[0], line)

    def cmd_SDCARD_PRINT_FILE(self, words: dict[str, str]) -> None:
        if self.is_active:
            raise CommandError("SD busy")
        path = self.gcodes / words["FILENAME"].lstrip("/")
        if not path.is_file():
            raise CommandError("Unable to open file")
        self.file, self.data, self.position = words["FILENAME"].lstrip("/"), path.read_bytes(), 0
        self.is_paused = False
        self.resume_card()

    # ------------------------------------------------------------------ the card

    def pause_card(self) -> None:
        worker = self.worker
        if worker is not None:
            self.must_pause = True
            if not self.from_card:
                worker.join()

    def resume_card(self) -> None:
        if self.is_active:
            raise CommandError("SD busy")
        self.must_pause, self.print_state = False, "printing"
        self.worker = threading.Thread(target=self._work, daemon=True)
        self.worker.start()

    def _work(self) -> None:
        state, tick = "paused", threading.Event()
        while not self.must_pause:
            end = self.data.find(b"\n", self.position) + 1
            if end == 0:
                state = "complete"
                break
            if self.pause_s:
                tick.wait(self.pause_s)
            if not self.mutex.acquire(timeout=0.01):
                continue
            try:
                if self.must_pause:
                    break
                self.from_card = True
                self._process(self.data[self.position : end].decode())
                self.position = end
            except CommandError as error:
                state, self.message = "error", str(error)
                with contextlib.suppress(CommandError):
                    self.cmd_TURN_OFF_HEATERS({})
                break
            finally:
                self.from_card = False
                self.mutex.release()
        if self.print_state == "printing":
            self.print_state = state
        self.worker = None
