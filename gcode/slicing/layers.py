"""The heights of layers: the job's own grid, and how a part's horizontal faces bend it.

Sections lie in mid-layer; what a layer should weigh is the exact volume of its slab.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from gcode.errors import SliceError
from gcode.meshes import mesh_of
from gcode.meshes_kernels import level_faces
from gcode.profiles import PrintSetup
from gcode.slicing import volume_kernels as kernels
from gcode.slicing.options import DEFAULT_PART, PartOptions

MAX_LAYERS = 20_000
_SAME_LAYER_MM = 1e-4


@dataclass(frozen=True, slots=True)
class LayerGrid:
    """Tops of a job's layers: explicit ones first, then a regular continuation.

    Attributes
    ----------
    tops_mm
        Ascending tops as a job's G-code has them; empty for a regular grid.
    """

    first_layer_height_mm: float
    layer_height_mm: float
    tops_mm: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not (self.first_layer_height_mm > 0 and self.layer_height_mm > 0):
            raise SliceError(
                f"Layer heights must be above 0 mm, not {self.first_layer_height_mm} "
                f"and {self.layer_height_mm}."
            )
        if any(b <= a for a, b in zip((0.0, *self.tops_mm), self.tops_mm)):  # noqa: B905 - pairs
            raise SliceError("The tops of layers must ascend from above 0 mm.")

    @classmethod
    def from_setup(cls, setup: PrintSetup) -> LayerGrid:
        """The regular grid of a process profile."""
        return cls(setup.process.first_layer_height_mm, setup.process.layer_height_mm)

    @classmethod
    def from_tops(cls, tops_mm: Sequence[float], *, layer_height_mm: float) -> LayerGrid:
        """The grid of a job that is known by its tops; goes on regularly above them."""
        tops = tuple(float(z) for z in tops_mm)
        return cls(tops[0] if tops else layer_height_mm, layer_height_mm, tops)

    def tops_to(self, z_mm: float) -> Float[np.ndarray, " n"]:
        """Tops from the bed up, the last one at or above `z_mm`."""
        explicit = np.array(self.tops_mm)
        last_mm = float(explicit[-1]) if len(explicit) else self.first_layer_height_mm
        count = max(0, math.ceil((z_mm - last_mm - _SAME_LAYER_MM) / self.layer_height_mm))
        if count > MAX_LAYERS:
            raise SliceError(
                f"{count} layers of {self.layer_height_mm:g} mm up to {z_mm:g} mm are over the "
                f"limit of {MAX_LAYERS}; use thicker layers."
            )
        start = explicit if len(explicit) else np.array([last_mm])
        tops = np.concatenate([start, last_mm + self.layer_height_mm * np.arange(1, count + 1)])
        # Heights are rounded to decimals, so that 0.2 × 3 reads 0.6.
        return np.round(tops[: int(np.searchsorted(tops, z_mm - _SAME_LAYER_MM)) + 1], 9)


@dataclass(frozen=True, slots=True)
class Slab:
    """One layer: from `bottom_mm` to `top_mm`, and the part's exact volume between them."""

    index: int
    bottom_mm: float
    top_mm: float
    volume_mm3: float

    @property
    def height_mm(self) -> float:
        """Thickness."""
        return self.top_mm - self.bottom_mm

    @property
    def middle_mm(self) -> float:
        """Where the section lies."""
        return 0.5 * (self.bottom_mm + self.top_mm)


