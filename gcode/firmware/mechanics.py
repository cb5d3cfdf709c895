"""The emulated mechanics: moves, heaters, clock, and what they report of themselves.

A command that takes long leaves a `Wait` behind; `core` lets the clock run and ends it.
Coordinates inside are native, in the build frame: bed corner at the origin, Z up, mm.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gcode.firmware.heads import Heads
from gcode.firmware.motion import MotionBatch
from gcode.firmware.planner import Planner
from gcode.firmware.thermal import BED_HEATER, Heater
from gcode.firmware.variants import Variant
from gcode.profiles import PrinterProfile
from gcode.units import mm_s_from_mm_min

if TYPE_CHECKING:  # what stands on the bed is felt by few printers, and loads the kernels
    from gcode.firmware.contact import ProbeContact
    from gcode.firmware.laid import Laid
    from gcode.surfaces import HeightField

ARC_SEGMENT_MM = 0.5
"""Chord of an arc (Marlin's MIN_ARC_SEGMENT_MM … MAX_ARC_SEGMENT_MM lie around it)."""
MAX_EXTRUDE_MM = 200.0
"""EXTRUDE_MAXLENGTH of Marlin."""
E_DIGIT_MM = 1e-4
"""Words that say where the extruder is to be are rounded to less."""
LARGEST = 1e7
"""No number of a command counts for more; nor does it where it is none."""
MOST_CHORDS = 10_000
SOFT_MARGIN_MM = 10.0
"""How far over the bed's edge the head reaches (purge lines beside the bed)."""
HOMING_MM_S = 50.0
_RAW_WORD = re.compile(rb"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+)?)")


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


class Mechanics:
    """A Cartesian printer with one head or more, a heated bed and a fan."""

    def __init__(self, profile: PrinterProfile, variant: Variant) -> None:
        self.profile = profile
        self.variant = variant
        self.replies: list[str] = []
        self.ok_text = ""
        self.wait: Wait | None = None
        self.clock_s = 0.0
        self.planner = self._new_planner()
        self.power_up()
        self.contact: ProbeContact | None = None  # where the nozzle feels what it touches
        self.dead_probe = False  # it never triggers
        self.laid: Laid | None = None
        self._laid_bytes = 0  # of what was executed and is not forgotten, so much is laid
        self.clogged_moves = 0  # nothing comes out on so many more that extrude
        self.pulled_mm = 0.0  # filament that was pulled back and not yet pushed again
        self.let_go = 0  # how often moves came after the motors had been let go

    def stand(self, surface: HeightField, *, seed: int = 0) -> None:
        """Have this stand on the bed from now on, for what feels contact."""
        from gcode.firmware.contact import ProbeContact

        if self.contact is None:
            self.contact = ProbeContact.of(self.profile.probe, surface, seed=seed)
            self.contact.dead = self.dead_probe
        self.contact.surface = surface

    def feel_what_is_laid(self) -> None:
        """Have what this printer itself lays stand on the bed."""
        from gcode.firmware.laid import Laid

        self.laid = Laid(self.profile)
        self.stand(self.laid.surface)

    def forget_executed(self) -> None:
        """Let go of what was executed; what it laid stays."""
        executed = self.planner.executed
        if self.laid is not None:
            self.laid.add(MotionBatch.from_bytes(executed.tobytes()[self._laid_bytes :]))
            self._laid_bytes = 0
        del executed[:]

    def lay_executed(self) -> None:
        """What was executed so far stands there to be felt."""
        if self.laid is not None:
            told = self.planner.executed.tobytes()
            self.laid.add(MotionBatch.from_bytes(told[self._laid_bytes :]))
            self._laid_bytes = len(told)

    def power_up(self) -> None:
        """Forget everything, as after a reset; the clock and what was executed stay."""
        executed = self.planner.executed
        self.planner = self._new_planner()
        self.planner.executed = executed
        self.heads = Heads(
            self.profile.nozzles, self.clock_s, waits_cooler=self.variant.waits_cooler
        )
        self.bed = Heater(BED_HEATER)
        self.bed.set_target(0.0, self.clock_s)
        self.x = self.y = self.z = 0.0
        self.e = self.native_e = 0.0  # logical, as G92 sets it; and all of it
        self.offset = [0.0, 0.0, 0.0]  # logical = native + offset
        self.homed = False
        self.unhomed = set("XYZ") if "unhomed" in self.variant.refuses else set()
        self.motors_off_s = self.variant.motors_off_s
        self.planner.moved_s = self.clock_s
        self.absolute = True
        self.absolute_e = True
        self.unit_mm = 1.0
        self.feed_mm_s = 25.0
        self.speed_ratio = self.flow_ratio = 1.0
        self.fan_ratio = 0.0
        self.min_extrude_c = self.profile.min_extrude_c
        self.may_extrude_cold = False
        self.killed = False
        self.shut_down = ""  # why; a Klipper that has shut down still answers
        self.auto_temperature_s = self.auto_position_s = 0.0
        self.message = ""
        self.wait = None

    @property
    def hotend(self) -> Heater:
        """The heater of the head that is chosen."""
        return self.heads.heater

    def _new_planner(self) -> Planner:
        profile = self.profile
        return Planner(
            max_speed_mm_s=profile.max_speed_mm_s.xyze,
            max_acceleration_mm_s2=profile.max_acceleration_mm_s2.xyze,
            max_jerk_mm_s=profile.max_jerk_mm_s.xyze,
        )

    @property
    def e_is_absolute(self) -> bool:
        """Whether an E tells where the extruder is to be; Klipper's G91 makes it relative, too."""
        if self.variant.modes_follow_g90 == "relative_only":
            return self.absolute_e and self.absolute
        return self.absolute_e

    def target_of(self, words: dict[str, float]) -> tuple[tuple[float, float, float], float]:
        """Where words lead to, in the modes there are, mm; and how much they extrude, mm."""
        here = [self.x, self.y, self.z]
        for axis, letter in enumerate("XYZ"):
            if letter in words:
                value = words[letter] * self.unit_mm
                here[axis] = value - self.offset[axis] if self.absolute else here[axis] + value
        de = 0.0
        if "E" in words:
            de = words["E"] * self.unit_mm - (self.e if self.e_is_absolute else 0.0)
        if words.get("F", 0) > 0:
            self.feed_mm_s = mm_s_from_mm_min(words["F"] * self.unit_mm)
        return (here[0], here[1], here[2]), de

    def move_to(self, target: tuple[float, float, float], de_mm: float) -> bool:
        """Queue a move; a full queue lets the clock run until there is room. False: refused."""
        if not self.planner.blocks:
            self._let_go()
        start = (self.x, self.y, self.z)
        if self.unhomed and any(
            axis in self.unhomed and a != b for axis, a, b in zip("XYZ", start, target, strict=True)
        ):
            return self._refused("unhomed", target, de_mm)
        if self.homed:
            within = self._soft_limits(target)
            if within != target and "out_of_range" in self.variant.refuses:
                return self._refused("out_of_range", target, de_mm)
            target = within
        pushed_mm = de_mm * self.flow_ratio
        if de_mm and self._too_cold():
            if "cold" in self.variant.refuses:
                return self._refused("cold", target, de_mm)
            self.replies.append(self.variant.cold)
            pushed_mm = 0.0
        elif self.clogged_moves > 0 and pushed_mm > self.pulled_mm + E_DIGIT_MM:
            self.clogged_moves -= 1
            pushed_mm = self.pulled_mm  # so far it meets with no resistance
        elif pushed_mm > MAX_EXTRUDE_MM:
            self.replies.append("echo: too long extrusion prevented")
            pushed_mm = 0.0
        self.pulled_mm = max(self.pulled_mm - pushed_mm, 0.0)
        self.e += de_mm
        self.native_e += de_mm
        self.x, self.y, self.z = target
        planner = self.planner
        if planner.full:
            planner.start_head(self.clock_s)
            self.let_pass(max(planner.head_end_s, self.clock_s))
        planner.push(start, target, pushed_mm, self.feed_mm_s * self.speed_ratio)
        return True

    def _refused(self, why: str, target: tuple[float, float, float], de_mm: float) -> bool:
        """Say so; where it is and where it takes E to be stay as they were."""
        x, y, z = target
        to = f": {x:.3f} {y:.3f} {z:.3f} [{self.native_e + de_mm:.3f}]"
        self.replies.append(self.variant.refuses[why].format(to=to))
        return False

    def _too_cold(self) -> bool:
        return not self.may_extrude_cold and (
            self.hotend.temperature_c(self.clock_s) < self.min_extrude_c
        )

    def _let_go(self) -> None:
        """Let the motors go if they have rested for long; Marlin does not forget that it homed."""
        if self.clock_s - self.planner.moved_s <= self.motors_off_s:
            return
        self.let_go += 1
        self.planner.moved_s = self.clock_s
        if "unhomed" in self.variant.refuses:
            self.unhomed = set("XYZ")

    def _soft_limits(self, target: tuple[float, float, float]) -> tuple[float, float, float]:
        x0, y0, x1, y1 = self.profile.bed_box_mm
        x = min(max(target[0], x0 - SOFT_MARGIN_MM), x1 + SOFT_MARGIN_MM)
        y = min(max(target[1], y0 - SOFT_MARGIN_MM), y1 + SOFT_MARGIN_MM)
        return x, y, min(max(target[2], 0.0), self.profile.max_z_mm)

    def let_pass(self, until_s: float) -> None:
        """Let the clock run to `until_s` and execute what ends by then."""
        self.planner.advance(until_s, self.clock_s)
        self.clock_s = max(self.clock_s, until_s)
        if self.wait is not None and self.wait.heating:
            self.planner.moved_s = self.clock_s  # M109 and M190 keep the motors on

    def arc(self, rest: bytes, *, clockwise: bool) -> None:
        """Queue the chords of a G2 or G3."""
        words = words_of(rest)
        refusal = self.variant.refuses.get("arc")
        if refusal and ("R" in words or not self.absolute):
            what = "R moves" if "R" in words else "relative move mode"
            self.replies.append(refusal.format(what=what))
            return
        start = (self.x, self.y, self.z)
        target, de_mm = self.target_of(words)
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
            if not self.move_to(target if index == count else point, de_mm / count):
                return

    def record_jump(self, here: tuple[float, float, float]) -> None:
        """Record a move made outside of the queue, by homing."""
        there = (self.x, self.y, self.z)
        if here != there:
            self.planner.executed.extend((*here, *there, 0.0, HOMING_MM_S, self.clock_s))

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

    def kill(self, why: str) -> None:
        """Stop for good: heaters off, queue dropped; `why` is empty where M112 asked for it."""
        if self.shut_down:
            return
        self.quick_stop()
        self.fan_ratio = 0.0
        heaters = (*self.heads.heaters, self.bed)
        if self.variant.once_halted:
            for heater in heaters:
                heater.cut(self.clock_s)  # its boards do so; klippy goes on telling the target
            self.shut_down = why or "Shutdown due to M112 command"
        else:
            for heater in heaters:
                heater.set_target(0.0, self.clock_s)
            if why:
                self.replies.append(f"{self.variant.error_prefix}{why}")
            self.killed = True
        self.replies.append(self.variant.halted)

    def refuse_shut_down(self) -> None:
        """What a firmware that has halted, and is not deaf, says to whatever it is told."""
        self.replies += [text.format(why=self.shut_down) for text in self.variant.once_halted]

    def quick_stop(self) -> None:
        """Drop the queue (M410)."""
        place = self.planner.stop(self.clock_s, self.clock_s)
        if place is not None:
            self.x, self.y, self.z = place
        self.wait = None

    def temperatures(self) -> str:
        """The text of a temperature report."""
        each, now_s = self.heads.heaters, self.clock_s
        word = self.variant.heat_of_head
        told = "".join(
            word.format(heater.temperature_c(now_s), heater.target_c, k=k)
            for k, heater in enumerate(each)
        )
        of_each = told if len(each) > 1 or self.variant.tells_each_head else ""
        return self.variant.heat.format(
            *(
                c
                for heater in (self.hotend, self.bed)
                for c in (heater.temperature_c(now_s), heater.target_c)
            ),
            heads=of_each,
        )

    def position_text(self) -> str:
        """The text of a position report."""
        native = (self.x, self.y, self.z)
        x, y, z = (place + off for place, off in zip(native, self.offset, strict=True))
        steps = f"X:{int(self.x * 80)} Y:{int(self.y * 80)} Z:{int(self.z * 400)}"
        return self.variant.place.format(x=x, y=y, z=z, e=self.e, steps=steps)


def words_of(rest: bytes) -> dict[str, float]:
    """Parameters by letter; a letter without a number counts as 0."""
    words: dict[str, float] = {}
    for letter, number in _RAW_WORD.findall(rest.upper()):
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
