"""The emulated printer's serial side: bytes in, bytes out, no port, no sleep, no thread.

It assembles lines, verifies numbers and checksums as the firmware does, runs commands on the
`Machine`, reports while they take long, and commits the faults of the script. Two clocks: the
printer's own (virtual, jumps when accelerated), and the host's, only for faults of timing.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable

from gcode.firmware.damage import Wire
from gcode.firmware.faults import Fault, FaultScript
from gcode.firmware.framing import RENUMBERED, unframed
from gcode.firmware.machine import Machine
from gcode.firmware.variants import BUILT_WITHOUT, FIRMWARES, Variant
from gcode.profiles import PrinterProfile

_EMERGENCY = re.compile(rb"(?:^|\n)(?:N\d+ ?)?(M108|M112|M410)\b")
_BUSY_EVERY_S = 2.0
_MOST_REPORTS = 5000
"""In one command: an accelerated clock would otherwise tell of years of waiting."""


class FirmwareCore:
    """An emulated printer: bytes of the host in, bytes of the firmware out.

    Parameters
    ----------
    record
        Called with every command carried out (not with those it does not know), in order,
        freed of number and checksum.
    """

    def __init__(
        self,
        profile: PrinterProfile,
        variant: str | Variant = "marlin",
        *,
        faults: FaultScript | None = None,
        accelerated: bool = True,
        seed: int = 0,
        record: Callable[[bytes], None] | None = None,
    ) -> None:
        self.faults = faults or FaultScript()
        built = FIRMWARES[variant] if isinstance(variant, str) else variant
        self.variant = built.without(*(BUILT_WITHOUT.keys() & self.faults.always))
        self.machine = Machine(profile, self.variant)
        self.accelerated = accelerated
        self.record = record
        self._rng = random.Random(seed)
        self._advanced_ok = self.variant.advanced_ok
        self._has_faults = bool(self.faults.faults)
        self._numbers = self.variant.numbers
        if "ignore_checksums" in self.faults.always:
            self._numbers = "ignore"
        damage = self.faults.always.get("damage")
        self.wire: Wire | None = None
        if damage is not None:
            self.wire = Wire(_value(damage, 0.005), self._numbers, seed=seed)
        self._resend_ok = "resend_without_ok" not in self.faults.always
        self._rx = bytearray()
        self._out = bytearray()
        self.last_number = 0
        self.lines_seen = 0
        self.mute_until_s = -math.inf  # host's time
        self.hang_up_s: float | None = None
        self._wall_s = 0.0
        self._pending_ok: dict[str, Fault] = {}
        self._waits_since_s = math.inf  # for room among the moves; of the printer's clock
        self._wait_number: int | None = None
        self._next_temperature_s = self._next_position_s = math.inf

    # ------------------------------------------------------------------ driver's side

    def enable_advanced_ok(self) -> None:
        """Build the firmware with ADVANCED_OK: numbers and free places in every `ok`."""
        self._advanced_ok = True

    def power_up(self, *, silent: bool = False) -> None:
        """Start, or start anew: forget everything and greet."""
        self.machine.power_up()
        self._rx.clear()
        self.last_number = 0
        self._pending_ok = {}
        if not silent:
            for line in self.variant.banner:
                self._say(line)

    def feed(self, data: bytes, wall_s: float = 0.0) -> None:
        """Take bytes from the host at its time `wall_s`."""
        self._wall_s = wall_s
        if self.machine.killed:
            return
        if self.wire is not None:
            data = self.wire.to_printer(bytes(self._rx).rpartition(b"\n")[2], data)
        self._rx += data
        if self.variant.passes and self.machine.wait is not None:
            self._emergency()

    def run(self, limit_s: float = math.inf, wall_s: float = 0.0) -> None:
        """Carry out what has arrived, the printer's clock going no further than `limit_s`."""
        self._wall_s = wall_s
        machine, rx = self.machine, self._rx
        while True:
            if machine.wait is not None and not self._run_wait(limit_s):
                return
            if machine.clock_s > limit_s or machine.killed:
                self._wait_for_room(limit_s)
                return
            self._waits_since_s = math.inf
            end = rx.find(b"\n")
            if end < 0:
                if len(rx) > 4 * self.variant.line_bytes:
                    del rx[: -self.variant.line_bytes]
                return
            line = bytes(rx[:end])
            del rx[: end + 1]
            self._line(line)

    def _wait_for_room(self, now_s: float) -> None:
        """Say that it is busy while a line waits for moves to end (`idle()` of Marlin)."""
        if not self.variant.keepalive or self.machine.killed or b"\n" not in self._rx:
            return
        self._waits_since_s = min(self._waits_since_s, now_s)
        if now_s >= self._waits_since_s + _BUSY_EVERY_S:
            self._waits_since_s += _BUSY_EVERY_S
            self._say("echo:busy: processing")

    def pass_time(self, until_s: float) -> None:
        """Nothing comes in: let the printer go on by itself until `until_s` of its clock."""
        machine = self.machine
        if machine.wait is not None:
            self._run_wait(until_s)
        elif until_s > machine.clock_s:
            machine.let_pass(until_s)
        self._auto_reports()

    def drain(self) -> None:
        """Let the printer finish what it has buffered."""
        machine = self.machine
        if machine.wait is None and machine.planner.blocks:
            machine.let_pass(machine.planner.drained_s(machine.clock_s) + 1e-6)

    def take_output(self) -> bytes:
        """Bytes for the host; none while the printer is mute."""
        if self._wall_s < self.mute_until_s or not self._out:
            return b""
        data = bytes(self._out)
        self._out.clear()
        return data if self.wire is None else self.wire.to_host(data)

    # ------------------------------------------------------------------ lines

    def _line(self, raw: bytes) -> None:
        self.lines_seen += 1
        faults: dict[str, Fault] = {}
        if self._has_faults:
            faults = self.faults.at(self.lines_seen)
            if faults:
                changed = self._strike(raw, faults)
                if changed is None:
                    return
                raw = changed
        command = raw.partition(b";")[0].strip()
        if not command:
            if self.variant.answers_empty:
                self._empty()
            return
        checked = self._accept(command[: self.variant.line_bytes - 1], faults)
        if checked is None:
            return
        before = len(self._out)
        self._execute(checked, faults)
        if "corrupt_out" in faults and len(self._out) > before + 1:
            self._out[before:] = _flip(bytes(self._out[before:-1]), self._rng) + b"\n"

    def _empty(self) -> None:
        """Klipper acknowledges empty lines, too, and refuses them once it has shut down."""
        if self.machine.shut_down:
            self.machine.refuse_shut_down()
            self._say_all()
        self._say("ok")

    def _accept(self, command: bytes, faults: dict[str, Fault]) -> bytes | None:
        """The command freed of number and checksum; None if it is refused or dropped."""
        framed = unframed(command, self._numbers, self.last_number)
        if framed.refusal:
            self._reject(framed.refusal, faults)
        if framed.number is not None:
            self.last_number = framed.number
        return framed.command

    def _reject(self, why: str, faults: dict[str, Fault]) -> None:
        self._rx.clear()  # the firmware flushes its receive buffer
        self._say(f"{self.variant.error_prefix}{why}, Last Line: {self.last_number}")
        self._ask_again(self.last_number + 1, faults)

    def _ask_again(self, number: int, faults: dict[str, Fault]) -> None:
        self._say(f"Resend: {number}")
        if self._resend_ok and "resend_without_ok" not in faults:
            self._say("ok")

    def _execute(self, command: bytes, faults: dict[str, Fault]) -> None:
        machine = self.machine
        if command.startswith(b"M110"):
            if match := RENUMBERED.search(command):
                self.last_number = int(match.group(1))
        elif machine.execute(command) and self.record is not None:
            self.record(command)
        if command.startswith((b"M154", b"M155")):
            self._schedule_reports()
        if machine.replies:
            self._say_all()
        if faults and "busy" in faults and machine.wait is None:
            machine.wait_for(machine.clock_s + _value(faults["busy"], 30.0))
        self._wait_number = self.last_number
        if machine.wait is not None:
            self._pending_ok = faults
        elif not machine.killed:
            self._ok(faults)

    def _ok(self, faults: dict[str, Fault]) -> None:
        text = "ok" + self.machine.ok_text
        if self._advanced_ok and not self.machine.ok_text:  # M105 says an `ok` of its own
            free = 15 - len(self.machine.planner.blocks)
            text = f"ok N{self._wait_number} P{max(free, 0)} B3"
        self.machine.ok_text = ""
        if not faults:
            self._out += text.encode() + b"\n"
            return
        if "lose_ok" in faults:
            return
        if "garble_ok" in faults:
            self._out += b"o\xebk"[: self._rng.randint(1, 3)] + b"\n"
            return
        self._say(text)
        if "double_ok" in faults:
            self._say(text)

    def _say(self, text: str) -> None:
        self._out += text.encode("latin-1") + b"\n"

    def _say_all(self) -> None:
        for reply in self.machine.replies:
            self._say(reply)
        self.machine.replies.clear()

    # ------------------------------------------------------------------ time

    def _run_wait(self, limit_s: float) -> bool:
        """Let the command under way go on; True once it has ended."""
        machine = self.machine
        wait = machine.wait
        assert wait is not None
        end_s = min(wait.end_s, limit_s)
        if math.isinf(end_s):
            return False  # only a user ends it
        for _ in range(_MOST_REPORTS):
            report_s = wait.next_report_s if wait.heating else math.inf
            busy_s = wait.next_busy_s if self.variant.keepalive else math.inf
            event_s = min(report_s, busy_s)
            if event_s > end_s:
                break
            machine.let_pass(event_s)
            if report_s <= event_s:
                self._say(machine.temperatures() + " W:?")
                wait.next_report_s += 1.0
            if busy_s <= event_s:
                self._say(f"echo:busy: {wait.reason}")
                wait.next_busy_s += _BUSY_EVERY_S
        machine.let_pass(end_s)
        if wait.end_s > limit_s:
            return False
        self._end_wait(wait.then)
        return True

    def _end_wait(self, then: Callable[[], None] | None) -> None:
        machine = self.machine
        machine.planner.advance(machine.clock_s + 1e-9, machine.clock_s)
        machine.wait = None
        if then is not None:
            then()
        self._say_all()
        faults, self._pending_ok = self._pending_ok, {}
        self._ok(faults)

    def _emergency(self) -> None:
        for match in _EMERGENCY.finditer(bytes(self._rx)):
            command = match.group(1)
            wait = self.machine.wait
            if command not in self.variant.passes:
                continue
            if command == b"M112":
                self.machine.kill("")
                self._say_all()
                if self.machine.shut_down:
                    faults, self._pending_ok = self._pending_ok, {}
                    self._ok(faults)
                return
            if wait is None:
                continue
            if command == b"M410":
                self.machine.quick_stop()
                self._end_wait(None)
            else:
                self._end_wait(wait.then)

    def _schedule_reports(self) -> None:
        machine = self.machine
        now_s = machine.clock_s
        self._next_temperature_s = (
            now_s + machine.auto_temperature_s if machine.auto_temperature_s else math.inf
        )
        self._next_position_s = (
            now_s + machine.auto_position_s if machine.auto_position_s else math.inf
        )

    def _auto_reports(self) -> None:
        """M155 and M154: one report for any number of periods passed."""
        machine = self.machine
        if machine.clock_s >= self._next_temperature_s:
            self._say(" " + machine.temperatures())
            self._next_temperature_s = machine.clock_s + machine.auto_temperature_s
        if machine.clock_s >= self._next_position_s:
            self._say(machine.position_text())
            self._next_position_s = machine.clock_s + machine.auto_position_s

    # ------------------------------------------------------------------ faults

    def _strike(self, raw: bytes, faults: dict[str, Fault]) -> bytes | None:
        """Commit the faults of this line that come before it is read; None: it is gone."""
        machine, rng = self.machine, self._rng
        if "silence" in faults:
            self.mute_until_s = self._wall_s + _value(faults["silence"], 1.0)
        if "dead" in faults:
            self.mute_until_s = math.inf
        if "disconnect" in faults:
            self.hang_up_s = _value(faults["disconnect"], 0.2)
        if "reset" in faults or "silent_reset" in faults:
            self.power_up(silent="silent_reset" in faults)
            return None
        if "thermal_runaway" in faults:
            machine.kill("Thermal Runaway, system stopped! Heater_ID: E0")
            self._say_all()
            if not machine.shut_down:
                return None
        if "runout" in faults:
            self._say("//action:notification Filament Runout")
            self._say("//action:paused filament_runout 0")
            machine.wait_for(
                machine.planner.drained_s(machine.clock_s) + _value(faults["runout"], 20.0),
                reason="paused for user",
                then=lambda: machine.replies.append("//action:resumed"),
            )
            self._run_pause()
        if "clog" in faults:
            machine.clogged_moves = int(_value(faults["clog"], 100.0))
        if "resend_storm" in faults:
            for _ in range(int(_value(faults["resend_storm"], 8.0))):
                self._ask_again(self.last_number + 1, faults)
        if "resend_gone" in faults:
            self._ask_again(int(_value(faults["resend_gone"], 1.0)), faults)
            return None
        if "noise_out" in faults:
            self._out += rng.randbytes(rng.randint(1, 12)) + b"\n"
        if "drop_in" in faults:
            return None
        if "noise_in" in faults:
            raw = rng.randbytes(rng.randint(1, 6)).replace(b"\n", b"?") + raw
        if "corrupt_in" in faults and raw:
            raw = _flip(raw, rng)
        return raw

    def _run_pause(self) -> None:
        """Sit out a pause before the line that met it is read."""
        wait = self.machine.wait
        assert wait is not None
        self.machine.wait = None
        for _ in range(3):
            self._say(f"echo:busy: {wait.reason}")
        self.machine.let_pass(wait.end_s)
        if wait.then is not None:
            wait.then()
        self._say_all()


def _value(fault: Fault, default: float) -> float:
    return default if fault.value is None else fault.value


def _flip(raw: bytes, rng: random.Random) -> bytes:
    """Flip one bit, never making or breaking a line end."""
    while True:
        index, bit = rng.randrange(len(raw)), 1 << rng.randrange(7)
        changed = raw[index] ^ bit
        if changed not in b"\r\n;":
            return raw[:index] + bytes((changed,)) + raw[index + 1 :]
