"""A whole job from a solid: start script, skirt, layers, end script.

Every layer weighs what the solid's slab weighs: rings and fills carry the area that they stand
for, and a layer's flow is set so that its plastic is the exact volume of the slab. What is too
thin for a bead is listed with its volume. Supports are not made.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from gcode.crew import in_order, nothing
from gcode.errors import SliceError
from gcode.meshes import Cuts, closed_mesh
from gcode.moves import Comment, LayerChange, Role, Script, SetFan, SetHotend, Toolpath
from gcode.profiles import PrintSetup, expand_script
from gcode.progress import Progress, silent
from gcode.slicing import infill_kernels as kernels
from gcode.slicing.beads import Bead, loop_bead, spacing_of
from gcode.slicing.layer_plan import LayerPlan, PartLayers, Unfilled
from gcode.slicing.layers import LayerGrid, Slab, plan_slabs
from gcode.slicing.objects import Labels, boxes_apart_mm
from gcode.slicing.options import DEFAULT_PART, PartOptions
from gcode.slicing.order import nearest_first, seamed
from gcode.slicing.pen import MERGE_MM, Pen
from gcode.slicing.regions import flattened, union


@dataclass(frozen=True, slots=True)
class PartPlan:
    """A job, what it leaves out, and the heights of its layers."""

    toolpath: Toolpath
    unprintable: tuple[Unfilled, ...]
    grid: LayerGrid


def slice_part(
    solid: Any,
    setup: PrintSetup,
    *,
    options: PartOptions = DEFAULT_PART,
    workers: int = 1,
    progress: Progress = silent,
    meanwhile: Callable[[], object] = nothing,
) -> Toolpath:
    """Slice a solid (`Manifold` or `ClosedMesh`, build frame) into a whole job; see `plan_part`.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> solid = gcode.read_solid(Path("placed.stl"))
    >>> toolpath = gcode.slice_part(solid, gcode.load_setup())
    >>> 0.97 < toolpath.volume_mm3 / solid.volume() < 1.03
    True
    """
    plan = plan_part(
        solid, setup, options=options, workers=workers, progress=progress, meanwhile=meanwhile
    )
    return plan.toolpath


def plan_part(
    solid: Any,
    setup: PrintSetup,
    *,
    options: PartOptions = DEFAULT_PART,
    workers: int = 1,
    progress: Progress = silent,
    meanwhile: Callable[[], object] = nothing,
) -> PartPlan:
    """Slice a solid into a whole job, and say what could not be made.

    Parameters
    ----------
    solid
        A `manifold3d.Manifold` or a `gcode.meshes.ClosedMesh`, build frame, mm.
    options
        What profiles do not say.
    workers
        Processes that plan layers at once, forked from this one: 1 where it has other threads. What
        they plan does not depend on how many they are.
    meanwhile
        Done here while they are at work: what will be needed next can be loaded.

    Raises
    ------
    SliceError
        Where the solid is empty, below the bed or beyond the printer.
    """
    _refuse(solid, setup)
    solid = closed_mesh(solid)
    grid, bore_mm = LayerGrid.from_setup(setup), setup.printer.nozzle_diameter_mm
    slabs = plan_slabs(solid, grid, nozzle_diameter_mm=bore_mm, options=options)
    if not slabs:
        raise SliceError(
            f"The part is {np.ptp(solid.bounding_box()[2::3]):.3g} mm high, which makes no layer "
            f"of {grid.first_layer_height_mm:g} mm; is its file in another unit? Scale it."
        )
    cuts = Cuts.of(solid, np.array([s.middle_mm for s in slabs]))
    layers = PartLayers(cuts, slabs, setup, options)
    pen = Pen(setup, np.array(setup.printer.park_mm, float))
    lost: list[Unfilled] = []
    _begin(pen, setup, float(solid.bounding_box()[5]))
    seam_mm = np.array([-1e3, 1e3])
    labels = Labels(boxes_apart_mm(solid, setup.process.line_width_mm))
    plans = in_order(layers.plan, len(slabs), workers=workers, meanwhile=meanwhile)
    for slab, plan in zip(slabs, plans, strict=True):
        lost += plan.lost
        _change_layer(pen, slab, setup)
        if slab.index == 0:
            _skirt(pen, layers, slab)
        seam_mm = _emit(pen, plan, slab, seam_mm, layers, labels)
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
    printer = setup.printer
    x0, y0, x1, y1 = printer.bed_box_mm
    room = np.array([[x0, y0, 0.0], [x1, y1, printer.max_z_mm]])
    if (low < room[0] - 0.01).any() or (high > room[1] + 0.01).any():
        size = room[1] - room[0]
        corner = f" from X {x0:g} Y {y0:g} on" if x0 or y0 else ""
        raise SliceError(
            f"The part spans {_box_text((*low, *high))} mm, outside the printer's "
            f"{size[0]:g} × {size[1]:g} × {size[2]:g} mm{corner}; move, turn or scale it."
        )


def _box_text(box: tuple[float, ...]) -> str:
    return "({:.2f}, {:.2f}, {:.2f}) to ({:.2f}, {:.2f}, {:.2f})".format(*box)


def _merged(lost: list[Unfilled]) -> tuple[Unfilled, ...]:
    """The same place in consecutive layers is one thing; they come from the lowest layer up."""
    out: list[Unfilled] = []
    open_mm, going_on = -math.inf, list[int]()  # what ends at this layer's foot, or in it
    for thing in lost:
        b = thing.box_mm
        if b[2] > open_mm:
            open_mm = b[2]
            going_on = [k for k in going_on if out[k].box_mm[5] > open_mm - 1e-6]
        for k in reversed(going_on):
            a = out[k].box_mm
            touches = a[0] <= b[3] and b[0] <= a[3] and a[1] <= b[4] and b[1] <= a[4]
            if touches and abs(a[5] - b[2]) < 1e-6 and out[k].reason == thing.reason:
                low, high = map(min, a[:3], b[:3]), map(max, a[3:], b[3:])
                box: Any = (*low, *high)
                out[k] = Unfilled(out[k].volume_mm3 + thing.volume_mm3, box, thing.reason)
                break
        else:
            going_on.append(len(out))
            out.append(thing)
    return tuple(out)


def _begin(pen: Pen, setup: PrintSetup, top_mm: float) -> None:
    script = expand_script(setup.printer.start_gcode, setup, max_layer_z=top_mm)
    pen.add(Script(script, "start"))
    # the scripts' own last place is unknown: the first travel lifts before it goes across
    pen.position_mm = np.array([*setup.printer.prime_mm[:2], max(1.0, setup.printer.z_hop_mm)])


def _change_layer(pen: Pen, slab: Slab, setup: PrintSetup) -> None:
    pen.add(LayerChange(slab.index, slab.top_mm, slab.height_mm))
    if slab.index == 0:
        pen.add(SetFan(0.0))
    if slab.index == 1:
        pen.add(SetFan(setup.material.fan_ratio))
        if setup.material.hotend_c != setup.material.first_layer_hotend_c:
            pen.add(SetHotend(setup.material.hotend_c))


def _emit(
    pen: Pen,
    plan: LayerPlan,
    slab: Slab,
    seam_mm: Float[np.ndarray, " 2"],
    layers: PartLayers,
    labels: Labels,
) -> Float[np.ndarray, " 2"]:
    """Moves of one layer, nearest island next; returns where its last seam was."""
    left = list(plan.islands)
    seam = seam_mm
    while left:
        here = pen.position_mm[:2]
        island = left.pop(int(np.argmin([_box_distance(one.box_mm, here) for one in left])))
        labels.of_box(pen, island.box_mm)
        for group in island.groups:
            beads = [seamed(bead, seam, layers.options) for bead in group]
            if beads and beads[0].role is Role.EXTERNAL_PERIMETER:
                seam = beads[0].xy_mm[0]
            for bead in nearest_first(beads, pen.position_mm[:2]):
                _lay(pen, bead, slab, (island.outline_mm, island.starts), layers)
    labels.of_none(pen)
    return seam


def _box_distance(box: tuple[float, float, float, float], p: Float[np.ndarray, " 2"]) -> float:
    dx = max(box[0] - p[0], 0.0, p[0] - box[2])
    dy = max(box[1] - p[1], 0.0, p[1] - box[3])
    return math.hypot(dx, dy)


def _lay(pen: Pen, bead: Bead, slab: Slab, outline: Any, layers: PartLayers) -> None:
    """Go to a bead (combing inside the island, else retracted and lifted) and lay it."""
    setup, short_mm = layers.setup, layers.options.short_travel_mm
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
        far < short_mm or not kernels.crosses(*pen.position_mm[:2], *bead.xy_mm[0], *outline)
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


def _skirt(pen: Pen, layers: PartLayers, slab: Slab) -> None:
    """Loops around everything on the bed, to get the filament flowing."""
    setup, section = layers.setup, layers.section(0)
    process = setup.process
    if process.skirt_loops == 0 or slab.bottom_mm > 1e-3 or section.is_empty():
        return
    share_mm = spacing_of(process.line_width_mm, slab.height_mm)
    hull = union([section]).hull()
    bed = np.array(setup.printer.bed_box_mm)
    for i in range(process.skirt_loops):
        distance = process.skirt_distance_mm + (i + 0.5) * share_mm
        for contour in hull.offset(distance).simplify(0.05).to_polygons():
            loop = np.asarray(contour, float)
            if (loop < bed[:2] + 0.5).any() or (loop > bed[2:] - 0.5).any():
                continue
            bead = loop_bead(loop, share_mm, Role.SKIRT)
            _lay(pen, bead, slab, flattened(hull), layers)
