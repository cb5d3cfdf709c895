"""A whole job from a solid: start script, skirt, layers, end script.

Every layer weighs what the solid's slab weighs: rings and fills carry the area that they stand
for, and a layer's flow is set so that its plastic is the exact volume of the slab. What is too
thin for a bead is listed with its volume. Supports are not made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection

from gcode.errors import SliceError
from gcode.moves import Comment, LayerChange, Role, Script, SetFan, SetHotend, Toolpath
from gcode.profiles import PrintSetup, expand_script
from gcode.progress import Progress, silent
from gcode.slicing import infill_kernels as kernels
from gcode.slicing.beads import Bead, loop_bead, spacing_of
from gcode.slicing.infill import SOLID_ANGLES_RAD, ring_beads, solid_fill, sparse_fill
from gcode.slicing.layers import LayerGrid, Slab, plan_slabs
from gcode.slicing.medial import fill_thin
from gcode.slicing.order import nearest_first, seam_index
from gcode.slicing.pen import MERGE_MM, Pen
from gcode.slicing.regions import SIMPLIFY_MM, flattened, offset, peel, pieces, union

LEAST_NOZZLES = 0.5
MOST_NOZZLES = 2.0
INFILL_OVERLAP = 0.25  # of a spacing: PrusaSlicer's default overlap of infill and perimeters
FLOW_CORRECTION = (0.85, 1.6)  # slab volume over section × height, outside of which flow is wrong
SHORT_TRAVEL_MM = 1.5  # below this oozing costs less than a retraction
NOT_LISTED_MM3 = 1e-3


@dataclass(frozen=True, slots=True)
class Unprintable:
    """Something that no bead can make, by name: its volume, its box and why.

    `box_mm` is (x_min, y_min, z_min, x_max, y_max, z_max), build frame.
    """

    volume_mm3: float
    box_mm: tuple[float, float, float, float, float, float]
    reason: str


@dataclass(frozen=True, slots=True)
class PartPlan:
    """A job, what it leaves out, and the heights of its layers."""

    toolpath: Toolpath
    unprintable: tuple[Unprintable, ...]
    grid: LayerGrid


@dataclass
class _Layer:
    """Beads of a layer by island, in printing order of kinds."""

    islands: list[tuple[Any, list[list[Bead]]]] = field(default_factory=list)
    lost: list[Any] = field(default_factory=list)
    lost_mm2: float = 0.0


def slice_part(solid: Any, setup: PrintSetup, *, progress: Progress = silent) -> Toolpath:
    """Slice a solid (`manifold3d.Manifold`, build frame) into a whole job.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> solid = gcode.read_solid(Path("placed.stl"))
    >>> toolpath = gcode.slice_part(solid, gcode.load_setup())
    >>> 0.97 < toolpath.volume_mm3 / solid.volume() < 1.03
    True
    """
    return plan_part(solid, setup, progress=progress).toolpath


def plan_part(
    solid: Any,
    setup: PrintSetup,
    *,
    grid: LayerGrid | None = None,
    progress: Progress = silent,
) -> PartPlan:
    """Slice a solid into a whole job, and say what could not be made.

    Parameters
    ----------
    solid
        A `manifold3d.Manifold`, build frame, mm.
    grid
        Heights to lie on; the process profile's by default.

    Raises
    ------
    SliceError
        Where the solid is empty, below the bed or beyond the printer.
    """
    _refuse(solid, setup)
    nozzle_mm = setup.printer.nozzle_diameter_mm
    slabs = plan_slabs(solid, grid or LayerGrid.from_setup(setup), nozzle_diameter_mm=nozzle_mm)
    sections = [solid.slice(s.middle_mm).simplify(SIMPLIFY_MM) for s in slabs]
    solid_masks = _solid_masks(sections, setup)
    park = np.array(setup.printer.park_mm, float)
    pen = Pen(setup, park)
    lost: list[Unprintable] = []
    _begin(pen, setup, float(solid.bounding_box()[5]))
    seam_mm = np.array([-1e3, 1e3])
    for slab, section, mask in zip(slabs, sections, solid_masks, strict=True):
        layer = _plan_layer(section, mask, slab, setup)
        lost += _listed(layer, slab)
        _weigh(layer, slab, section)
        seam_mm = _emit(pen, layer, section, slab, seam_mm, setup)
        progress("slice", float(slab.index + 1), float(len(slabs)))
    pen.retract()
    pen.move_to(np.array([*pen.position_mm[:2], slabs[-1].top_mm + setup.printer.z_hop_mm + 1.0]))
    for thing in lost:
        pen.add(
            Comment(
                f"unprintable: {thing.volume_mm3:.3f} mm3 "
                f"at {_box_text(thing.box_mm)}: {thing.reason}"
            )
        )
    pen.add(
        Script(expand_script(setup.printer.end_gcode, setup, max_layer_z=slabs[-1].top_mm), "end")
    )
    tops = LayerGrid.from_tops(
        [s.top_mm for s in slabs], layer_height_mm=setup.process.layer_height_mm
    )
    return PartPlan(Toolpath(tuple(pen.moves)), _merged(lost), tops)


def _refuse(solid: Any, setup: PrintSetup) -> None:
    if solid.is_empty() or solid.volume() <= 0:
        raise SliceError("The solid is empty (0 mm³); nothing can be sliced.")
    low, high = np.array(solid.bounding_box()).reshape(2, 3)
    size = np.array([*setup.printer.bed_size_mm, setup.printer.max_z_mm])
    if (low < -0.01).any() or (high > size + 0.01).any():
        raise SliceError(
            f"The part spans {_box_text((*low, *high))} mm, outside the printer's "
            f"{size[0]:g} × {size[1]:g} × {size[2]:g} mm; move, turn or scale it."
        )


def _box_text(box: tuple[float, ...]) -> str:
    return "({:.2f}, {:.2f}, {:.2f}) to ({:.2f}, {:.2f}, {:.2f})".format(*box)


def _solid_masks(sections: list[Any], setup: PrintSetup) -> list[Any | None]:
    """By layer, what lies within the shells' reach of air above or below; None = everything."""
    process = setup.process
    if process.infill_ratio >= 0.999:
        return [None] * len(sections)
    n = len(sections)
    empty = CrossSection()
    out: list[Any | None] = []
    for i in range(n):
        buried = sections[i]
        for j in range(i - process.bottom_layers, i + process.top_layers + 1):
            if j != i:
                buried = buried ^ (sections[j] if 0 <= j < n else empty)
            if buried.is_empty():
                break
        # solid areas reach a little under their neighbours, so that they hold on
        out.append(offset(sections[i] - buried, process.line_width_mm))
    return out


