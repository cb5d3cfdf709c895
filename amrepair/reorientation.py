"""Reorientation: other ways to lay a broken part on the bed, and what the nozzle reaches in each.

What the nozzle cannot reach as the part stands is often open to it from another side. Nothing is
moved here: the deficit is sliced as if it were turned, onto what would then stand there. A person
lays the part so, scans it in the bed's frame, and repairs it like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
from shapely.geometry import MultiPoint, Point

from amrepair.errors import InputError
from amrepair.repair import RepairPlan, Site
from gcode.meshes import box_of_solid, middle_of_mass
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import slice_patch
from gcode.surfaces import HeightField

# About the bed's axes, right-handed, degrees; a turn about Z changes what the head's duct meets.
NAMED_TURNS: dict[str, tuple[float, float, float]] = {
    "x90": (90.0, 0.0, 0.0),
    "x180": (180.0, 0.0, 0.0),
    "x270": (270.0, 0.0, 0.0),
    "y90": (0.0, 90.0, 0.0),
    "y270": (0.0, 270.0, 0.0),
    "z90": (0.0, 0.0, 90.0),
    "z180": (0.0, 0.0, 180.0),
    "z270": (0.0, 0.0, 270.0),
}
FIELD_CELL_MM = 0.2
# Around the turned part: more than the head's block beside it.
BESIDE_TURNED_MM = 30.0
# The foot of what lies on the bed is looked at this far above it.
FOOT_MM = 0.1
# Nearer to the edge of its foot than this a nozzle's touch tips it over.
TIPPING_MM = 1.0


@dataclass(frozen=True, slots=True)
class Reorientation:
    """A way to lay the part on the bed, with what the nozzle would reach.

    Attributes
    ----------
    name
        A key of `NAMED_TURNS`.
    reachable_ratio
        Share of what is missing that beads would fill; 0 where the part does not fit the printer.
    stands
        Whether it lies there by itself: its centre of mass is over its foot.
    """

    name: str
    reachable_ratio: float
    stands: bool


def turns_named(words: Sequence[str]) -> tuple[str, ...]:
    """Names of turns; `any` is all of them.

    Raises
    ------
    InputError
        If there is no such turn.
    """
    names: list[str] = []
    for word in words:
        if word != "any" and word not in NAMED_TURNS:
            raise InputError(f"--turn is {word!r}; it is one of any, {', '.join(NAMED_TURNS)}")
        names += list(NAMED_TURNS) if word == "any" else [word]
    return tuple(dict.fromkeys(names))


def turns_of(
    plan: RepairPlan, site: Site, names: Sequence[str], *, progress: Progress = silent
) -> tuple[Reorientation, ...]:
    """`rank_turns` of what a plan says is missing."""
    if plan.deficit.missing.is_empty():
        return ()
    placed = plan.build_from_template
    expected: manifold3d.Manifold = site.template.solid()
    standing = placed.solid(expected) - plan.deficit.missing + plan.deficit.excess
    return rank_turns(
        plan.deficit.missing, standing, names, setup=site.setup, grid=site.grid, progress=progress
    )


def rank_turns(
    missing: manifold3d.Manifold,
    standing: manifold3d.Manifold,
    names: Sequence[str],
    *,
    setup: PrintSetup,
    grid: LayerGrid,
    progress: Progress = silent,
) -> tuple[Reorientation, ...]:
    """What each turn would let the nozzle reach, best first; ties as named.

    Parameters
    ----------
    missing, standing
        Solids, build frame, mm.
    names
        Keys of `NAMED_TURNS` that the user allows.
    """
    found = []
    for k, name in enumerate(names):
        found.append(_tried(name, missing, standing, setup, grid))
        progress("try turns", float(k + 1), float(len(names)))
    return tuple(sorted(found, key=lambda turn: -round(turn.reachable_ratio, 3)))


def _tried(
    name: str,
    missing: manifold3d.Manifold,
    standing: manifold3d.Manifold,
    setup: PrintSetup,
    grid: LayerGrid,
) -> Reorientation:
    """Slice the turned deficit onto the turned rest, in the middle of the bed."""
    turn = NAMED_TURNS[name]
    printer = setup.printer
    rest = standing.rotate(turn)
    low, high = box_of_solid(rest)
    size = high - low
    if (size[:2] > printer.bed_size_mm).any() or size[2] > printer.max_z_mm:
        return Reorientation(name, 0.0, stands=False)
    move = (*(printer.bed_middle_mm - 0.5 * (low + high)[:2]), -low[2])
    rest, wanted = rest.translate(move), missing.rotate(turn).translate(move)
    patch = slice_patch(
        wanted,
        setup,
        as_built=HeightField.from_manifold(rest, FIELD_CELL_MM, margin_mm=BESIDE_TURNED_MM),
        grid=grid,
        standalone=True,
    )
    return Reorientation(name, float(patch.reachable_mm3 / wanted.volume()), _stands(rest))


def _stands(solid: manifold3d.Manifold) -> bool:
    """Whether the centre of mass lies over the hull of the foot."""
    foot = solid.slice(FOOT_MM)
    if foot.is_empty():
        return False
    hull = MultiPoint(np.concatenate([np.asarray(c) for c in foot.to_polygons()])).convex_hull
    x_mm, y_mm, _ = middle_of_mass(solid)
    return bool(hull.buffer(-TIPPING_MM).contains(Point(float(x_mm), float(y_mm))))
