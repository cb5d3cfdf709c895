"""Voxel boxes around defects, and surfaces out of them: field in, manifold3d solid out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from skimage import measure

from amrepair.arrays import Points, VoxelMask, Voxels
from amrepair.deficit.options import DEFAULT_DEFICIT, VoxelOptions
from amrepair.errors import DeficitError
from amrepair.field.groups import connected
from amrepair.frames import grid_points
from gcode.solids import as_manifold, is_valid

Surface = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
SURFACE_STEPS = 4.0  # of a grid: more than the longest way between corners of a cube


@dataclass(frozen=True, slots=True)
class VoxelBox:
    """A regular grid of sample points, template frame.

    Attributes
    ----------
    low_mm
        (3,) first sample.
    step_mm
        (3,) distance between samples by axis (thin defects are sampled finer across).
    shape
        Samples by axis.
    """

    low_mm: Float[np.ndarray, " 3"]
    step_mm: Float[np.ndarray, " 3"]
    shape: tuple[int, int, int]

    @classmethod
    def around(
        cls,
        low_mm: Float[np.ndarray, " 3"],
        high_mm: Float[np.ndarray, " 3"],
        *,
        thickness_mm: float,
        across: int,
        is_film: bool = True,
        options: VoxelOptions = DEFAULT_DEFICIT.voxels,
    ) -> VoxelBox:
        """A grid over a box, fine enough for a defect `thickness_mm` thick across one axis.

        Where that is too many samples it is first coarser along the defect, up to what walls need,
        then across it, then along it again; one that is no film then across it as along it.
        """
        coarsest = options.coarsest_mm
        fine = float(np.clip(thickness_mm / options.across_ratio, options.finest_mm, coarsest))
        step = np.full(3, max(fine, min(coarsest, 2.5 * fine)))
        step[across] = fine
        along = np.arange(3) != across
        extent = np.maximum(high_mm - low_mm, 1e-6)

        def over() -> float:
            return max(float(np.prod(extent / step + 1)) / options.most, 1.0)

        step[along] *= min(np.sqrt(over()), coarsest / step[along][0])
        least = min(thickness_mm / options.least_ratio, coarsest)
        step[across] *= min(over(), max(least / fine, 1.0))
        step[along] *= min(np.sqrt(over()), 2.0)
        if not is_film:
            step[across] = min(step[across] * over(), step[along][0])
        step *= over() ** (1 / 3)
        size = np.ceil(extent / step).astype(int) + 1
        return cls(low_mm, step, (int(size[0]), int(size[1]), int(size[2])))

    @property
    def surface_mm(self) -> float:
        """What is farther than this from a surface has no part in its shape."""
        return SURFACE_STEPS * float(self.step_mm.max())

    def samples_mm(self) -> Points:
        """(v, 3) all sample points, last axis fastest."""
        axes = [self.low_mm[i] + self.step_mm[i] * np.arange(self.shape[i]) for i in range(3)]
        return grid_points(*axes)

    def distance_to(self, mask: VoxelMask) -> Voxels:
        """Distance of every sample to the nearest one in `mask`, mm; inf where it is empty."""
        if not mask.any():
            return np.full(self.shape, np.inf)
        return np.asarray(ndimage.distance_transform_edt(~mask, sampling=tuple(self.step_mm)))


def solids_from_field(
    box: VoxelBox, field_mm: Voxels, least_mm3: float
) -> list[manifold3d.Manifold]:
    """Where the field is negative, closed at the box's faces: a solid each that holds together.

    None that is smaller than `least_mm3`; a smaller hollow within one is filled.

    Raises
    ------
    DeficitError
        If the surface of one is not a valid manifold.
    """
    # exact zeros make triangles without area; a nanometre is far below any tolerance here
    field_mm = np.where(np.abs(field_mm) < 1e-6, 1e-6, field_mm)
    if not (field_mm < 0).any():
        return []
    limit = box.surface_mm
    padded = np.pad(np.clip(field_mm, -limit, limit), 1, constant_values=limit)
    extract: Any = measure.marching_cubes
    for method in ("lewiner", "lorensen"):
        vertices, faces, _, _ = extract(padded, 0.0, spacing=tuple(box.step_mm), method=method)
        surfaces = _apart(vertices + (box.low_mm - box.step_mm), faces, least_mm3)
        shells, hollows = ([as_manifold(*surface) for surface in each] for each in surfaces)
        if all(is_valid(solid) for solid in shells + hollows):
            return [_without(shell, hollows) for shell in shells]
    raise DeficitError(
        f"the surface of a defect near {np.round(box.low_mm, 1).tolist()} mm is not a valid solid; "
        "scan again with finer spacing"
    )


def _without(shell: manifold3d.Manifold, hollows: list[manifold3d.Manifold]) -> manifold3d.Manifold:
    """A solid without the hollows that lie in it; one that it lies in itself is larger."""
    volume_mm3 = shell.volume()
    within = [hollow for hollow in hollows if hollow.volume() < volume_mm3]
    if not within:
        return shell
    return manifold3d.Manifold.batch_boolean([shell, *within], manifold3d.OpType.Subtract)


def _apart(
    vertices_mm: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], least_mm3: float
) -> tuple[list[Surface], list[Surface]]:
    """Closed surfaces, of which none touches another: outer ones, and hollows' turned outward.

    Without those that hold too little.
    """
    one, other = faces[:, :2].ravel(), faces[:, 1:].ravel()
    body = connected(one, other, len(vertices_mm))
    # about a corner near by: large numbers would cancel
    corner = (vertices_mm - vertices_mm[0])[faces]
    six_fold_mm3 = np.linalg.det(corner)
    volume_mm3 = np.bincount(body[faces[:, 0]], six_fold_mm3) / 6.0
    found: tuple[list[Surface], list[Surface]] = [], []
    for large in np.flatnonzero(np.abs(volume_mm3) >= least_mm3):
        own = body == large
        number = np.cumsum(own) - 1
        turned = volume_mm3[large] < 0
        corners = number[faces[own[faces[:, 0]]]]
        found[int(turned)].append((vertices_mm[own], corners[:, ::-1] if turned else corners))
    return found