def _plan_layer(section: Any, mask: Any | None, slab: Slab, setup: PrintSetup) -> _Layer:
    """Rings, thin beads and fills of one section."""
    process, nozzle_mm = setup.process, setup.printer.nozzle_diameter_mm
    share_mm = spacing_of(max(process.line_width_mm, 1.05 * slab.height_mm), slab.height_mm)
    least_mm, most_mm = LEAST_NOZZLES * nozzle_mm, MOST_NOZZLES * nozzle_mm
    layer = _Layer()
    for island in pieces(section):
        peeled = peel(island, share_mm, process.perimeters)
        groups: list[list[Bead]] = []
        for i, ring in enumerate(peeled.rings):
            role = Role.PERIMETER if i else Role.EXTERNAL_PERIMETER
            groups.append(ring_beads(ring.centre, ring.area_mm2, share_mm, role))
        groups.reverse()  # the outer wall last of the rings, against its support
        thin_beads: list[Bead] = []
        for part in peeled.thin:
            thin = fill_thin(part, least_mm=least_mm, most_mm=most_mm)
            thin_beads += thin.beads
            layer.lost_mm2 += thin.lost_mm2
            if not thin.beads:
                layer.lost.append(part)
        top = slab.index % 2
        hard = peeled.core if mask is None else peeled.core ^ mask
        fills, left = solid_fill(
            hard,
            spacing_mm=share_mm,
            angle_rad=SOLID_ANGLES_RAD[top],
            role=Role.SOLID_INFILL,
            least_mm=least_mm,
            most_mm=most_mm,
            pattern="concentric" if process.infill_pattern == "concentric" else "rectilinear",
            overlap_ratio=INFILL_OVERLAP,
        )
        layer.lost_mm2 += left
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


