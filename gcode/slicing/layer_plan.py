"""One layer of a whole job: from its section to weighed beads, whatever is laid before and after.

Every layer weighs what the solid's slab weighs: rings and fills carry the area that they stand
for, and a layer's flow is set so that its plastic is the exact volume of the slab.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from manifold3d import CrossSection

from gcode.meshes import Cuts
from gcode.moves import Role
from gcode.profiles import PrintSetup
from gcode.slicing.beads import Bead, spacing_of
from gcode.slicing.infill import SOLID_ANGLES_RAD, ring_beads, solid_fill, sparse_fill
from gcode.slicing.layers import Slab
from gcode.slicing.medial import fill_thin
from gcode.slicing.options import PartOptions
from gcode.slicing.regions import SIMPLIFY_MM, flattened, offset, peel, pieces


@dataclass(frozen=True, slots=True)
class Unfilled:
    """Something that no bead fills: its volume, its box and why.

    `box_mm` is (x_min, y_min, z_min, x_max, y_max, z_max), build frame.
    """

    volume_mm3: float
    box_mm: tuple[float, float, float, float, float, float]
    reason: str


@dataclass(frozen=True, slots=True)
class Island:
    """A connected part of a layer.

    Attributes
    ----------
    box_mm
        (x_min, y_min, x_max, y_max).
    outline_mm, starts
        (n, 2) points of its contours, and (m + 1,) where each starts, with the end.
    groups
        Beads in printing order of kinds.
    """

    box_mm: tuple[float, float, float, float]
    outline_mm: Float[np.ndarray, "n 2"]
    starts: Int[np.ndarray, " m1"]
    groups: list[list[Bead]]


@dataclass(frozen=True, slots=True)
class LayerPlan:
    """What a layer is made of, and what of it no bead can make."""

    islands: tuple[Island, ...]
    lost: tuple[Unfilled, ...]


@dataclass(frozen=True, slots=True)
class PartLayers:
    """All layers of a part, each planned when it is asked for, by itself."""

    cuts: Cuts
    slabs: tuple[Slab, ...]
    setup: PrintSetup
    options: PartOptions
    _sections: Any = field(init=False)

    def __post_init__(self) -> None:
        process = self.setup.process
        reach = process.bottom_layers + process.top_layers
        cuts = self.cuts  # not `self`: what refers to itself is kept until somebody sweeps up
        kept = lru_cache(maxsize=reach + 2)(lambda k: cuts.at(k).simplify(SIMPLIFY_MM))
        object.__setattr__(self, "_sections", kept)

    def section(self, index: int) -> Any:
        """What is inside in mid-layer (`CrossSection`)."""
        return self._sections(index)

    def plan(self, index: int) -> LayerPlan:
        """Beads of one layer, in the same place and of the same weight whoever asks when."""
        section, slab = self.section(index), self.slabs[index]
        layer = _planned(section, self._solid_mask(index), slab, self.setup, self.options)
        factor = _flow(layer, slab, section, self.options)
        islands = tuple(
            Island(
                part.bounds(),
                *flattened(part),
                [[bead.scaled(factor) for bead in group] for group in groups],
            )
            for part, groups in layer.islands
        )
        return LayerPlan(islands, tuple(_listed(layer, slab, self.options)))

    def _solid_mask(self, index: int) -> Any | None:
        """What lies within the shells' reach of air above or below; None = everything."""
        process = self.setup.process
        if process.infill_ratio >= self.options.dense_ratio:
            return None
        section = buried = self.section(index)
        for j in range(index - process.bottom_layers, index + process.top_layers + 1):
            if j != index:
                buried = buried ^ (self.section(j) if 0 <= j < len(self.slabs) else CrossSection())
            if buried.is_empty():
                break
        # solid areas reach a little under their neighbours, so that they hold on
        return offset(section - buried, process.line_width_mm)


@dataclass
class _Layer:
    """Beads of a layer by island, in printing order of kinds, and what is lost."""

    islands: list[tuple[Any, list[list[Bead]]]] = field(default_factory=list)
    lost: list[Any] = field(default_factory=list)


def _planned(
    section: Any, mask: Any | None, slab: Slab, setup: PrintSetup, options: PartOptions
) -> _Layer:
    """Rings, thin beads and fills of one section."""
    process, bore_mm = setup.process, setup.printer.nozzle_diameter_mm
    share_mm = spacing_of(max(process.line_width_mm, 1.05 * slab.height_mm), slab.height_mm)
    layer = _Layer()
    for island in pieces(section):
        peeled = peel(island, share_mm, process.perimeters)
        groups: list[list[Bead]] = []
        for i, ring in enumerate(peeled.rings):
            role = Role.PERIMETER if i else Role.EXTERNAL_PERIMETER
            groups.append(ring_beads(ring.centre, ring.area_mm2, share_mm, role, options.fill))
        groups.reverse()  # the outer wall last of the rings, against its support
        thin_beads: list[Bead] = []
        for part in peeled.thin:
            thin = fill_thin(part, bore_mm, options.fill)
            thin_beads += thin.beads
            if not thin.beads:
                layer.lost.append(part)
        top = slab.index % 2
        hard = peeled.core if mask is None else peeled.core ^ mask
        fills, _ = solid_fill(
            hard,
            spacing_mm=share_mm,
            angle_rad=SOLID_ANGLES_RAD[top],
            role=Role.SOLID_INFILL,
            bore_mm=bore_mm,
            options=options.fill,
            pattern="concentric" if process.infill_pattern == "concentric" else "rectilinear",
            overlap_ratio=options.overlap_ratio,
        )
        if mask is not None:
            fills += sparse_fill(
                peeled.core - mask,
                spacing_mm=share_mm,
                ratio=process.infill_ratio,
                layer=slab.index,
                pattern=process.infill_pattern,
            )
        layer.islands.append((island, [*groups, thin_beads, fills]))
    return layer


def _flow(layer: _Layer, slab: Slab, section: Any, options: PartOptions) -> float:
    """By what flow is scaled so that full areas carry the slab's exact volume.

    Lost slivers are not put elsewhere: where they are more than rounding, they are listed.
    """
    area_mm2 = section.area()
    if area_mm2 <= 0:
        return 1.0
    beads = [b for _, groups in layer.islands for g in groups for b in g]
    dense = not any(b.role is Role.SPARSE_INFILL for b in beads)
    listed_mm2 = sum(part.area() for part in layer.lost)
    factor = slab.volume_mm3 / (area_mm2 * slab.height_mm)
    if dense:
        laid_mm2 = sum(b.area_mm2 for b in beads)
        if laid_mm2 > 0:
            factor *= max(area_mm2 - listed_mm2, 0.0) / laid_mm2
    least, most = options.flow_correction
    return float(min(max(factor, least), most))


def _listed(layer: _Layer, slab: Slab, options: PartOptions) -> list[Unfilled]:
    out = []
    for part in layer.lost:
        volume = part.area() * slab.height_mm
        x0, y0, x1, y1 = part.bounds()
        box = (x0, y0, slab.bottom_mm, x1, y1, slab.top_mm)
        if volume > options.least_left_mm3:
            out.append(Unfilled(volume, box, "thinner than half a nozzle"))
    return out
