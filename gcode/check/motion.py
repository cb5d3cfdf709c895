"""Rules of moves: where they may go, how fast, and how much plastic they may lay.

This module holds the machine's state as moves change it, and knows what moves mean in a dialect.
All other commands are those of `commands` and `rules`.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from gcode.check import plain_kernels as plain
from gcode.check.arcs import centre_by_radius, points_of_arc
from gcode.check.findings import Moves, Policy, Refusal, Text, Warnings
from gcode.check.heads import heads_of
from gcode.check.words import (
    G91_MOVES_E,
    GIVES_UP_UNHOMED,
    LENIENT_OF_MOVES,
    LINE_LIMIT,
    NO_ARCS_AFTER_G91,
    NO_ARCS_BY_RADIUS,
)
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.reader.text_kernels import INCH_MM

# Plastic is told in five digits: what is shorter than this is judged with its neighbours.
SHORT_MM = 0.05
# Rounding of E and XYZ in the text, and a firmware's own flow, stay within this.
SECTION_SLACK = 1.05
FLOW_SLACK = 1.05
PLACE_SLACK_MM = 0.011
# A feed beyond this is a slip of units, whatever the firmware clamps (FLSun's S1: 1,200 mm/s).
UNIT_SLIP_MM_S = 1500.0
# Firmwares clamp a feed to their own limit, and slicers ask for more (300 mm/s in Voron's own
# printer.cfg, 350 to 500 in OrcaSlicer's profiles): far beyond it a file is another machine's.
# Along Z and E slicers write the travel speed, whatever the axis does.
FEED_SLACK = 2.0
# Wipes pull back on the move; relative values that are read as absolute do half of the way.
BACKWARDS_RATIO, BACKWARDS_MOVES = 0.25, 10
# Klipper's `[idle_timeout]` gives a hot machine that stands still ten minutes.
STILL_S = 600.0
# What stands molten in a hotend (the melt zone of a V6 is 10 mm long) is pushed out at any speed: a
# drop that a job primes with after a retraction.
MOLTEN_MM = 5.0
# Between a bead and a blob that the nozzle drags along, and between what a bowden tube loads and a
# slip of E, lies a factor of three: what a user's job asks beyond it is no other taste.
GROSS = 3.0
LEAST_BEAD_Z_MM = 0.02  # the thinnest layer that a process profile may have
# What else a program of ours may need, which goes on from what stands on the bed.
STANDS_THERE = ", or give what stands on the bed (--as-built): there Z is known"


class Motion:
    """The machine as moves change it; collects refusals and moves.

    Parameters
    ----------
    standing_top_mm
        The height of what stands on the bed; None for a bare bed.
    initial
        The machine's state before the first line; None for a machine that is cold and not homed.
    policy
        Whether what goes beyond the profiles' figures is refused, or only told.
    """

    def __init__(
        self,
        program: Program,
        setup: PrintSetup,
        standing_top_mm: float | None,
        initial: ModalState | None,
        policy: Policy,
    ) -> None:
        self.refusals: list[Refusal] = []
        self.warnings = Warnings()
        self.policy = policy
        self.moves = Moves()
        self.commands = 0
        self._setup, self._dialect = setup, program.dialect
        self._filament_mm2 = math.pi / 4 * setup.printer.filament_diameter_mm**2
        self._factor = {"M221": 1.0, "M220": 1.0}
        self._alone = initial is None
        self._standing_top_mm = standing_top_mm
        self._stood = initial is not None or standing_top_mm is not None
        self._stood_before = self._stood  # before the present move
        self._beside_bed = False  # the present move
        state = initial
        self._place: list[float | None] = [None] * 3 if state is None else [*state.position_mm]
        # A part stands on a machine that was not switched off, so Z is still true.
        self._homed = [state is not None] * 2 + [self._stood]
        self._absolute = state.absolute_xyz if state else True
        self._absolute_e = state.absolute_e if state else True
        self._e = state.e_mm if state else 0.0
        self._feed_mm_s = state.feed_mm_s if state else 0.0
        self._unit = 1.0 if state is None or state.units_mm else INCH_MM
        self._heads, chosen = heads_of(setup.printer, state)
        self._head = self._heads[chosen]
        self._bed_c = state.bed_c if state else 0.0
        self._risen_mm = 0.0  # by moves of Z before it was homed
        self._heats_unsaid = False  # whether a macro ran that may have heated something
        self._chamber_c = 0.0
        self._short_mm3 = 0.0
        self._line, self._text = 0, ""
        printer = setup.printer
        x0, y0, x1, y1 = printer.reach_box_mm
        low = (x0 - PLACE_SLACK_MM, y0 - PLACE_SLACK_MM, -PLACE_SLACK_MM)
        high = (x1 + PLACE_SLACK_MM, y1 + PLACE_SLACK_MM, printer.max_z_mm + PLACE_SLACK_MM)
        self._limits_of_moves = (
            *low, *high, UNIT_SLIP_MM_S, SHORT_MM, SECTION_SLACK * printer.max_bead_section_mm2,
            printer.max_extrude_only_mm, LINE_LIMIT[program.dialect], LEAST_BEAD_Z_MM, MOLTEN_MM,
        )  # fmt: skip

    def follow(self, text: Text, first: int, end: int) -> int:
        """Judge plain moves from line `first` on, by compiled code; returns the first other line.

        It stops before `end`, and at any line that is no plain move or that `Judge.read` might
        refuse: that line is left to `read`, so that there is only one judgement.
        """
        if None in self._place or not all(self._homed):
            return first
        state = self._state()
        counts = np.array([0, self.moves.count])
        rows = self.moves.with_room_for(end - first)
        at = plain.follow(
            text.data, text.starts, first - 1, end - 1, self._plain_limits(), state, rows, counts
        )
        self.commands += int(counts[0])
        self.moves.count = int(counts[1])
        *place, self._e, self._feed_mm_s, self._head.pulled_mm, self._short_mm3 = state[:7].tolist()
        self._place = place
        return int(at) + 1

    def _state(self) -> Float[np.ndarray, " n"]:
        modes = (self._absolute, self._e_is_absolute, self._unit)
        used = (self._e, self._feed_mm_s, self._head.pulled_mm, self._short_mm3)
        return np.array([*self._place, *used, *modes], dtype=np.float64)

    def _plain_limits(self) -> Float[np.ndarray, " n"]:
        speed, faster = self._setup.printer.max_speed_mm_s, self._factor["M220"]
        flow = FLOW_SLACK * self._setup.max_volumetric_mm3_s / faster
        fastest = (FEED_SLACK * speed.x / faster, FEED_SLACK * speed.y / faster)
        return np.array(
            [*self._limits_of_moves, *fastest, self._area_mm2, flow, self._cold, STILL_S * faster],
            dtype=np.float64,
        )

    @property
    def _area_mm2(self) -> float:
        """The area by which a length of E becomes a volume, at the current flow factor."""
        return self._filament_mm2 * self._factor["M221"]

    @property
    def _cold(self) -> bool:
        """Whether no line has waited until the hotend melts plastic.

        In a user's job a macro may have heated it, and is given the benefit of the doubt.
        """
        may_be_hot = self._heats_unsaid and self._lenient
        return self._head.ready_c < self._setup.printer.min_extrude_c and not may_be_hot

    @property
    def _lenient(self) -> bool:
        return self.policy is Policy.DANGER

    @property
    def _occupied(self) -> bool:
        """Whether something stands on the bed: from before, or laid by the program itself."""
        self._stood = self._stood or self.moves.sums.laid  # what is laid stays
        return self._stood

    @property
    def _top_mm(self) -> float | None:
        """The height of what stands on the bed, as far as it is known; None where nothing does."""
        return max(self.moves.sums.top_mm, self._standing_top_mm or 0.0) or None

    @property
    def _hot_on_part(self) -> bool:
        return self._head.target_c >= self._setup.printer.min_extrude_c and self._occupied

    def _backwards(self, text: Text) -> None:
        """Refuse a program whose E goes back and forth: relative values, read as absolute ones."""
        sums = self.moves.sums
        if sums.pulled < BACKWARDS_MOVES:
            return
        ratio = sums.pulled_mm / sums.way_mm
        if ratio > BACKWARDS_RATIO:
            self._line = sums.first_pulled
            self._text = text.line(self._line)
            self._refuse(
                "pulls filament back as it goes (relative values of E, read as absolute?)",
                f"{ratio:.0%} of the way that E goes along",
                f"{BACKWARDS_RATIO:.0%}",
            )

    def _refuse(self, what: str, value: str, limit: str) -> None:
        self.refusals.append(Refusal(self._line, self._text, what, value, limit))

    def _beyond(
        self, what: str, value: str, limit: str, over_ratio: float, gross: float = GROSS
    ) -> bool:
        """Refuse what goes beyond a figure of the profile; in a user's job only warn of it.

        Parameters
        ----------
        over_ratio, gross
            How many times the figure it is; a user's job is refused, too, beyond `gross`.

        Returns
        -------
        Whether it is refused.
        """
        if self.policy is Policy.STRICT or over_ratio > gross:
            self._refuse(what, value, limit)
            return True
        self._warn(what, value, limit, over_ratio)
        return False

    def _warn(self, what: str, value: str, limit: str, over_ratio: float = 1.0) -> None:
        refusal = Refusal(self._line, self._text, what, value, limit)
        self.warnings.add(refusal, over_ratio)

    def _target(self, words: dict[str, float | None]) -> list[float | None]:
        target = list(self._place)
        for axis, letter in enumerate("XYZ"):
            value = words.get(letter)
            if value is None:
                continue
            here = self._place[axis]
            if self._absolute:
                target[axis] = value * self._unit
            elif here is not None:
                target[axis] = here + value * self._unit
            elif axis == 2 and value < 0:
                what = "relative move down from an unknown height"
                self._refuse(what, f"{value:g} mm", "up only")
        return target

    def _pushed(self, words: dict[str, float | None]) -> float:
        value = words.get("E")
        if value is None:
            return 0.0
        value *= self._unit
        pushed = value - self._e if self._e_is_absolute else value
        self._e += pushed
        return pushed

    @property
    def _e_is_absolute(self) -> bool:
        return self._absolute_e and (self._absolute or self._dialect not in G91_MOVES_E)

    def _feed(self, words: dict[str, float | None]) -> None:
        value = words.get("F")
        if value is None:
            if "F" in words:
                self._refuse("feed without a number", "F", "mm/min")
            return
        feed_mm_s = value * self._unit / 60.0
        if not 0 < feed_mm_s <= UNIT_SLIP_MM_S:
            self._refuse("feed", f"{feed_mm_s:g} mm/s", f"0 to {UNIT_SLIP_MM_S:g} mm/s")
        self._feed_mm_s = max(feed_mm_s, 1e-3)

    def _move(self, words: dict[str, float | None]) -> None:
        for letter in "XYZE":
            if letter in words and words[letter] is None:
                self._refuse("axis without a number", letter, "a number")
                return
        self._feed(words)
        moved = [axis for axis, letter in enumerate("XYZ") if letter in words]
        for axis in moved:
            if not self._homed[axis]:
                self._unhomed(axis, words)
        target = self._target(words)
        self._go(target, self._pushed(words), moved=bool(moved))

    def _unhomed(self, axis: int, words: dict[str, float | None]) -> None:
        """Judge a move of an axis that is not homed: refuse it, or warn of it in a user's job.

        A warning is enough for a move up, away from the bed, which firmwares carry out; and for any
        move on firmwares that either have homed and heated by themselves before the job, or do not
        move at all.
        """
        value = (words["XYZ"[axis]] or 0.0) * self._unit
        to_mm = value if self._absolute else self._risen_mm + value
        rises = axis == 2 and to_mm > self._risen_mm and not (self._absolute and self._occupied)
        # our own goes on from what stands there, where Z is true
        first = "home first" + ("" if self._lenient or self._occupied else STANDS_THERE)
        told = ("move before homing", "XYZ"[axis], first)
        gives_up = self._dialect in GIVES_UP_UNHOMED
        if gives_up and not self._occupied and self._lenient:
            self._warn("move before homing, unless the machine has begun by itself", *told[1:])
            self._homed, self._heats_unsaid = [True] * 3, True
        elif rises and not gives_up and self._lenient:
            self._risen_mm = to_mm
            self._warn(*told)
        else:
            self._refuse(*told)
            self._homed[axis] = True  # said once

    def _arc(self, words: dict[str, float | None], *, clockwise: bool) -> None:
        self._feed(words)
        target, here = self._target(words), self._place
        pushed = self._pushed(words)
        if None in here or None in target or (not self._absolute and "R" in words):
            self._refuse("arc from an unknown place", "G2/G3", "a known place")
            return
        if not self._absolute and self._dialect in NO_ARCS_AFTER_G91:
            self._refuse("arc after G91", "G2/G3", "G90 before it")
            return
        if (words.get("P") or 0.0) > 1:  # OrcaSlicer's spiral hops have P1
            self._refuse("arc of several turns", f"P{words['P']:g}", "P1")
            return
        x0, y0, z0 = (float(v or 0.0) for v in here)
        x1, y1, z1 = (float(v or 0.0) for v in target)
        start, end = (x0, y0, z0), (x1, y1, z1)
        centre = tuple((words.get(letter) or 0.0) * self._unit for letter in "IJ")
        if words.get("R") is not None:
            radius_mm = (words["R"] or 0.0) * self._unit
            found = centre_by_radius(start, end, radius_mm, clockwise=clockwise)
            if found is None or self._dialect in NO_ARCS_BY_RADIUS:
                self._refuse(
                    "arc told by its radius", f"R{words['R']:g}", "I and J, or one that fits"
                )
                return
            centre = found
        apart_mm, points = points_of_arc(start, end, (centre[0], centre[1]), clockwise=clockwise)
        told = ("arc whose ends lie on two circles", f"{apart_mm:.3f} mm", "0.05 mm")
        priming = (
            1.0 if points and not self._occupied else math.inf
        )  # FLSun's, along the bed's edge
        if apart_mm > 0 and self._beyond(*told, priming):
            return
        for k, point in enumerate(points, 1):
            last = k == len(points)
            self._go(target if last else [*point], pushed / len(points), moved=True)

    def _go(self, target: list[float | None], pushed_mm: float, *, moved: bool) -> None:
        here = self._place
        if moved:
            target = self._bounded(target, lays=pushed_mm > 0)
        length_mm = 0.0
        known = None not in here and None not in target
        if known:
            start = (float(here[0] or 0), float(here[1] or 0), float(here[2] or 0))
            end = (float(target[0] or 0), float(target[1] or 0), float(target[2] or 0))
            length_mm = math.dist(start, end)
            self._speed(start, end, length_mm)
            if pushed_mm > 0 and length_mm > SHORT_MM and min(start[2], end[2]) < LEAST_BEAD_Z_MM:
                low_mm = min(start[2], end[2])
                self._refuse("bead in the bed", f"Z {low_mm:g} mm", f"{LEAST_BEAD_Z_MM:g} mm")
            self._stood_before = self._occupied
            self._beside_bed = self._off_bed(start) and self._off_bed(end)
            if length_mm > 0:
                self.moves.add(self._line, start, end, pushed_mm * self._area_mm2)
        elif moved and self._standing_top_mm is not None and pushed_mm <= 0:
            z = target[2]
            if z is not None and z < self._standing_top_mm:
                self._refuse(
                    "move at an unknown place below the top of what stands there",
                    f"Z {z:g} mm",
                    f"{self._standing_top_mm:g} mm",
                )
        self._place = target
        feed_mm_s = self._feed_mm_s * self._factor["M220"]
        if max(length_mm, abs(pushed_mm)) > STILL_S * feed_mm_s > 0:
            seconds = max(length_mm, abs(pushed_mm)) / feed_mm_s
            self._refuse("move that takes too long", f"{seconds:.0f} s", f"{STILL_S:g} s")
        if pushed_mm:
            self._extrude(pushed_mm, length_mm, known=known)

    def _speed(
        self, start: tuple[float, float, float], end: tuple[float, float, float], length_mm: float
    ) -> None:
        feed_mm_s, limits_mm_s = self._feed_mm_s * self._factor["M220"], self._setup.printer
        for axis, letter in enumerate("xy"):
            limit_mm_s = FEED_SLACK * getattr(limits_mm_s.max_speed_mm_s, letter)
            along_mm = abs(end[axis] - start[axis])
            if feed_mm_s * along_mm > limit_mm_s * length_mm:
                along_mm_s = feed_mm_s * along_mm / length_mm
                self._beyond(
                    f"feed of {letter.upper()} beyond what the machine does",
                    f"{along_mm_s:.0f} mm/s",
                    f"{limit_mm_s:g} mm/s, {FEED_SLACK:g} times the profile's",
                    along_mm_s / limit_mm_s,
                    math.inf,  # the firmware goes no faster than it can
                )

    def _off_bed(self, place: tuple[float, float, float]) -> bool:
        x0, y0, x1, y1 = self._setup.printer.bed_box_mm
        return not (x0 <= place[0] <= x1 and y0 <= place[1] <= y1)

    def _bounded(self, target: list[float | None], *, lays: bool) -> list[float | None]:
        """Refuse a target out of reach; returns where the head comes to, None where not known.

        Where the bed's size comes from a slicer and the machine's reach is not known, a user's job
        may go somewhat off the bed. Some firmwares cut a move short that goes far off; where the
        head comes to is then not known.
        """
        printer, reached = self._setup.printer, list(target)
        x0, y0, x1, y1 = printer.reach_box_mm
        untold_mm = printer.off_bed_mm
        cuts = untold_mm > 0 and self._dialect in LENIENT_OF_MOVES and not lays
        for axis, low, high in ((0, x0, x1), (1, y0, y1), (2, 0.0, printer.max_z_mm)):
            value = target[axis]
            if value is None or low - PLACE_SLACK_MM <= value <= high + PLACE_SLACK_MM:
                continue
            told = (f"{'XYZ'[axis]} out of reach", f"{value:g} mm", f"{low:g} to {high:g} mm")
            into_the_bed = axis == 2 and value < low
            near = max(low - value, value - high) <= untold_mm
            if into_the_bed or not (near or cuts):
                self._refuse(*told)
            elif not self._beyond(*told, 1.0) and not near:
                reached[axis] = None
        return reached

    def _extrude(self, pushed_mm: float, length_mm: float, *, known: bool) -> None:
        printer = self._setup.printer
        if pushed_mm > 0 and self._cold:
            self._refuse(
                "cold extrusion", f"hotend waited for at {self._head.ready_c:g} °C",
                f"{printer.min_extrude_c:g} °C",
            )  # fmt: skip
            self._head.ready_c = math.inf  # said once
        if length_mm <= SHORT_MM and (known or self.policy is Policy.STRICT):
            self._short(pushed_mm, length_mm)
            return
        self._short_mm3 = 0.0
        if pushed_mm < 0:
            self._pull(pushed_mm)
            return
        if self._head.pulled_mm > printer.max_extrude_only_mm:
            if (
                self._head.loads
                and pushed_mm * self._area_mm2 > printer.max_bead_section_mm2 * length_mm
            ):
                self._fresh_mm3(pushed_mm)  # too much for a bead: it is on its way to the nozzle
                return
            if not self._head.loads:
                told = (f"{self._head.pulled_mm:.1f} mm", f"{printer.max_extrude_only_mm:g} mm")
                self._refuse("pulls filament back and prints on", *told)
            # said once; or a bead, so what changed the filament loaded it
            self._head.pulled_mm = 0.0
        fresh_mm3 = self._fresh_mm3(pushed_mm)
        self._head.loads = self._head.loads and fresh_mm3 <= 0.0
        if not known:  # from an end stop, which may lie a whole line away
            return
        section_mm2 = fresh_mm3 / length_mm
        limit_mm2 = printer.max_bead_section_mm2
        if section_mm2 > SECTION_SLACK * limit_mm2:
            told = (f"{section_mm2:.3f} mm²", f"{limit_mm2:g} mm²")
            # Purging, before there is a part that a blob could be dragged into, or beside the bed,
            # as each of several heads does, is as thick as may.
            gross = GROSS if self._stood_before and not self._beside_bed else math.inf
            self._beyond("bead too thick", *told, section_mm2 / limit_mm2, gross)
        self._melts(section_mm2)

    def _melts(self, section_mm2: float) -> None:
        """Judge the flow of a section of plastic, for each millimetre that the feed rate counts."""
        flow = section_mm2 * self._feed_mm_s * self._factor["M220"]
        limit = self._setup.max_volumetric_mm3_s
        if flow > FLOW_SLACK * limit:
            told = (f"{flow:.1f} mm³/s", f"{limit:g} mm³/s")
            # What does not melt is not laid, and hurts nothing: the next scan shows it.
            self._beyond("melts more than the hotend can", *told, flow / limit, math.inf)

    def _short(self, pushed_mm: float, length_mm: float) -> None:
        """Judge plastic pushed while the nozzle hardly moves: it adds up until that moves on."""
        printer = self._setup.printer
        if pushed_mm < 0:
            self._pull(pushed_mm)
            return
        fresh_mm3 = self._fresh_mm3(pushed_mm)
        self._short_mm3 += fresh_mm3
        if fresh_mm3 > 0 and self._short_mm3 > MOLTEN_MM * self._area_mm2:
            self._melts(fresh_mm3 / (length_mm or pushed_mm))  # alone, F is the filament's own
        allowed_mm3 = printer.max_extrude_only_mm * self._area_mm2
        if self._short_mm3 > allowed_mm3:
            told = (
                "pushes filament standing still",
                f"{self._short_mm3 / self._area_mm2:.1f} mm",
                f"{printer.max_extrude_only_mm:g} mm",
            )
            if self._occupied:
                self._refuse(*told)
            else:  # it loads filament
                self._beyond(*told, self._short_mm3 / allowed_mm3)
            self._short_mm3 = 0.0

    def _fresh_mm3(self, pushed_mm: float) -> float:
        """The plastic that leaves the nozzle by a push; filament pulled back comes back first."""
        back_mm = min(pushed_mm, self._head.pulled_mm)
        self._head.pulled_mm -= back_mm
        return (pushed_mm - back_mm) * self._area_mm2

    def _pull(self, pushed_mm: float) -> None:
        self._head.pulled_mm -= pushed_mm
        printer, limit_mm = self._setup.printer, self._setup.printer.max_extrude_only_mm
        if self._head.pulled_mm > limit_mm and not printer.one_nozzle:  # else it changes filaments
            told = ("pulls filament back", f"{self._head.pulled_mm:.1f} mm", f"{limit_mm:g} mm")
            # Unloading; that it prints on after that is refused.
            if self._beyond(*told, self._head.pulled_mm / limit_mm, math.inf):
                self._head.pulled_mm = 0.0  # said once
