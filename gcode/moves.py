"""The vocabulary of a print: what a nozzle does, before any dialect gives it words.

A `Toolpath` is a sequence of moves in the build frame (bed corner at the origin, Z up, mm). It
knows nothing of E values, feed rates or firmware; `writer` turns it into a `Program`, which is the
final text.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float


class Role(StrEnum):
    """What a bead is for, in the words that PrusaSlicer's and OrcaSlicer's viewers know."""

    SKIRT = "Skirt/Brim"
    EXTERNAL_PERIMETER = "External perimeter"
    PERIMETER = "Perimeter"
    SOLID_INFILL = "Solid infill"
    SPARSE_INFILL = "Internal infill"
    GAP_FILL = "Gap fill"
    BRIDGE = "Bridge infill"


@dataclass(frozen=True, slots=True)
class Extrude:
    """A chain of beads.

    Attributes
    ----------
    points_mm
        (n, 3) nozzle positions, build frame, n ≥ 2; the first is where the bead begins.
    section_mm2
        (n-1,) cross-section of the plastic along each segment; volume = section × length.
    width_mm, height_mm
        Nominal width and layer height, for viewers and for the reader of the report.
    """

    points_mm: Float[np.ndarray, "n 3"]
    section_mm2: Float[np.ndarray, " m"]
    speed_mm_s: float
    role: Role
    width_mm: float
    height_mm: float

    @property
    def volume_mm3(self) -> float:
        """Plastic in the chain, mm³."""
        lengths_mm = np.linalg.norm(np.diff(self.points_mm, axis=0), axis=1)
        return float(lengths_mm @ self.section_mm2)


@dataclass(frozen=True, slots=True)
class Travel:
    """A move without plastic through `points_mm` (n, 3), build frame, its start left out."""

    points_mm: Float[np.ndarray, "n 3"]
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class Retract:
    """Pull `length_mm` of filament back (negative pushes it out again)."""

    length_mm: float
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class Prime:
    """Push `length_mm` of filament standing still, beyond what was retracted."""

    length_mm: float
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class SetHotend:
    """Set the hotend's target; `wait` until it is reached."""

    temperature_c: float
    wait: bool = False


@dataclass(frozen=True, slots=True)
class SetBed:
    """Set the bed's target; `wait` until it is reached."""

    temperature_c: float
    wait: bool = False


@dataclass(frozen=True, slots=True)
class SetFan:
    """Set the part-cooling fan, 0..1."""

    ratio: float


@dataclass(frozen=True, slots=True)
class SetAcceleration:
    """Set the acceleration of printing moves."""

    acceleration_mm_s2: float


@dataclass(frozen=True, slots=True)
class LayerChange:
    """A new layer begins: its index, the height of its top and its thickness."""

    index: int
    z_mm: float
    height_mm: float


@dataclass(frozen=True, slots=True)
class FinishMoves:
    """Wait until every buffered move has been made (M400)."""


@dataclass(frozen=True, slots=True)
class Script:
    """Lines of a profile's own G-code (start, end), already filled in."""

    lines: tuple[str, ...]
    label: str = "custom"


@dataclass(frozen=True, slots=True)
class Comment:
    """A line of text for people and viewers."""

    text: str


Move = (
    Extrude
    | Travel
    | Retract
    | Prime
    | SetHotend
    | SetBed
    | SetFan
    | SetAcceleration
    | LayerChange
    | FinishMoves
    | Script
    | Comment
)


@dataclass(frozen=True, slots=True)
class Toolpath:
    """Moves in the order they are made, build frame."""

    moves: tuple[Move, ...]

    def __iter__(self) -> Iterator[Move]:
        return iter(self.moves)

    @property
    def extrusions(self) -> tuple[Extrude, ...]:
        """The chains of beads alone."""
        return tuple(move for move in self.moves if isinstance(move, Extrude))

    @property
    def volume_mm3(self) -> float:
        """Plastic laid down as beads, mm³ (priming and retraction left out)."""
        return sum(chain.volume_mm3 for chain in self.extrusions)


@dataclass(frozen=True, slots=True)
class Program:
    """Final G-code text in one dialect.

    Attributes
    ----------
    text
        Lines ended by a newline.
    dialect
        A name that `dialects` knows: marlin, prusa, klipper, reprap.

    Examples
    --------
    >>> import gcode
    >>> program = gcode.Program("G28\\nM84\\n", "marlin")
    >>> list(program.lines())
    ['G28', 'M84']
    """

    text: str
    dialect: str
    sha256: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sha256", hashlib.sha256(self.text.encode()).hexdigest())

    @property
    def line_count(self) -> int:
        """How many lines it has."""
        return self.text.count("\n")

    def lines(self) -> Iterator[str]:
        """Lines without their newline."""
        return iter(self.text.splitlines())

    def part(self, first: int, end: int) -> Program:
        """Lines [first, end), as a program of their own."""
        return Program("\n".join(self.text.split("\n", end)[first:end]) + "\n", self.dialect)


@dataclass(frozen=True, slots=True)
class ModalState:
    """The state of a machine between two lines of a program: position, temperatures and modes.

    Attributes
    ----------
    position_mm
        (x, y, z) of the nozzle in the build frame, regardless of any shift by G92.
    e_mm
        The logical extruder position, as `G92 E` would have to state it.
    absolute_xyz, absolute_e
        Whether coordinates, and E, are absolute (G90, M82) or relative (G91, M83).
    hotends_c, bed_c
        Target temperatures, °C, of each head's heater; several filaments to one nozzle share one.
    acceleration_mm_s2
        The acceleration of printing moves; None where the program never set it.
    units_mm
        False after G20 (inches).
    tool
        The head or filament that is chosen.
    pulled_mm
        How far its filament is pulled back, mm: the next push has to make this up first.
    """

    position_mm: tuple[float, float, float]
    e_mm: float = 0.0
    absolute_xyz: bool = True
    absolute_e: bool = True
    feed_mm_s: float = 0.0
    fan_ratio: float = 0.0
    hotends_c: tuple[float, ...] = (0.0,)
    bed_c: float = 0.0
    acceleration_mm_s2: float | None = None
    units_mm: bool = True
    tool: int = 0
    pulled_mm: float = 0.0

    @property
    def hotend_c(self) -> float:
        """The target temperature of the chosen head."""
        return self.hotends_c[self.heater]

    @property
    def heater(self) -> int:
        """The number of the chosen head's heater."""
        return self.tool if len(self.hotends_c) > 1 else 0

    def with_hotend(self, target_c: float) -> ModalState:
        """The same state with another target temperature of the chosen head."""
        told = list(self.hotends_c)
        told[self.heater] = target_c
        return replace(self, hotends_c=tuple(told))
