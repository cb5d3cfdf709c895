"""Every rotation tried: poses of a scan on a coarse copy of the field, from nothing known.

Rotations spread evenly over SO(3) start on the template box on box; a few steps of Gauss–Newton on
some hundred points leave the few that deserve more points. No features and no drawing: what looks
alike from several sides is found from all of them. The exact field is `refine`'s business.

References
----------
M. Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3), CVPR 2022.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align import search_kernels as kernels
from amrepair.align.options import DEFAULT_ALIGN, CoarseOptions, Effort
from amrepair.align.thinning import Thinned
from amrepair.arrays import Box, Matrix, Points, Vector, Voxels
from amrepair.frames import grid_points, nearest_rotation, rigid, rotation_of_quaternion
from amrepair.template.port import Template

# Roots of x⁴ = x + 4 and 2 (Alexa, eq. 5).
_PSI, _PHI = 1.533751168755204288118041, np.sqrt(2.0)


@dataclass(frozen=True, slots=True)
class CoarseField:
    """Distances of a template at the nodes of a coarse grid.

    Attributes
    ----------
    values
        (x, y, z) float32.
    box_mm
        (2, 3) of the part.
    options
        That it was made with, and is searched by.
    """

    origin_mm: Vector
    cell_mm: float
    values: Voxels
    box_mm: Box
    options: CoarseOptions

    @classmethod
    def of(cls, template: Template, options: CoarseOptions = DEFAULT_ALIGN.coarse) -> CoarseField:
        """Ask the template at every node; the last one's answers are kept for its next scan."""
        for known, field in _latest:
            if known is template and field.options == options:
                return field
        field = cls._asked(template, options)
        _latest[:] = [(template, field)]
        return field

    @classmethod
    def _asked(cls, template: Template, options: CoarseOptions) -> CoarseField:
        box = template.bounds_mm
        size = box[1] - box[0]
        cell_mm = float(size.max()) / options.cells
        margin_mm = options.margin_ratio * float(np.linalg.norm(size))
        origin = box[0] - margin_mm
        shape = np.ceil((size + 2 * margin_mm) / cell_mm).astype(int) + 1
        axes = [origin[a] + cell_mm * np.arange(shape[a]) for a in range(3)]
        nodes = grid_points(*axes)
        values = template.distance(nodes).reshape(tuple(shape)).astype(np.float32)
        return cls(origin, cell_mm, values, box, options)

    @property
    def diagonal_mm(self) -> float:
        """Of the part's box."""
        return float(np.linalg.norm(self.box_mm[1] - self.box_mm[0]))


@dataclass(frozen=True, slots=True)
class Pose:
    """A pose and how well it fits.

    Attributes
    ----------
    matrix
        (4, 4) template from scan.
    score_mm
        Mean distance of the points, each up to a cap.
    """

    matrix: Matrix
    score_mm: float


_latest: list[tuple[Template, CoarseField]] = []  # one: templates do not change


def search(
    cloud: Thinned,
    field: CoarseField,
    *,
    effort: Effort | None = None,
    turn: Float[np.ndarray, "3 3"] | None = None,
    only: tuple[Matrix, ...] | None = None,
) -> list[Pose]:
    """Poses that fit best, best first, each where no better one is near.

    Parameters
    ----------
    cloud
        Evenly spread over what was scanned, scan's frame.
    effort
        The field's quick one where none is given.
    turn
        A rotation of all that are tried: between those of another search.
    only
        Poses to start from instead of all rotations.
    """
    cell_mm, options = field.cell_mm, field.options
    effort = effort if effort is not None else options.quick
    # The densest cloud comes first, since thinner ones are made from it.
    clouds = [cloud.to(stage.points) / cell_mm for stage in effort.stages[::-1]][::-1]
    centre = clouds[0].mean(axis=0)
    diagonal = field.diagonal_mm / cell_mm
    grid = (field.values.ravel() / np.float32(cell_mm), np.array(field.values.shape))
    if only is None:
        rotations = spread_rotations(effort.rotations)
        if turn is not None:
            rotations = np.ascontiguousarray(rotations @ turn)
        box = (field.box_mm - field.origin_mm) / cell_mm
        gap = effort.gap_ratio * diagonal
        places = kernels.starts(
            _rows(clouds[0] - centre), rotations, box, *grid, 0.1 * diagonal, gap, effort.places
        ).reshape(-1, 3)
        rotations = np.repeat(rotations, effort.places, axis=0)
    else:
        rotations = np.array([matrix[:3, :3] for matrix in only])
        shifts = np.array([matrix[:3, 3] for matrix in only])
        places = rotations @ centre + (shifts - field.origin_mm) / cell_mm
    scores = np.zeros(len(rotations))
    for stage, points in zip(effort.stages, clouds, strict=True):
        # Each cloud is taken about its own centroid, which decouples rotation and translation.
        middle = points.mean(axis=0)
        places = places + rotations @ (middle - centre)
        centre = middle
        local = points - centre
        rotations, places = np.ascontiguousarray(rotations), np.ascontiguousarray(places)
        scales = stage.scales(diagonal)
        scores = kernels.descend(
            _rows(local), rotations, places, *grid, scales, options.cap_ratio * diagonal
        )
        radius = float(np.sqrt((local**2).sum(axis=1).mean()))
        order = np.argsort(scores, kind="stable")
        apart = options.same_pose_ratio * diagonal
        chosen = kernels.peaks(order, rotations, places, radius, apart, stage.keep)
        rotations, places, scores = rotations[chosen], places[chosen], scores[chosen]
    return [
        Pose(
            rigid(nearest_rotation(r), cell_mm * (p - r @ centre) + field.origin_mm),
            cell_mm * float(s),
        )
        for r, p, s in zip(rotations, places, scores, strict=True)
    ]


def misfits_mm(
    points_mm: Points, matrices: Float[np.ndarray, "k 4 4"], field: CoarseField, cap_mm: float
) -> Float[np.ndarray, " k"]:
    """(k,) the mean of |f|, each up to the cap, of points in many poses; edges are rounded.

    Parameters
    ----------
    points_mm, matrices
        In the scan's frame; template from scan.
    """
    centre = points_mm.mean(axis=0)
    rotations = np.ascontiguousarray(matrices[:, :3, :3])
    places = (rotations @ centre + matrices[:, :3, 3] - field.origin_mm) / field.cell_mm
    scores = kernels.misfits(
        _rows((points_mm - centre) / field.cell_mm),
        rotations,
        places,
        field.values.ravel() / np.float32(field.cell_mm),
        np.array(field.values.shape),
        cap_mm / field.cell_mm,
    )
    return np.asarray(field.cell_mm * scores)


def _rows(points: Points) -> Float[np.ndarray, "3 n"]:
    return np.ascontiguousarray(points.T, dtype=np.float32)


def spread_rotations(count: int) -> Float[np.ndarray, "k 3 3"]:
    """(k, 3, 3) rotations spread evenly over SO(3)."""
    s = np.arange(count) + 0.5
    t, d = s / count, 2.0 * np.pi * s
    small, large = np.sqrt(t), np.sqrt(1.0 - t)
    alpha, beta = d / _PHI, d / _PSI
    x, y = small * np.sin(alpha), small * np.cos(alpha)
    z, w = large * np.sin(beta), large * np.cos(beta)
    return rotation_of_quaternion(np.stack([w, x, y, z]))
