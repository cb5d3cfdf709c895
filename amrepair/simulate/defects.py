"""Defects: what can be asked for, how it is written, and what it becomes once it has a place.

A defect is text (`void:diameter=8,layers=4`) until `placement.place` finds room for it on a part;
then it is a `PlacedDefect` that the world can act out. Nothing here looks at scans.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError


class DefectKind(StrEnum):
    """What can go wrong with a print."""

    VOID = "void"
    MISSING_BEADS = "missing_beads"
    UNDER_EXTRUSION = "under_extrusion"
    CHIP = "chip"
    BLOB = "blob"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Option:
    """One key of a defect: its default, range and meaning."""

    default: float
    low: float
    high: float
    meaning: str


# A void's default, 9 mm × 4 layers of 0.2 mm, is 51 mm³; a chip's or blob's is a few dozen.
OPTIONS: dict[DefectKind, dict[str, Option]] = {
    DefectKind.VOID: {
        "diameter": Option(10.0, 2.0, 40.0, "mm across"),
        "layers": Option(4.0, 1.0, 40.0, "layers not extruded"),
        "layer": Option(-1.0, -1.0, 100000.0, "last layer, counted from 0; -1: seeded"),
        "wall": Option(2.0, 0.0, 20.0, "mm to the part's wall"),
    },
    DefectKind.MISSING_BEADS: {
        "beads": Option(4.0, 1.0, 40.0, "neighbouring lines skipped in every layer"),
        "length": Option(12.0, 2.0, 100.0, "mm of each line skipped, at most"),
        "layers": Option(2.0, 1.0, 40.0, "layers affected"),
        "layer": Option(-1.0, -1.0, 100000.0, "last layer, counted from 0; -1: seeded"),
    },
    DefectKind.UNDER_EXTRUSION: {
        "flow": Option(0.5, 0.0, 0.95, "flow left, of 1"),
        "layers": Option(3.0, 1.0, 40.0, "layers affected"),
        "layer": Option(-1.0, -1.0, 100000.0, "last layer, counted from 0; -1: seeded"),
        "diameter": Option(0.0, 0.0, 200.0, "mm across; 0: the whole layer"),
    },
    DefectKind.CHIP: {
        "size": Option(8.0, 1.5, 40.0, "mm across"),
        "depth": Option(1.4, 0.3, 20.0, "mm deep"),
        "roughness": Option(0.15, 0.0, 1.0, "mm, standard deviation of the fracture"),
    },
    DefectKind.BLOB: {
        "size": Option(4.0, 1.0, 20.0, "mm across"),
        "height": Option(1.0, 0.2, 10.0, "mm above the top"),
    },
    DefectKind.NONE: {},
}


@dataclass(frozen=True, slots=True)
class Defect:
    """A defect as asked for, without a place.

    Attributes
    ----------
    kind
        What goes wrong.
    values
        Every option of that kind, defaults filled in.
    """

    kind: DefectKind
    values: MappingProxyType[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def __str__(self) -> str:
        options = ",".join(f"{key}={value:g}" for key, value in self.values.items())
        return f"{self.kind}:{options}" if options else str(self.kind)


def parse_defect(text: str) -> Defect:
    """Read `TYPE[:key=value,…]`.

    Raises
    ------
    InputError
        If type, key or value is not one that there is.
    """
    name, _, tail = text.strip().partition(":")
    try:
        kind = DefectKind(name)
    except ValueError as error:
        raise InputError(
            f"there is no defect type {name!r}; there are {', '.join(DefectKind)}"
        ) from error
    options = OPTIONS[kind]
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


@dataclass(frozen=True, slots=True)
class PlacedDefect:
    """A defect with a place on a part.

    Attributes
    ----------
    kind
        What goes wrong.
    layers
        Indices of the layers whose flow it changes, rising; none for a defect of the whole part.
    flow_regions
        (n, 9) ellipses where the flow changes: x, y, cos, sin, half-axes, z above, z up to,
        factor; build frame, mm. The world reads them.
    removed, added
        Solids of the build frame that break off, or are added to, the finished part.
    box_mm
        (2, 3) box around it, build frame.
    """

    kind: DefectKind
    layers: tuple[int, ...]
    flow_regions: Float[np.ndarray, "n 9"]
    removed: manifold3d.Manifold | None
    added: manifold3d.Manifold | None
    box_mm: Float[np.ndarray, "2 3"]

    @property
    def last_layer(self) -> int | None:
        """The layer after which it is scanned and repaired; None: once the part is finished."""
        return self.layers[-1] if self.layers else None