def slab_volumes(solid: Any, cuts_mm: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Exact volumes of a manifold between consecutive heights (m = n − 1).

    By Gauss' theorem V(z) = −Σ a·mean((z − z')₊) over faces of signed horizontal area a.
    """
    vertices, faces = mesh_of(solid)
    below = kernels.volume_below(vertices, faces, np.ascontiguousarray(cuts_mm, np.float64))
    return np.maximum(np.diff(below), 0.0)


def plan_slabs(
    solid: Any, grid: LayerGrid, *, nozzle_diameter_mm: float, options: PartOptions = DEFAULT_PART
) -> tuple[Slab, ...]:
    """Layers of a part on a grid that bends to the part's own horizontal faces.

    A face between two grid heights would cost or add up to half a layer of its whole area, so
    the nearest top moves onto it; no layer gets thinner than half the grid's nor higher than
    a nozzle of that bore presses onto the last.
    """
    box = solid.bounding_box()
    bottom_mm, end_mm = max(0.0, float(box[2])), float(box[5])
    if end_mm - bottom_mm <= _SAME_LAYER_MM:
        return ()
    h_mm = grid.layer_height_mm
    highest_mm = max(1.05 * h_mm, options.highest_nozzles * nozzle_diameter_mm)
    tops = list(grid.tops_to(end_mm))
    faces = sorted({*_horizontal_faces(solid, options), end_mm, bottom_mm})
    cuts = _snapped([bottom_mm, *[z for z in tops if z > bottom_mm + _SAME_LAYER_MM]], faces, h_mm)
    cuts = [z for z in cuts if bottom_mm - _SAME_LAYER_MM <= z <= end_mm + _SAME_LAYER_MM]
    cuts = _split_thick(cuts, highest_mm, max(h_mm, grid.first_layer_height_mm))
    volumes = slab_volumes(solid, np.array(cuts))
    return tuple(
        Slab(index=i, bottom_mm=a, top_mm=b, volume_mm3=float(v))
        for i, (a, b, v) in enumerate(zip(cuts[:-1], cuts[1:], volumes, strict=True))
    )


def _horizontal_faces(solid: Any, options: PartOptions) -> list[float]:
    """Heights of level faces that are large enough to matter."""
    z, areas = level_faces(*mesh_of(solid), _SAME_LAYER_MM)
    if not len(z):
        return []
    heights, group = np.unique(np.round(z, 3), return_inverse=True)
    total = np.bincount(group, areas)
    box = solid.bounding_box()
    extent_mm = float(box[5] - box[2])
    enough = options.snap_share * max(float(total.max()), float(solid.volume()) / extent_mm)
    return [float(z) for z in heights[total >= enough]]


def _snapped(cuts: list[float], faces: list[float], h_mm: float) -> list[float]:
    """Cuts with the nearest one moved onto each face, largest gaps kept legal."""
    out = list(cuts)
    fixed: set[int] = {0}
    for face in faces:
        i = int(np.argmin(np.abs(np.array(out) - face)))
        if abs(out[i] - face) <= _SAME_LAYER_MM or (
            i not in fixed and abs(out[i] - face) <= 0.5 * h_mm + _SAME_LAYER_MM
        ):
            out[i] = face
            fixed.add(i)
        elif min(abs(z - face) for z in out) >= 0.4 * h_mm:
            out.append(face)
            out.sort()
            k = out.index(face)
            fixed = {j + (j >= k) for j in fixed} | {k}
    out = sorted(set(out))
    # A moved cut may leave a crumb beside a face; then the movable neighbour is dropped.
    kept = [out[0]]
    face_set = {*faces}
    for z in out[1:]:
        if z - kept[-1] < 0.45 * h_mm:
            if z in face_set and kept[-1] not in face_set and len(kept) > 1:
                kept[-1] = z
                continue
            if z not in face_set:
                continue
        kept.append(z)
    return kept


def _split_thick(cuts: list[float], highest_mm: float, usual_mm: float) -> list[float]:
    """Halve what is thicker than the nozzle can press, and than the grid itself asks for."""
    limit_mm = max(highest_mm, usual_mm) + _SAME_LAYER_MM
    out = cuts[:1]
    for z in cuts[1:]:
        pieces = max(1, math.ceil((z - out[-1]) / limit_mm))
        out += list(np.linspace(out[-1], z, pieces + 1)[1:])
    return [float(z) for z in out]
