"""The planner queue of the emulated printer: look-ahead, trapezoids, and what was executed.

The algorithm is Marlin's `planner.cpp` in its essence: junction speed from classic jerk, a reverse
pass over the queue when a block comes in, a forward limit when one begins. A block is executed,
and recorded as motion, when the printer's clock passes its end.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from dataclasses import dataclass

BLOCK_BUFFER_SIZE = 16
"""Marlin's default."""

LEAST_MM_S = 0.05
"""MINIMUM_PLANNER_SPEED of Marlin."""

Xyz = tuple[float, float, float]


@dataclass(slots=True)
class PlannedBlock:
    """A planned move; `entry` is the speed it will begin with, mm/s."""

    start: Xyz
    end: Xyz
    filament_mm: float
    length: float
    speed: float
    acceleration: float
    entry_max: float
    entry: float
    commanded: float

    def reachable(self, other: float) -> float:
        """Speed at one end, if it is `other` at the far end and all of it accelerates."""
        return math.sqrt(other * other + 2 * self.acceleration * self.length)

    def seconds(self, leave: float) -> float:
        """Time from `entry` to `leave`."""
        return _trapezoid_s(self.length, self.speed, self.acceleration, self.entry, leave)


class Planner:
    """A queue of moves, executed as the clock goes on.

    Attributes
    ----------
    executed
        Flat records of nine numbers: start xyz, end xyz, filament, commanded speed, end time.
    """

    def __init__(
        self,
        *,
        max_speed_mm_s: tuple[float, float, float, float],
        max_acceleration_mm_s2: tuple[float, float, float, float],
        max_jerk_mm_s: tuple[float, float, float, float],
    ) -> None:
        self.max_speed = list(max_speed_mm_s)
        self.max_acceleration = list(max_acceleration_mm_s2)
        self.max_jerk = list(max_jerk_mm_s)
        self.print_acceleration = 1250.0
        self.travel_acceleration = 1250.0
        self.retract_acceleration = 1250.0
        self.executed = array("d")
        self.blocks: deque[PlannedBlock] = deque()
        self.head_end_s = math.inf  # end of the block being executed, inf if none is
        self._unit = (0.0, 0.0, 0.0, 0.0)
        self._last_speed = 0.0
        self.moved_s = 0.0  # when the last move ended
        self._head_s = 0.0

    @property
    def full(self) -> bool:
        """Whether a further move must wait."""
        return len(self.blocks) >= BLOCK_BUFFER_SIZE

    def push(self, start: Xyz, end: Xyz, filament_mm: float, feed_mm_s: float) -> None:
        """Append a move; the caller has made sure of room."""
        dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length > 1e-9:
            acceleration = self.print_acceleration if filament_mm else self.travel_acceleration
        else:
            length = abs(filament_mm)
            if length < 1e-9:
                return
            acceleration = self.retract_acceleration
        unit = (dx / length, dy / length, dz / length, filament_mm / length)
        speed, jerk, previous = max(feed_mm_s, LEAST_MM_S), 1e9, self._unit
        for axis in range(4):
            share = abs(unit[axis])
            if share > 1e-9:
                speed = min(speed, self.max_speed[axis] / share)
                acceleration = min(acceleration, self.max_acceleration[axis] / share)
            change = abs(unit[axis] - previous[axis])
            if change > 1e-6:
                jerk = min(jerk, self.max_jerk[axis] / change)
        blocks = self.blocks
        entry_max = min(jerk, speed, self._last_speed) if blocks else 0.0
        blocks.append(
            PlannedBlock(
                start, end, filament_mm, length, speed, acceleration, entry_max, 0.0, feed_mm_s
            )
        )
        self._unit, self._last_speed = unit, speed
        self._plan_backwards()

    def _plan_backwards(self) -> None:
        exit_speed = 0.0
        blocks = self.blocks
        busy = 1 if self.head_end_s < math.inf else 0
        for index in range(len(blocks) - 1, busy - 1, -1):
            block = blocks[index]
            entry = min(block.entry_max, block.reachable(exit_speed))
            if entry == block.entry and entry > 0.0:
                break
            block.entry = exit_speed = entry

    def start_head(self, now_s: float) -> None:
        """Begin the first block, if none is under way: its trapezoid is fixed from here on."""
        if self.head_end_s < math.inf or not self.blocks:
            return
        block = self.blocks[0]
        leave = 0.0
        if len(self.blocks) > 1:
            following = self.blocks[1]
            leave = following.entry = min(following.entry, block.reachable(block.entry))
        self._head_s = block.seconds(leave)
        self.head_end_s = now_s + self._head_s

    def advance(self, now_s: float, clock_s: float) -> None:
        """Execute what ends by `now_s`, the clock having stood at `clock_s`."""
        self.start_head(clock_s)
        while self.head_end_s <= now_s:
            self._finish_head()

    def _finish_head(self) -> None:
        end_s = self.head_end_s
        block = self.blocks.popleft()
        self.executed.extend((*block.start, *block.end, block.filament_mm, block.commanded, end_s))
        self.moved_s = end_s
        self.head_end_s = math.inf
        self.start_head(end_s)

    def drained_s(self, clock_s: float) -> float:
        """When the whole queue will be executed, if nothing is added to it."""
        self.start_head(clock_s)
        end_s = self.head_end_s if self.blocks else clock_s
        blocks = list(self.blocks)
        entry = blocks[1].entry if len(blocks) > 1 else 0.0
        for index in range(1, len(blocks)):
            block = blocks[index]
            wanted = blocks[index + 1].entry if index + 1 < len(blocks) else 0.0
            leave = min(wanted, block.reachable(entry))
            end_s += _trapezoid_s(block.length, block.speed, block.acceleration, entry, leave)
            entry = leave
        return end_s

    def stop(self, now_s: float, clock_s: float) -> Xyz | None:
        """Drop the queue; the block under way ends where it is. Returns that place, if any."""
        self.advance(now_s, clock_s)
        place: Xyz | None = None
        if self.blocks:
            block = self.blocks[0]
            left = min(1.0, max(0.0, (self.head_end_s - now_s) / max(self._head_s, 1e-9)))
            ratio = 1.0 - left
            x, y, z = (a + ratio * (b - a) for a, b in zip(block.start, block.end, strict=True))
            place = (x, y, z)
            if ratio > 0:
                self.executed.extend(
                    (*block.start, *place, ratio * block.filament_mm, block.commanded, now_s)
                )
        self.blocks.clear()
        self.head_end_s = math.inf
        return place


def _trapezoid_s(
    length: float, cruise: float, acceleration: float, entry: float, leave: float
) -> float:
    """Time over `length` from speed `entry` to `leave`, at most `cruise`, mm and s."""
    ramps = (2 * cruise * cruise - entry * entry - leave * leave) / (2 * acceleration)
    if ramps <= length:
        return (2 * cruise - entry - leave) / acceleration + (length - ramps) / cruise
    peak = math.sqrt(max(acceleration * length + (entry * entry + leave * leave) / 2, 0.0))
    return (2 * peak - entry - leave) / acceleration
