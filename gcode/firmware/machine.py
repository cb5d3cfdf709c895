"""The emulated machine: what each command does to position, heaters, fan and clock.

It takes commands already freed of number and checksum (`core` does that) and answers in text.
A command that takes long leaves a `Wait` behind; `core` lets the clock run and ends it.
Coordinates inside are native, in the build frame: bed corner at the origin, Z up, mm.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from gcode.firmware.planner import Planner
from gcode.firmware.thermal import BED, HOTEND, RESIDENCY_S, Heater
from gcode.firmware.variants import Variant
from gcode.profiles import AxisLimits, PrinterProfile
from gcode.units import mm_s_from_mm_min

ARC_SEGMENT_MM = 0.5
"""Chord of an arc (Marlin's MIN_ARC_SEGMENT_MM … MAX_ARC_SEGMENT_MM lie around it)."""
MAX_EXTRUDE_MM = 200.0
"""EXTRUDE_MAXLENGTH of Marlin."""
LARGEST = 1e7
"""No number of a command counts for more; nor does it where it is none."""
MOST_CHORDS = 10_000
SOFT_MARGIN_MM = 10.0
"""How far over the bed's edge the head reaches (purge lines beside the bed)."""
HOMING_MM_S = 50.0
_WORD = re.compile(rb"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+)?)")


@dataclass(slots=True)
class Wait:
    """A command under way.

    Attributes
    ----------
    end_s
        When it ends, by the printer's clock; infinity where only a user ends it.
    heating
        Whether it reports temperatures every second (M109, M190).
    then
        What is left to do at the end, before the `ok`.
    """

    end_s: float
    heating: bool = False
    reason: str = "processing"
    then: Callable[[], None] | None = None
    next_report_s: float = 0.0
    next_busy_s: float = 0.0


class Machine:
    """A Cartesian printer with one extruder, a heated bed and a fan."""

    def __init__(self, profile: PrinterProfile, variant: Variant) -> None:
        self.profile = profile
        self.variant = variant
        self.replies: list[str] = []
        self.ok_text = ""
        self.wait: Wait | None = None
        self.clock_s = 0.0
        self.planner = self._new_planner()
        self.power_up()
        self._commands = self._command_table()

    def power_up(self) -> None:
        """Forget everything, as after a reset; the clock and what was executed stay."""
        executed = self.planner.executed
        self.planner = self._new_planner()
        self.planner.executed = executed
        self.hotend, self.bed = Heater(HOTEND), Heater(BED)
        for heater in (self.hotend, self.bed):
            heater.set_target(0.0, self.clock_s)
        self.x = self.y = self.z = 0.0
        self.e = 0.0  # logical, as G92 sets it
        self.offset = [0.0, 0.0, 0.0]  # logical = native + offset
        self.homed = False
        self.absolute = True
        self.absolute_e = True
        self.unit_mm = 1.0
        self.feed_mm_s = 25.0
        self.speed_ratio = self.flow_ratio = 1.0
        self.fan_ratio = 0.0
        self.min_extrude_c = self.profile.min_extrude_c
        self.may_extrude_cold = False
        self.killed = False
        self.auto_temperature_s = self.auto_position_s = 0.0
        self.message = ""
        self.wait = None

    def _new_planner(self) -> Planner:
        profile = self.profile
        return Planner(
            max_speed_mm_s=_axes(profile.max_speed_mm_s),
            max_acceleration_mm_s2=_axes(profile.max_acceleration_mm_s2),
            max_jerk_mm_s=_axes(profile.max_jerk_mm_s),
        )

    # ------------------------------------------------------------------ commands

    def execute(self, command: bytes) -> bool:
        """Carry out one command; False if it is not known. Replies go to `replies`."""
        name, _, rest = command.partition(b" ")
        handler = self._commands.get(name)
        if handler is None:
            match = re.match(rb"([GM])\s*0*(\d+)(?:\.\d+)?", command)
            if match is None:
                return self._unknown(command)
            name, rest = match.group(1) + match.group(2), command[match.end() :]
            handler = self._commands.get(name)
            if handler is None:
                return self._unknown(command)
        handler(rest)
        return True

    def _unknown(self, command: bytes) -> bool:
        if re.fullmatch(rb"T\d", command):
            return True
        text = command.decode("latin-1")
        name = text.split(" ")[0] if self.variant.name == "klipper" else text
        self.replies.append(self.variant.unknown.format(command=name))
        return False

    def _command_table(self) -> dict[bytes, Callable[[bytes], None]]:
        table: dict[bytes, Callable[[bytes], None]] = {b"G0": self._g1, b"G1": self._g1}
        for name in dir(self):
            if re.fullmatch(r"_[gm]\d+", name):
                table[name[1:].upper().encode()] = getattr(self, name)
        for name in _IGNORED:
            table.setdefault(name.encode(), self._ignore)
        if not self.variant.emergency_parser and self.variant.name == "klipper":
            table.pop(b"M108")
        return table

    def _ignore(self, rest: bytes) -> None:
        """Nothing an emulated machine could show."""

    def _g1(self, rest: bytes) -> None:
        x, y, z, de = self.x, self.y, self.z, 0.0
        unit = self.unit_mm
        for token in rest.split():
            letter = token[0]
            try:
                value = float(token[1:])
            except ValueError:
                return self._g1_words(_words(rest))
            if not -LARGEST <= value <= LARGEST:
                return self._g1_words(_words(rest))
            if letter == 88:  # X
                x = value * unit - self.offset[0] if self.absolute else x + value * unit
            elif letter == 89:  # Y
                y = value * unit - self.offset[1] if self.absolute else y + value * unit
            elif letter == 90:  # Z
                z = value * unit - self.offset[2] if self.absolute else z + value * unit
            elif letter == 69:  # E
                de = value * unit - self.e if self.absolute_e else value * unit
            elif letter == 70 and value > 0:  # F; Marlin takes no other for a feed
                self.feed_mm_s = value * unit / 60.0
        self._move((x, y, z), de)
        return None

    def _g1_words(self, words: dict[str, float]) -> None:
        target, de = self._target(words)
        self._move(target, de)

    def _target(self, words: dict[str, float]) -> tuple[tuple[float, float, float], float]:
        here = [self.x, self.y, self.z]
        for axis, letter in enumerate("XYZ"):
            if letter in words:
                value = words[letter] * self.unit_mm
                here[axis] = value - self.offset[axis] if self.absolute else here[axis] + value
        de = 0.0
        if "E" in words:
            de = words["E"] * self.unit_mm - (self.e if self.absolute_e else 0.0)
        if words.get("F", 0) > 0:
            self.feed_mm_s = mm_s_from_mm_min(words["F"] * self.unit_mm)
        return (here[0], here[1], here[2]), de

    def _move(self, target: tuple[float, float, float], de_mm: float) -> None:
        start = (self.x, self.y, self.z)
        if de_mm:
            self.e += de_mm
            de_mm *= self.flow_ratio
            if not self.may_extrude_cold and self.hotend.temperature_c(self.clock_s) < (
                self.min_extrude_c
            ):
                self._cold()
                de_mm = 0.0
            elif de_mm > MAX_EXTRUDE_MM:
                self.replies.append("echo: too long extrusion prevented")
                de_mm = 0.0
        if self.homed:
            target = self._soft_limits(target)
        self.x, self.y, self.z = target
        planner = self.planner
        if planner.full:
            planner.start_head(self.clock_s)
            self.let_pass(max(planner.head_end_s, self.clock_s))
        planner.push(start, target, de_mm, self.feed_mm_s * self.speed_ratio)

    def _cold(self) -> None:
        if self.variant.name == "klipper":
            self.replies.append("!! Extrude below minimum temp")
        else:
            self.replies.append(f"{self.variant.echo_prefix} cold extrusion prevented")

    def _soft_limits(self, target: tuple[float, float, float]) -> tuple[float, float, float]:
        width, depth = self.profile.bed_size_mm
        x = min(max(target[0], -SOFT_MARGIN_MM), width + SOFT_MARGIN_MM)
        y = min(max(target[1], -SOFT_MARGIN_MM), depth + SOFT_MARGIN_MM)
        return x, y, min(max(target[2], 0.0), self.profile.max_z_mm)

    def let_pass(self, until_s: float) -> None:
        """Let the clock run to `until_s` and execute what ends by then."""
        self.planner.advance(until_s, self.clock_s)
        self.clock_s = max(self.clock_s, until_s)

    def _g2(self, rest: bytes) -> None:
        self._arc(rest, clockwise=True)

    def _g3(self, rest: bytes) -> None:
        self._arc(rest, clockwise=False)

    def _arc(self, rest: bytes, *, clockwise: bool) -> None:
        words = _words(rest)
        start = (self.x, self.y, self.z)
        target, de_mm = self._target(words)
        centre = _arc_centre(start, target, words, self.unit_mm, clockwise=clockwise)
        if centre is None:
            self.replies.append(f"{self.variant.error_prefix}G2/G3 bad parameters")
            return
        radius = math.hypot(start[0] - centre[0], start[1] - centre[1])
        first = math.atan2(start[1] - centre[1], start[0] - centre[0])
        last = math.atan2(target[1] - centre[1], target[0] - centre[0])
        sweep = (first - last if clockwise else last - first) % (2 * math.pi)
        if sweep < 1e-9:
            sweep = 2 * math.pi  # the end is the start: a full circle
        length = math.hypot(radius * sweep, target[2] - start[2])
        count = min(max(1, math.ceil(length / ARC_SEGMENT_MM)), MOST_CHORDS)
        for index in range(1, count + 1):
            ratio = index / count
            angle = first + (-sweep if clockwise else sweep) * ratio
            point = (
                centre[0] + radius * math.cos(angle),
                centre[1] + radius * math.sin(angle),
                start[2] + (target[2] - start[2]) * ratio,
            )
            self._move(target if index == count else point, de_mm / count)

    def _g4(self, rest: bytes) -> None:
        words = _words(rest)
        seconds = words.get("S", words.get("P", 0.0) / 1000.0)
        self.wait_for(self.planner.drained_s(self.clock_s) + seconds)

    def _g10(self, rest: bytes) -> None:
        """Firmware retraction, which this firmware is built without."""

    def _g20(self, rest: bytes) -> None:
        self.unit_mm = 25.4

    def _g21(self, rest: bytes) -> None:
        self.unit_mm = 1.0

    def _g28(self, rest: bytes) -> None:
        axes = {chr(token[0]) for token in rest.split()} & {"X", "Y", "Z"} or {"X", "Y", "Z"}
        target = tuple(
            0.0 if letter in axes else value
            for letter, value in zip("XYZ", (self.x, self.y, self.z), strict=True)
        )
        distance = math.dist(target, (self.x, self.y, self.z))
        drained_s = self.planner.drained_s(self.clock_s)

        def homed() -> None:
            here = (self.x, self.y, self.z)
            self.x, self.y, self.z = target
            for axis, letter in enumerate("XYZ"):
                if letter in axes:
                    self.offset[axis] = 0.0
            if axes == {"X", "Y", "Z"}:
                self.homed = True
            self._record_jump(here)

        self.wait_for(drained_s + 2.0 + distance / HOMING_MM_S, then=homed)

    def _record_jump(self, here: tuple[float, float, float]) -> None:
        there = (self.x, self.y, self.z)
        if here != there:
            self.planner.executed.extend((*here, *there, 0.0, HOMING_MM_S, self.clock_s))

    def _g29(self, rest: bytes) -> None:
        def probed() -> None:
            self.replies.append("Bilinear Leveling Grid:")
            self.replies.append("      0      1      2")
            for row in range(3):
                self.replies.append(f" {row} +0.000 +0.000 +0.000")

        self.wait_for(self.planner.drained_s(self.clock_s) + 45.0, then=probed)

    def _g90(self, rest: bytes) -> None:
        self.absolute = True
        if self.variant.modes_follow_g90 == "both":
            self.absolute_e = True

    def _g91(self, rest: bytes) -> None:
        self.absolute = False
        if self.variant.modes_follow_g90 == "both":
            self.absolute_e = False

    def _g92(self, rest: bytes) -> None:
        words = _words(rest)
        for axis, letter in enumerate("XYZ"):
            if letter in words:
                native = (self.x, self.y, self.z)[axis]
                self.offset[axis] = words[letter] * self.unit_mm - native
        if "E" in words:
            self.e = words["E"] * self.unit_mm

    def _m0(self, rest: bytes) -> None:
        words = _words(rest)
        seconds = words.get("S", words.get("P", 0.0) / 1000.0)
        end_s = self.planner.drained_s(self.clock_s) + seconds if seconds else math.inf
        self.wait_for(end_s, reason="paused for user")

    _m1 = _m0

    def _m82(self, rest: bytes) -> None:
        self.absolute_e = True

    def _m83(self, rest: bytes) -> None:
        self.absolute_e = False

    def _m104(self, rest: bytes) -> None:
        self.hotend.set_target(_words(rest).get("S", 0.0), self.clock_s)

    def _m140(self, rest: bytes) -> None:
        self.bed.set_target(_words(rest).get("S", 0.0), self.clock_s)

    def _m109(self, rest: bytes) -> None:
        self._heat(self.hotend, _words(rest))

    def _m190(self, rest: bytes) -> None:
        self._heat(self.bed, _words(rest))

    def _heat(self, heater: Heater, words: dict[str, float]) -> None:
        heater.set_target(words.get("R", words.get("S", heater.target_c)), self.clock_s)
        reached_s = heater.reached_s(cooling="R" in words)
        if reached_s > self.clock_s:
            reached_s += RESIDENCY_S
        self.wait_for(max(reached_s, self.planner.drained_s(self.clock_s)), heating=True)

    def _m105(self, rest: bytes) -> None:
        if self.variant.temperatures_in_ok:
            self.ok_text = " " + self.temperatures()
        else:
            self.replies.append(self.temperatures())

    def temperatures(self) -> str:
        """The text of a temperature report."""
        hotend, bed, now_s = self.hotend, self.bed, self.clock_s
        if self.variant.name == "klipper":
            return (
                f"B:{bed.temperature_c(now_s):.1f} /{bed.target_c:.1f} "
                f"T0:{hotend.temperature_c(now_s):.1f} /{hotend.target_c:.1f}"
            )
        return (
            f"T:{hotend.temperature_c(now_s):.2f} /{hotend.target_c:.2f} "
            f"B:{bed.temperature_c(now_s):.2f} /{bed.target_c:.2f} @:0 B@:0"
        )

    def _m106(self, rest: bytes) -> None:
        self.fan_ratio = min(1.0, max(0.0, _words(rest).get("S", 255.0) / 255.0))

    def _m107(self, rest: bytes) -> None:
        self.fan_ratio = 0.0

    def _m108(self, rest: bytes) -> None:
        """Acts only through the emergency parser; read from the queue it comes too late."""

    def _m112(self, rest: bytes) -> None:
        self.kill("")

    def kill(self, why: str) -> None:
        """Stop for good: heaters off, queue dropped, deaf until a reset."""
        place = self.planner.stop(self.clock_s, self.clock_s)
        if place is not None:
            self.x, self.y, self.z = place
        for heater in (self.hotend, self.bed):
            heater.set_target(0.0, self.clock_s)
        self.fan_ratio = 0.0
        self.wait = None
        if why:
            self.replies.append(f"{self.variant.error_prefix}{why}")
        if self.variant.name == "klipper":
            self.replies.append("!! Shutdown due to M112 command")
        else:
            self.replies.append(f"{self.variant.error_prefix}Printer halted. kill() called!")
        self.killed = True

    def _m410(self, rest: bytes) -> None:
        self.quick_stop()

    def quick_stop(self) -> None:
        """Drop the queue (M410)."""
        place = self.planner.stop(self.clock_s, self.clock_s)
        if place is not None:
            self.x, self.y, self.z = place
        self.wait = None

    def _m114(self, rest: bytes) -> None:
        logical = [
            native + offset
            for native, offset in zip((self.x, self.y, self.z), self.offset, strict=True)
        ]
        self.replies.append(self.position_text(logical))

    def position_text(self, logical: list[float] | None = None) -> str:
        """The text of a position report."""
        x, y, z = logical or [
            native + offset
            for native, offset in zip((self.x, self.y, self.z), self.offset, strict=True)
        ]
        text = f"X:{x:.3f} Y:{y:.3f} Z:{z:.3f} E:{self.e:.4f}"
        if self.variant.name in ("marlin", "prusa"):
            steps = (int(self.x * 80), int(self.y * 80), int(self.z * 400))
            text += f" Count X:{steps[0]} Y:{steps[1]} Z:{steps[2]}"
        return text

    def _m115(self, rest: bytes) -> None:
        line = self.variant.firmware_line.format(machine=self.profile.name)
        if self.variant.name == "klipper":
            self.ok_text = " " + line
            return
        self.replies.append(line)
        for name, enabled in self.variant.capabilities:
            self.replies.append(f"Cap:{name}:{int(enabled)}")

    def _m117(self, rest: bytes) -> None:
        self.message = rest.decode("latin-1")

    def _m118(self, rest: bytes) -> None:
        text = re.sub(rb"^(?:\s*[AEP]\d\s+)+", b"", rest).decode("latin-1")
        self.replies.append(text)

    def _m154(self, rest: bytes) -> None:
        self.auto_position_s = _words(rest).get("S", 0.0)

    def _m155(self, rest: bytes) -> None:
        self.auto_temperature_s = _words(rest).get("S", 0.0)

    def _m201(self, rest: bytes) -> None:
        self._set_axes(self.planner.max_acceleration, _words(rest))

    def _m203(self, rest: bytes) -> None:
        self._set_axes(self.planner.max_speed, _words(rest))

    def _m205(self, rest: bytes) -> None:
        self._set_axes(self.planner.max_jerk, _words(rest))

    @staticmethod
    def _set_axes(values: list[float], words: dict[str, float]) -> None:
        for axis, letter in enumerate("XYZE"):
            if words.get(letter, 0.0) > 0:
                values[axis] = words[letter]

    def _m204(self, rest: bytes) -> None:
        words, planner = _words(rest), self.planner
        if words.get("S", 0) > 0:
            planner.print_acceleration = planner.travel_acceleration = words["S"]
        if words.get("P", 0) > 0:
            planner.print_acceleration = words["P"]
        if words.get("T", 0) > 0:
            planner.travel_acceleration = words["T"]
        if words.get("R", 0) > 0:
            planner.retract_acceleration = words["R"]

    def _m220(self, rest: bytes) -> None:
        self.speed_ratio = max(0.01, _words(rest).get("S", 100.0) / 100.0)

    def _m221(self, rest: bytes) -> None:
        self.flow_ratio = max(0.0, _words(rest).get("S", 100.0) / 100.0)

    def _m302(self, rest: bytes) -> None:
        words = _words(rest)
        if "S" in words:
            self.min_extrude_c = words["S"]
        self.may_extrude_cold = words.get("P", float(self.may_extrude_cold)) > 0

    def _m400(self, rest: bytes) -> None:
        self.wait_for(self.planner.drained_s(self.clock_s))

    def wait_for(
        self,
        end_s: float,
        *,
        heating: bool = False,
        reason: str = "processing",
        then: Callable[[], None] | None = None,
    ) -> None:
        """Leave a command under way until `end_s`."""
        self.wait = Wait(
            end_s, heating, reason, then, self.clock_s + 1.0, next_busy_s=self.clock_s + 2.0
        )


def _axes(limits: AxisLimits) -> tuple[float, float, float, float]:
    return limits.x, limits.y, limits.z, limits.e


def _words(rest: bytes) -> dict[str, float]:
    """Parameters by letter; a letter without a number counts as 0."""
    words: dict[str, float] = {}
    for letter, number in _WORD.findall(rest.upper()):
        value = float(number) if number.strip(b"+-.") else 0.0
        words[letter.decode()] = min(max(value, -LARGEST), LARGEST)
    return words


def _arc_centre(
    start: tuple[float, float, float],
    end: tuple[float, float, float],
    words: dict[str, float],
    unit_mm: float,
    *,
    clockwise: bool,
) -> tuple[float, float] | None:
    """Centre of an arc from its I J offsets or its radius R (Marlin's `G2_G3.cpp`)."""
    if "R" in words:
        radius = words["R"] * unit_mm
        dx, dy = end[0] - start[0], end[1] - start[1]
        chord = math.hypot(dx, dy)
        if chord < 1e-9 or abs(radius) < chord / 2 - 1e-6:
            return None
        height = math.sqrt(max(radius * radius - chord * chord / 4, 0.0))
        if clockwise != (radius < 0):
            height = -height
        return (
            (start[0] + end[0]) / 2 - height * dy / chord,
            (start[1] + end[1]) / 2 + height * dx / chord,
        )
    if "I" not in words and "J" not in words:
        return None
    return start[0] + words.get("I", 0.0) * unit_mm, start[1] + words.get("J", 0.0) * unit_mm


_IGNORED = """
G11 G17 G18 G19 G80 M17 M18 M20 M21 M73 M75 M76 M77 M78 M81 M84 M85 M86 M110 M111 M113
M116 M119 M142 M200 M206 M207 M208 M209 M211 M250 M300 M301 M304 M412 M413 M420 M421
M486 M500 M501 M502 M503 M555 M572 M573 M575 M593 M600 M601 M602 M603 M701 M702 M851
M862.1 M862.2 M862.3 M862.4 M862.5 M862.6 M862 M900 M906 M907 M914 M974 M569 M221.1 G5
G26 G42 G60 G61 T0 M31 M27 M141 M191 M150 M355 M711
""".split()  # noqa: SIM905
"""Taken and answered, without anything that shows."""
