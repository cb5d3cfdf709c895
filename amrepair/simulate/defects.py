"""Kinds of defects of the simulated world: one table of what each is told and where it goes.

A defect is text (`void:diameter=8,layers=4`) until `place` finds room for it on a part; then it is
a `PlacedDefect` that the world can act out. A new kind is a row of `DEFECT_KINDS`. Nothing here
looks at scans.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

import manifold3d as m3
import numpy as np

from amrepair.arrays import Values
from amrepair.errors import InputError
from amrepair.simulate import placement
from amrepair.simulate.placed import Defect, Option, PlacedDefect, Printed
from gcode.reader.job import Beads

__all__ = [
    "DEFECT_KINDS",
    "Defect",
    "DefectKind",
    "Option",
    "PlacedDefect",
    "Printed",
    "parse_defect",
    "place",
]

_SMALLER = tuple(0.85**k for k in range(9))  # down to a quarter of the size asked for


@dataclass(frozen=True, slots=True)
class DefectKind:
    """A kind of defect.

    Attributes
    ----------
    options
        What it is told: the keys of its text.
    place
        Finds its place: the defect, what it goes on, a generator that chooses among the places,
        and a factor of at most 1 by which it is smaller than was asked for; None where there is
        no room for it.
    """

    options: dict[str, Option]
    place: Callable[[Defect, Printed, np.random.Generator, float], PlacedDefect | None]


# A void of default size is some 50 mm³; a chip or blob a few dozen.
DEFECT_KINDS: dict[str, DefectKind] = {
    "void": DefectKind(
        {
            "diameter": Option(10.0, 2.0, 40.0, "mm across"),
            "layers": Option(4.0, 1.0, 40.0, "layers not extruded"),
            "layer": Option(-1.0, -1.0, 100000.0, "last layer, counted from 0; -1: seeded"),
            "wall": Option(2.0, 0.0, 20.0, "mm to the part's wall"),
        },
        placement.void,
    ),
    "missing_beads": DefectKind(
        {
            "beads": Option(4.0, 1.0, 40.0, "neighbouring lines skipped in every layer"),
            "length": Option(12.0, 2.0, 100.0, "mm of each line skipped, at most"),
            "layers": Option(2.0, 1.0, 40.0, "layers affected"),
            "layer": Option(-1.0, -1.0, 100000.0, "last layer, counted from 0; -1: seeded"),
        },
        placement.missing_beads,
    ),
    "under_extrusion": DefectKind(
        {
            "flow": Option(0.5, 0.0, 0.95, "flow left, of 1"),
            "layers": Option(3.0, 1.0, 40.0, "layers affected"),
            "layer": Option(-1.0, -1.0, 100000.0, "last layer, counted from 0; -1: seeded"),
            "diameter": Option(0.0, 0.0, 200.0, "mm across; 0: the whole layer"),
        },
        placement.under_extrusion,
    ),
    "chip": DefectKind(
        {
            "size": Option(8.0, 1.5, 40.0, "mm across"),
            "depth": Option(1.4, 0.3, 20.0, "mm deep"),
            "roughness": Option(0.15, 0.0, 1.0, "mm, standard deviation of the fracture"),
        },
        placement.chip,
    ),
    "blob": DefectKind(
        {
            "size": Option(4.0, 1.0, 20.0, "mm across"),
            "height": Option(1.0, 0.2, 10.0, "mm above the top"),
        },
        placement.blob,
    ),
    "none": DefectKind({}, placement.nowhere),
}


def parse_defect(text: str) -> Defect:
    """Read `TYPE[:key=value,…]`.

    Raises
    ------
    InputError
        If type, key or value is not one that there is.
    """
    kind, _, tail = text.strip().partition(":")
    if kind not in DEFECT_KINDS:
        raise InputError(f"there is no defect type {kind!r}; there are {', '.join(DEFECT_KINDS)}")
    options = DEFECT_KINDS[kind].options
    values = {key: option.default for key, option in options.items()}
    for item in filter(None, (part.strip() for part in tail.split(","))):
        key, equals, word = (piece.strip() for piece in item.partition("="))
        if key not in options:
            known = ", ".join(options) or "none"
            raise InputError(f"the defect {kind} has no key {key!r}; it has {known}")
        option = options[key]
        try:
            value = float(word)
        except ValueError:
            value = np.nan
        if not equals or not option.low <= value <= option.high:
            raise InputError(
                f"the defect {kind} has {key}={word!r}, but it must be a number from "
                f"{option.low:g} to {option.high:g} ({option.meaning})"
            )
        values[key] = value
    return Defect(kind, MappingProxyType(values))


def place(
    defect: Defect,
    part: m3.Manifold,
    tops_mm: Values,
    rng: np.random.Generator,
    *,
    beads: Beads | None = None,
) -> PlacedDefect:
    """Find a place for a defect.

    Parameters
    ----------
    defect
        What is asked for.
    part
        The solid that is printed, build frame.
    tops_mm
        (n,) heights of the layers' tops, rising.
    rng
        Chooses among the places.
    beads
        The job's beads, for defects that skip some of them.

    Raises
    ------
    InputError
        If the part has no room for it, even at a quarter of its size.
    """
    printed = Printed(part, np.asarray(tops_mm), beads)
    for scale in _SMALLER:
        placed = DEFECT_KINDS[defect.kind].place(defect, printed, rng, scale)
        if placed is not None:
            return placed
    box = part.bounding_box()
    raise InputError(
        f"the part of {box[3] - box[0]:.1f}×{box[4] - box[1]:.1f}×{box[5] - box[2]:.1f} mm has no "
        f"room for the defect {defect}, even at {_SMALLER[-1]:.0%} of its size; "
        "ask for a smaller one"
    )