def _weigh(layer: _Layer, slab: Slab, section: Any) -> None:
    """Scale flow so that full areas carry the slab's exact volume.

    Lost slivers are not put elsewhere: where they are more than rounding, they are listed.
    """
    area_mm2 = section.area()
    if area_mm2 <= 0:
        return
    beads = [b for _, groups in layer.islands for g in groups for b in g]
    dense = not any(b.role is Role.SPARSE_INFILL for b in beads)
    listed_mm2 = sum(part.area() for part in layer.lost)
    factor = slab.volume_mm3 / (area_mm2 * slab.height_mm)
    if dense:
        laid_mm2 = sum(b.area_mm2 for b in beads)
        if laid_mm2 > 0:
            factor *= max(area_mm2 - listed_mm2, 0.0) / laid_mm2
    factor = min(max(factor, FLOW_CORRECTION[0]), FLOW_CORRECTION[1])
    for _, groups in layer.islands:
        for group in groups:
            group[:] = [bead.scaled(factor) for bead in group]


def _listed(layer: _Layer, slab: Slab) -> list[Unprintable]:
    out = []
    for part in layer.lost:
        volume = part.area() * slab.height_mm
        x0, y0, x1, y1 = part.bounds()
        box = (x0, y0, slab.bottom_mm, x1, y1, slab.top_mm)
        if volume > NOT_LISTED_MM3:
            out.append(Unprintable(volume, box, "thinner than half a nozzle"))
    return out


def _merged(lost: list[Unprintable]) -> tuple[Unprintable, ...]:
    """The same place in consecutive layers is one thing."""
    out: list[Unprintable] = []
    for thing in lost:
        for k in range(len(out) - 1, -1, -1):
            a, b = out[k].box_mm, thing.box_mm
            touches = a[0] <= b[3] and b[0] <= a[3] and a[1] <= b[4] and b[1] <= a[4]
            if touches and abs(a[5] - b[2]) < 1e-6 and out[k].reason == thing.reason:
                low, high = np.minimum(a[:3], b[:3]), np.maximum(a[3:], b[3:])
                box = tuple(float(v) for v in (*low, *high))
                out[k] = Unprintable(out[k].volume_mm3 + thing.volume_mm3, box, thing.reason)  # type: ignore[arg-type]
                break
        else:
            out.append(thing)
    return tuple(out)


def _begin(pen: Pen, setup: PrintSetup, top_mm: float) -> None:
    script = expand_script(setup.printer.start_gcode, setup, max_layer_z=top_mm)
    pen.add(Script(script, "start"))
    # the scripts' own last place is unknown: the first travel lifts before it goes across
    pen.position_mm = np.array([*setup.printer.prime_mm[:2], max(1.0, setup.printer.z_hop_mm)])


