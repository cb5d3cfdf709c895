"""The emulated machine: what each command does to the mechanics, and what it answers.

It takes commands already freed of number and checksum (`core` does that) and answers in text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import partial

from gcode.firmware.mechanics import HOMING_MM_S, LARGEST, Mechanics, words_of
from gcode.firmware.thermal import RESIDENCY_S, Heater
from gcode.firmware.variants import Variant
from gcode.profiles import PrinterProfile


class Machine(Mechanics):
    """Commands by their numbers, each carried out by the mechanics."""

    def __init__(self, profile: PrinterProfile, variant: Variant) -> None:
        super().__init__(profile, variant)
        self._commands = self._command_table()

    # ------------------------------------------------------------------ commands

    def execute(self, command: bytes) -> bool:
        """Carry out one command; False if it is not known. Replies go to `replies`."""
        name, _, rest = command.partition(b" ")
        if self.variant.any_case:
            name = name.upper()
            rest = rest.upper() if name.startswith(b"G") else rest
            command = name + command[len(name) :]
        if self.shut_down and name not in _ONCE_HALTED:
            self.refuse_shut_down()
            return False
        handler = self._commands.get(name)
        if handler is None:
            match = re.match(rb"([GMTP])\s*0*(\d+)(?:\.\d+)?", command)
            if match is None:
                return self._unknown(command)
            name, rest = match.group(1) + match.group(2), command[match.end() :]
            handler = self._commands.get(name)
            if handler is None:
                return self._unknown(command)
        handler(rest)
        return True

    def _unknown(self, command: bytes) -> bool:
        text = command.decode("latin-1")
        says = self.variant.no_tool if re.match(r"T\d", text) else self.variant.unknown
        if says:
            self.replies.append(says.format(command=text, name=text.split(" ")[0]))
        return False

    def _command_table(self) -> dict[bytes, Callable[[bytes], None]]:
        table: dict[bytes, Callable[[bytes], None]] = {b"G0": self._g1, b"G1": self._g1}
        for name in dir(self):
            if re.fullmatch(r"_[gm]\d+", name):
                table[name[1:].upper().encode()] = getattr(self, name)
        for named, way in self.variant.named.items():
            table[named] = getattr(self, f"_{way}")
        takes = self.variant.takes
        if (heads := self.profile.heads) > 1:
            table |= {f"T{k}".encode(): partial(self._choose, k) for k in range(heads)}
            takes |= self.variant.parks
        for taken in takes:
            table.setdefault(taken, self._ignore)
        for unbuilt in self.variant.unbuilt:
            table.pop(unbuilt)
        return table

    def _choose(self, head: int, rest: bytes) -> None:
        other = self.heads.choose(head, self.clock_s)
        if other and self.variant.tool_zeroes_e:
            self.e = 0.0

    def _ignore(self, rest: bytes) -> None:
        """Accept a command whose effect an emulated machine cannot show."""

    def _g1(self, rest: bytes) -> None:
        x, y, z, de = self.x, self.y, self.z, 0.0
        unit = self.unit_mm
        for token in rest.split():
            letter = token[0]
            try:
                value = float(token[1:])
            except ValueError:
                return self._g1_words(words_of(rest))
            if not -LARGEST <= value <= LARGEST:
                return self._g1_words(words_of(rest))
            if letter == 88:  # X
                x = value * unit - self.offset[0] if self.absolute else x + value * unit
            elif letter == 89:  # Y
                y = value * unit - self.offset[1] if self.absolute else y + value * unit
            elif letter == 90:  # Z
                z = value * unit - self.offset[2] if self.absolute else z + value * unit
            elif letter == 69:  # E
                de = value * unit - self.e if self.e_is_absolute else value * unit
            elif letter == 70 and value > 0:  # F; Marlin takes no other for a feed
                self.feed_mm_s = value * unit / 60.0
        self.move_to((x, y, z), de)
        return None

    def _g1_words(self, words: dict[str, float]) -> None:
        target, de = self.target_of(words)
        self.move_to(target, de)

    def _g2(self, rest: bytes) -> None:
        self.arc(rest, clockwise=True)

    def _g3(self, rest: bytes) -> None:
        self.arc(rest, clockwise=False)

    def _g4(self, rest: bytes) -> None:
        words = words_of(rest)
        seconds = words.get("S", words.get("P", 0.0) / 1000.0)
        self.wait_for(self.planner.drained_s(self.clock_s) + seconds)

    def _g10(self, rest: bytes) -> None:
        """Firmware retraction, which this firmware is built without."""

    def _g20(self, rest: bytes) -> None:
        if "inches" in self.variant.refuses:
            self.replies.append(self.variant.refuses["inches"])
            return
        self.unit_mm = 25.4

    def _g21(self, rest: bytes) -> None:
        self.unit_mm = 1.0

    def _g28(self, rest: bytes) -> None:
        axes = {chr(token[0]) for token in rest.split()} & {"X", "Y", "Z"} or {"X", "Y", "Z"}
        self._home(axes)

    def _home(self, axes: set[str], *, until_s: float = 0.0) -> None:
        """Home some axes, and be done at `until_s` at the earliest."""
        if self.profile.delta:  # its carriages know no axis alone
            axes = {"X", "Y", "Z"}
        ends = (0.0, 0.0, self.profile.max_z_mm if self.profile.delta else 0.0)
        target = tuple(
            end if letter in axes else value
            for letter, value, end in zip("XYZ", (self.x, self.y, self.z), ends, strict=True)
        )
        distance = math.dist(target, (self.x, self.y, self.z))
        drained_s = self.planner.drained_s(self.clock_s)

        def homed() -> None:
            here = (self.x, self.y, self.z)
            self.x, self.y, self.z = target
            for axis, letter in enumerate("XYZ"):
                if letter in axes:
                    self.offset[axis] = 0.0
            self.planner.moved_s = self.clock_s
            self.unhomed -= axes
            if axes == {"X", "Y", "Z"}:
                self.homed = True
            self.record_jump(here)

        self.wait_for(
            max(until_s, drained_s + 2.0 + distance / HOMING_MM_S),
            heating=until_s > 0,
            then=homed,
        )

    def _start_print(self, rest: bytes) -> None:
        """Home and heat, as macros of this name do by convention."""
        until_s = 0.0
        for key, value in re.findall(r"(\w+)=(\d+(?:\.\d+)?)", rest.decode("latin-1").upper()):
            bed = "BED" in key
            if bed or any(word in key for word in ("EXTRUDER", "HOTEND", "NOZZLE")):
                heater = self.bed if bed else self.hotend
                if bed:
                    heater.set_target(float(value), self.clock_s)
                else:
                    self.heads.heat(self.heads.chosen, float(value), self.clock_s)
                until_s = max(until_s, heater.reached_s(cooling=False))
        self._home({"X", "Y", "Z"}, until_s=until_s)

    def _end_print(self, rest: bytes) -> None:
        for head in range(len(self.heads.heaters)):
            self.heads.heat(head, 0.0, self.clock_s)
        self.bed.set_target(0.0, self.clock_s)

    def _g29(self, rest: bytes) -> None:
        def probed() -> None:
            self.replies.append("Bilinear Leveling Grid:")
            self.replies.append("      0      1      2")
            for row in range(3):
                self.replies.append(f" {row} +0.000 +0.000 +0.000")

        self.wait_for(self.planner.drained_s(self.clock_s) + 45.0, then=probed)

    def _g38(self, rest: bytes) -> None:
        """Go straight to a Z until something is touched (G38.2), or say that nothing was.

        Marlin's G38.cpp; RepRapFirmware's own words differ, and begin with `Error:` as well.
        """
        (_, _, target_mm), _ = self.target_of(words_of(rest))

        def stopped(touched: bool) -> None:
            if not touched:
                self.replies.append(f"{self.variant.error_prefix}Failed to reach target")

        self._feel_down_to(target_mm, self.feed_mm_s, stopped)

    def _amrepair_touch(self, rest: bytes) -> None:
        """Do what our macro around Klipper's PROBE does (`gcode/resumption/klipper_touch.cfg`)."""
        said = dict(word.partition(b"=")[::2] for word in rest.upper().split())
        try:
            depth_mm, speed_mm_s = float(said[b"DEPTH"]), float(said[b"SPEED"])
        except (KeyError, ValueError):
            self.replies.append("!! Error evaluating 'gcode_macro AMREPAIR_TOUCH:gcode'")
            return

        def stopped(touched: bool) -> None:
            if touched:
                z_mm = self.z + self.offset[2]
                self.replies.append(f"// amrepair: touched at z={z_mm:.4f}")
            else:
                self.replies.append("!! No trigger on probe after full movement")
                self.replies.append("// amrepair: nothing was touched")

        self._feel_down_to(self.z - depth_mm, speed_mm_s, stopped)

    def _set_kinematic_position(self, rest: bytes) -> None:
        """Take an axis for where it is told to be, and for homed (klippy/extras/force_move.py)."""
        for word in rest.upper().split():
            letter, _, value = word.partition(b"=")
            if letter == b"CLEAR_HOMED":
                self.unhomed |= set(value.decode()) & set("XYZ")
                continue
            axis = b"XYZ".find(letter)
            if axis >= 0:
                self.offset[axis] = float(value) - (self.x, self.y, self.z)[axis]
                self.unhomed.discard(letter.decode())

    def _feel_down_to(
        self, target_mm: float, speed_mm_s: float, then: Callable[[bool], None]
    ) -> None:
        """Go straight down until something is felt, or to a native Z; then say whether it was."""
        drained_s = self.planner.drained_s(self.clock_s)
        here = (self.x, self.y, self.z)
        self.lay_executed()
        met_mm = None if self.contact is None else self.contact.met_at_mm(self.x, self.y)
        touched = met_mm is not None and target_mm <= met_mm <= self.z
        end_mm = met_mm if touched and met_mm is not None else min(target_mm, self.z)

        def stopped() -> None:
            self.z = end_mm
            self.record_jump(here)
            if self.contact is not None:
                self.contact.note(self.x, self.y, self.z)
            then(touched)

        self.wait_for(drained_s + (here[2] - end_mm) / speed_mm_s, then=stopped)

    def _temperature_wait(self, rest: bytes) -> None:
        """Klipper's wait until a sensor is warm or cold enough (klippy/extras/heaters.py)."""
        said = dict(word.partition(b"=")[::2] for word in rest.upper().split())
        heater = self.bed
        if (sensor := said.get(b"SENSOR")) != b"HEATER_BED":
            if (head := self._named_head(sensor or b"")) is None:
                return
            heater = self.heads.heaters[head]
        if b"MAXIMUM" in said:
            end_s = heater.cooled_s(float(said[b"MAXIMUM"]), self.clock_s)
        else:
            end_s = heater.reached_s(cooling=False)
        self.wait_for(max(end_s, self.planner.drained_s(self.clock_s)), heating=True)

    def _g90(self, rest: bytes) -> None:
        self.absolute = True
        if self.variant.modes_follow_g90 == "both":
            self.absolute_e = True

    def _g91(self, rest: bytes) -> None:
        self.absolute = False
        if self.variant.modes_follow_g90 == "both":
            self.absolute_e = False

    def _g92(self, rest: bytes) -> None:
        words = words_of(rest)
        for axis, letter in enumerate("XYZ"):
            if letter in words:
                native = (self.x, self.y, self.z)[axis]
                self.offset[axis] = words[letter] * self.unit_mm - native
                if self.variant.g92_homes:  # GCodes::SetPositions
                    self.unhomed.discard(letter)
        if "E" in words:
            self.e = words["E"] * self.unit_mm

    def _m0(self, rest: bytes) -> None:
        words = words_of(rest)
        seconds = words.get("S", words.get("P", 0.0) / 1000.0)
        end_s = self.planner.drained_s(self.clock_s) + seconds if seconds else math.inf
        self.wait_for(end_s, reason="paused for user")

    _m1 = _m0

    def _m82(self, rest: bytes) -> None:
        self.absolute_e = True

    def _m83(self, rest: bytes) -> None:
        self.absolute_e = False

    def _m84(self, rest: bytes) -> None:
        words = words_of(rest)
        if "S" in words and self.variant.m84_sets_time:
            self.motors_off_s = words["S"] or math.inf
        else:
            self.planner.moved_s = -math.inf

    _m18 = _m84

    def _m104(self, rest: bytes) -> None:
        words = words_of(rest)
        if (head := self._meant(b"M104", words.get("T"))) is not None:
            self.heads.heat(head, words.get("S", 0.0), self.clock_s)

    def _m140(self, rest: bytes) -> None:
        self.bed.set_target(words_of(rest).get("S", 0.0), self.clock_s)

    def _m109(self, rest: bytes) -> None:
        words = words_of(rest)
        if (head := self._meant(b"M109", words.get("T"))) is not None:
            heater = self.heads.heaters[head]
            self.heads.heat(head, words.get("R", words.get("S", heater.target_c)), self.clock_s)
            self._wait_for_heat_of(heater, words)

    def _m190(self, rest: bytes) -> None:
        words = words_of(rest)
        self.bed.set_target(words.get("R", words.get("S", self.bed.target_c)), self.clock_s)
        self._wait_for_heat_of(self.bed, words)

    def _meant(self, command: bytes, told: float | None) -> int | None:
        """The head that a line's T means, or none; one that is not there is said to be none."""
        head = self.heads.meant(told)
        if head is None and self.variant.no_tool:
            name = f"{command.decode()} T{told:g}"
            self.replies.append(self.variant.no_tool.format(name=name))
        return head

    def _tool_settings(self, rest: bytes) -> None:
        """RepRapFirmware's temperatures of a head; without P it is a firmware retraction."""
        words = words_of(rest)
        if "P" in words and (head := self._meant(b"G10", words["P"])) is not None:
            self.heads.tell(head, words.get("S"), words.get("R"), self.clock_s)

    def _wait_for_heat(self, rest: bytes) -> None:
        """RepRapFirmware's wait for all heaters, or those of one head."""
        head = self.heads.meant(words_of(rest).get("P"))
        each = (
            self.heads.heaters if b"P" not in rest.upper() else self.heads.heaters[head or 0 :][:1]
        )
        end_s = max(heater.reached_s(cooling=False) for heater in each)
        self.wait_for(max(end_s, self.planner.drained_s(self.clock_s)), heating=True)

    def _set_heater_temperature(self, rest: bytes) -> None:
        """Klipper's (klippy/extras/heaters.py); without a target it switches off."""
        said = dict(word.partition(b"=")[::2] for word in rest.upper().split())
        name, target_c = said.get(b"HEATER", b""), float(said.get(b"TARGET", b"0"))
        if name == b"HEATER_BED":
            self.bed.set_target(target_c, self.clock_s)
        elif (head := self._named_head(name)) is not None:
            self.heads.heat(head, target_c, self.clock_s)

    def _activate_extruder(self, rest: bytes) -> None:
        """Klipper's (klippy/kinematics/extruder.py)."""
        said = dict(word.partition(b"=")[::2] for word in rest.upper().split())
        if (head := self._named_head(said.get(b"EXTRUDER", b""))) is not None:
            self._choose(head, b"")

    def _named_head(self, name: bytes) -> int | None:
        match = re.fullmatch(rb"EXTRUDER(\d{0,3})", name)
        head = None if match is None else int(match[1] or b"0")
        if head is None or head >= len(self.heads.heaters):
            self.replies.append(f"!! The value '{name.decode('latin-1').lower()}' is not valid")
            return None
        return head

    def _wait_for_heat_of(self, heater: Heater, words: dict[str, float]) -> None:
        reached_s = heater.reached_s(cooling="R" in words)
        if reached_s > self.clock_s:
            reached_s += RESIDENCY_S
        self.wait_for(max(reached_s, self.planner.drained_s(self.clock_s)), heating=True)

    def _m105(self, rest: bytes) -> None:
        self.ok_text = " " + self.temperatures()

    def _m106(self, rest: bytes) -> None:
        self.fan_ratio = min(1.0, max(0.0, words_of(rest).get("S", 255.0) / 255.0))

    def _m107(self, rest: bytes) -> None:
        self.fan_ratio = 0.0

    def _m108(self, rest: bytes) -> None:
        """Acts only through the emergency parser; read from the queue it comes too late."""

    def _m112(self, rest: bytes) -> None:
        self.kill("")

    def _m410(self, rest: bytes) -> None:
        self.quick_stop()

    def _m114(self, rest: bytes) -> None:
        self.replies.append(self.position_text())

    def _m115(self, rest: bytes) -> None:
        line = self.variant.firmware_line.format(machine=self.profile.name)
        if self.variant.about_in_ok:
            self.ok_text = " " + line
            return
        self.replies.append(line)
        for name, enabled in self.variant.capabilities:
            self.replies.append(f"Cap:{name}:{int(enabled)}")

    def _m117(self, rest: bytes) -> None:
        self.message = rest.decode("latin-1")

    def _m118(self, rest: bytes) -> None:
        switches = re.match(rb"(?:\s*[AEP]\d\s+)*", rest)
        assert switches is not None
        before = {b"A1": "//", b"E1": "echo:"}  # one of them, says Marlin
        said = [before[word] for word in switches.group().split() if word in before]
        self.replies.append("".join(said[:1]) + rest[switches.end() :].decode("latin-1"))

    def _m154(self, rest: bytes) -> None:
        self.auto_position_s = words_of(rest).get("S", 0.0)

    def _m155(self, rest: bytes) -> None:
        self.auto_temperature_s = words_of(rest).get("S", 0.0)

    def _m201(self, rest: bytes) -> None:
        self._set_axes(self.planner.max_acceleration, words_of(rest))

    def _m203(self, rest: bytes) -> None:
        self._set_axes(self.planner.max_speed, words_of(rest))

    def _m205(self, rest: bytes) -> None:
        self._set_axes(self.planner.max_jerk, words_of(rest))

    @staticmethod
    def _set_axes(values: list[float], words: dict[str, float]) -> None:
        for axis, letter in enumerate("XYZE"):
            if words.get(letter, 0.0) > 0:
                values[axis] = words[letter]

    def _m204(self, rest: bytes) -> None:
        words, planner = words_of(rest), self.planner
        if words.get("S", 0) > 0:
            planner.print_acceleration = planner.travel_acceleration = words["S"]
        if words.get("P", 0) > 0:
            planner.print_acceleration = words["P"]
        if words.get("T", 0) > 0:
            planner.travel_acceleration = words["T"]
        if words.get("R", 0) > 0:
            planner.retract_acceleration = words["R"]

    def _m220(self, rest: bytes) -> None:
        self.speed_ratio = max(0.01, words_of(rest).get("S", 100.0) / 100.0)

    def _m221(self, rest: bytes) -> None:
        self.flow_ratio = max(0.0, words_of(rest).get("S", 100.0) / 100.0)

    def _m302(self, rest: bytes) -> None:
        words = words_of(rest)
        if "S" in words:
            self.min_extrude_c = words["S"]
        self.may_extrude_cold = words.get("P", float(self.may_extrude_cold)) > 0

    def _m400(self, rest: bytes) -> None:
        self.wait_for(self.planner.drained_s(self.clock_s))


_ONCE_HALTED = frozenset({b"M105", b"M112", b"M114", b"M115"})
"""What a firmware that has halted, and is not deaf, still carries out."""