def _emit(
    pen: Pen,
    layer: _Layer,
    section: Any,
    slab: Slab,
    seam_mm: Float[np.ndarray, " 2"],
    setup: PrintSetup,
) -> Float[np.ndarray, " 2"]:
    """Moves of one layer; returns where its first seam was."""
    pen.add(LayerChange(slab.index, slab.top_mm, slab.height_mm))
    if slab.index == 1:
        pen.add(SetFan(setup.material.fan_ratio))
        if setup.material.hotend_c != setup.material.first_layer_hotend_c:
            pen.add(SetHotend(setup.material.hotend_c))
    if slab.index == 0:
        pen.add(SetFan(0.0))
        _skirt(pen, section, slab, setup)
    left = list(layer.islands)
    seam = seam_mm
    while left:
        here = pen.position_mm[:2]
        k = int(np.argmin([_box_distance(island.bounds(), here) for island, _ in left]))
        island, groups = left.pop(k)
        outline = flattened(island)
        for group in groups:
            beads = [_seamed(bead, seam) for bead in group]
            if beads and beads[0].role is Role.EXTERNAL_PERIMETER:
                seam = beads[0].xy_mm[0]
            for bead in nearest_first(beads, pen.position_mm[:2]):
                _lay(pen, bead, slab, outline, setup)
    return seam


def _seamed(bead: Bead, seam_mm: Float[np.ndarray, " 2"]) -> Bead:
    return bead.started_at(seam_index(bead.xy_mm[:-1], seam_mm)) if bead.closed else bead


def _box_distance(box: tuple[float, float, float, float], p: Float[np.ndarray, " 2"]) -> float:
    dx = max(box[0] - p[0], 0.0, p[0] - box[2])
    dy = max(box[1] - p[1], 0.0, p[1] - box[3])
    return math.hypot(dx, dy)


def _lay(pen: Pen, bead: Bead, slab: Slab, outline: Any, setup: PrintSetup) -> None:
    """Go to a bead (combing inside the island, else retracted and lifted) and lay it."""
    start = np.array([*bead.xy_mm[0], slab.top_mm])
    gap = start - pen.position_mm
    level = abs(gap[2]) < 1e-6
    far = float(np.hypot(gap[0], gap[1]))
    if level and far < MERGE_MM:
        bead = Bead(
            np.concatenate([pen.position_mm[None, :2], bead.xy_mm[1:]]),
            bead.share_mm,
            bead.role,
            bead.closed,
        )
    elif level and (
        far < SHORT_TRAVEL_MM or not kernels.crosses(*pen.position_mm[:2], *bead.xy_mm[0], *outline)
    ):
        pen.move_to(start)
    else:
        over = max(slab.top_mm, float(pen.position_mm[2])) + setup.printer.z_hop_mm
        pen.hop_to(start, over_mm=over)
    pen.lay(bead, z_mm=slab.top_mm, height_mm=slab.height_mm, speed_mm_s=_speed(bead, slab, setup))


def _speed(bead: Bead, slab: Slab, setup: PrintSetup) -> float:
    process = setup.process
    if slab.index == 0:
        return process.first_layer_speed_mm_s
    return {
        Role.EXTERNAL_PERIMETER: process.external_perimeter_speed_mm_s,
        Role.GAP_FILL: process.external_perimeter_speed_mm_s,
        Role.PERIMETER: process.perimeter_speed_mm_s,
        Role.SPARSE_INFILL: process.infill_speed_mm_s,
    }.get(bead.role, process.solid_infill_speed_mm_s)


def _skirt(pen: Pen, section: Any, slab: Slab, setup: PrintSetup) -> None:
    """Loops around everything on the bed, to get the filament flowing."""
    process = setup.process
    if process.skirt_loops == 0 or slab.bottom_mm > 1e-3 or section.is_empty():
        return
    share_mm = spacing_of(process.line_width_mm, slab.height_mm)
    hull = union([section]).hull()
    size = setup.printer.bed_size_mm
    for i in range(process.skirt_loops):
        distance = process.skirt_distance_mm + (i + 0.5) * share_mm
        for contour in hull.offset(distance).simplify(0.05).to_polygons():
            loop = np.asarray(contour, float)
            if (loop < 0.5).any() or (loop > np.array(size) - 0.5).any():
                continue
            bead = loop_bead(loop, share_mm, Role.SKIRT)
            _lay(pen, bead, slab, flattened(hull), setup)
