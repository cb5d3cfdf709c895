"""What of a scan's deviations belongs to the whole part or to a whole view, and is no defect.

Residual pose, scale, bow and the views' offsets are fitted together, each with its prior, so
robustly that defects do not pull them. What the observations do not support stays zero; what
exceeds its prior is told in a sentence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtrc

from amrepair.arrays import Numbers, Points, Values
from amrepair.errors import InputError
from amrepair.observe.basis import (
    BOW_AT,
    DEFAULT_NUISANCE,
    SCALE_AT,
    VIEWS_AT,
    Frame,
    bow_moves,
    priors,
    shape_columns,
)
from amrepair.observe.cells import Cells, blocks, gather
from amrepair.observe.robust import Problem, Solution, covariance, solve, starts_by_block

CELLS_ACROSS = 48  # a nuisance is smooth: cells finer than this say nothing more about it
STATIONS = np.linspace(-1, 1, 21)  # from end to end of an axis
BESIDE_RATIO = 0.1  # a bow along one axis alone is told with that axis's length


@dataclass(frozen=True, slots=True)
class Nuisance:
    """Residual pose, scale, bow and view offsets of one scan, in the template's frame.

    Attributes
    ----------
    frame
        What rotation, scale and bow are about: centre, principal axes, half extents.
    twist
        (6,) translation in mm and small rotation in rad about the centre.
    scale_ratio
        Size over nominal size, minus one: −0.007 is a part 0.7 % small.
    bow_mm
        (4,) the sag, middle against ends, of the first axis towards the second, of the first
        towards the third, of the second towards the third; and how far corners leave the plane
        of the first two axes by twisting.
    view_offset_mm
        (v,) how far outside each view says the surface is; empty where views are not told.
    covariance
        (11 + v, 11 + v) of twist, scale, bow and offsets, by noise and by what changes where an
        eighth of the surface is left out. Zero for a term that stayed zero.
    sigma_mm
        Standard deviation of one cell's deviation, with what a sound part is allowed.
    supported
        The terms that the observations asked for: of scale, bow, views, common.
    used_ratio
        Share of the observations that the fit believed; the rest is defects and outliers.
    independent
        How many independent observations there were.
    """

    frame: Frame
    twist: Float[np.ndarray, " 6"]
    scale_ratio: float
    bow_mm: Float[np.ndarray, " 4"]
    view_offset_mm: Values
    covariance: Float[np.ndarray, "p p"]
    sigma_mm: float
    supported: tuple[str, ...]
    used_ratio: float
    independent: float

    def removed_mm(self, place_mm: Points, normal: Points, view: Numbers | None = None) -> Values:
        """Return the part of the deviation that is nuisance, to be subtracted.

        `view` (s,) is which view saw it; None takes what the views have in common.
        """
        shape = shape_columns(place_mm, normal, self.frame)
        removed_mm = shape @ np.r_[self.twist, self.scale_ratio, self.bow_mm]
        if len(self.view_offset_mm):
            known = self.common_offset_mm if view is None else self.view_offset_mm[view]
            removed_mm = removed_mm + known
        return np.asarray(removed_mm)

    @property
    def reshapes(self) -> bool:
        """Whether the observations asked for more than a pose: for size, bow or a common offset."""
        return bool(self.scale_ratio or self.bow_mm.any() or self.common_offset_mm)

    @property
    def common_offset_mm(self) -> float:
        """How far outside all views together say the surface is."""
        return float(self.view_offset_mm.mean()) if len(self.view_offset_mm) else 0.0

    def moves_mm(self, place_mm: Points) -> Points:
        """(n, 3) how pose, size and bow move places of the part, not just along their normals."""
        turned = np.cross(self.twist[3:], np.eye(3))  # rows: how each axis moves
        off_mm = place_mm - self.frame.centre_mm
        moved_mm = off_mm @ (turned + self.scale_ratio * np.eye(3)) + self.twist[:3]
        if self.bow_mm.any():
            moved_mm += bow_moves(place_mm, self.frame, self.bow_mm)
        return np.asarray(moved_mm)

    def error_mm(self, place_mm: Points, normal: Points) -> Values:
        """(s,) standard error of `removed_mm` by pose, scale and bow: √(J Σ Jᵀ)."""
        shape = shape_columns(place_mm, normal, self.frame)
        sigma = self.covariance[:VIEWS_AT, :VIEWS_AT]
        return np.sqrt(np.maximum(((shape @ sigma) * shape).sum(axis=1), 0.0))

    def told(self) -> tuple[str, ...]:
        """Say in plain sentences what exceeds its prior; views count from 1."""
        return (*self._told_pose(), *self._told_scale(), *self._told_bow(), *self._told_views())

    def _told_pose(self) -> list[str]:
        moved_mm, turned = np.linalg.norm(self.twist[:3]), np.linalg.norm(self.twist[3:])
        far = moved_mm > DEFAULT_NUISANCE.told_sigma * DEFAULT_NUISANCE.pose_translation_sigma_mm
        if far or turned > DEFAULT_NUISANCE.told_sigma * DEFAULT_NUISANCE.pose_rotation_sigma_rad:
            degrees = np.degrees(turned)
            return [f"It lies {moved_mm:.2f} mm and {degrees:.2f}° from where it was laid."]
        return []

    def _told_scale(self) -> list[str]:
        prior = DEFAULT_NUISANCE.scale_sigma_ratio
        if abs(self.scale_ratio) <= DEFAULT_NUISANCE.told_sigma * prior:
            return []
        word = "small" if self.scale_ratio < 0 else "large"
        percent = 100 * abs(self.scale_ratio)
        return [f"The part is {percent:.1f} % {word} (prior {100 * prior:.1f} %)."]

    def _told_bow(self) -> list[str]:
        prior_mm = DEFAULT_NUISANCE.bow_sigma_mm
        length = [f"{2 * half_mm:.0f}" for half_mm in self.frame.half_extent_mm]
        sags = np.abs(self.bow_mm[1:3])
        flatness_mm = self.flatness_mm
        alone = flatness_mm < (1 + BESIDE_RATIO) * sags.max()
        over = length[int(np.argmax(sags))] if alone else f"{length[0]} × {length[1]}"
        told = []
        for bow_mm, where in ((flatness_mm, over), (abs(self.bow_mm[0]), length[0])):
            if bow_mm > DEFAULT_NUISANCE.told_sigma * prior_mm:
                told.append(f"It is bent by {bow_mm:.2f} mm over {where} mm (prior {prior_mm} mm).")
        return told

    @property
    def flatness_mm(self) -> float:
        """How far apart two planes are that hold the bow of the first two axes between them."""
        u, v = np.meshgrid(STATIONS, STATIONS)
        along_mm = self.bow_mm[1] * u**2 + self.bow_mm[2] * v**2 + self.bow_mm[3] * u * v
        return float(np.ptp(along_mm))

    def _told_views(self) -> list[str]:
        offset, options = self.view_offset_mm, DEFAULT_NUISANCE
        told: list[str] = []

        def tell(lies: str, off_mm: float, prior_mm: float, beside: str) -> None:
            if abs(off_mm) > options.told_sigma * prior_mm:
                side = "outside" if off_mm > 0 else "inside"
                told.append(f"{lies} {abs(off_mm):.2f} mm {side} {beside}.")

        if len(offset):
            whole = "All views lie" if len(offset) > 1 else "The view lies"
            tell(whole, offset.mean(), options.common_offset_sigma_mm, "the template")
        if len(offset) == 2:
            tell("View 2 lies", offset[1] - offset[0], options.view_offset_sigma_mm, "view 1")
        elif len(offset) > 2:
            for k in range(len(offset)):
                off_mm = offset[k] - np.median(np.delete(offset, k))
                tell(f"View {k + 1} lies", off_mm, options.view_offset_sigma_mm, "the others")
        return told

    def to_json(self) -> dict[str, object]:
        """Return plain numbers, with the standard errors and what is told."""
        error = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return {
            "told": list(self.told()),
            "scale_ratio": self.scale_ratio,
            "scale_error_ratio": float(error[SCALE_AT]),
            "flatness_mm": self.flatness_mm,
            "bow_mm": self.bow_mm.tolist(),
            "bow_error_mm": error[BOW_AT:VIEWS_AT].tolist(),
            "extent_mm": (2 * self.frame.half_extent_mm).tolist(),
            "axes": self.frame.axes.tolist(),
            "view_offset_mm": self.view_offset_mm.tolist(),
            "view_offset_error_mm": error[VIEWS_AT:].tolist(),
            "translation_mm": self.twist[:3].tolist(),
            "rotation_rad": self.twist[3:].tolist(),
            "pose_error": error[:SCALE_AT].tolist(),
            "centre_mm": self.frame.centre_mm.tolist(),
            "sigma_mm": self.sigma_mm,
            "supported": list(self.supported),
            "used_ratio": self.used_ratio,
            "independent": self.independent,
        }


def fit_nuisance(
    place_mm: Points,
    normal: Points,
    deviation_mm: Values,
    weight: Values,
    *,
    view: Numbers | None = None,
    tolerance_mm: float,
    correlation_mm: float,
    pose_known: bool = False,
) -> Nuisance:
    """Fit what is common to the whole part or to a whole view.

    Parameters
    ----------
    place_mm
        (s, 3) where the surface was expected or seen, template frame.
    normal
        (s, 3) the template's unit normals there.
    deviation_mm
        (s,) signed, positive outside.
    weight
        (s,) how much each site is worth beside the others, above zero.
    view
        (s,) which view saw the site, from 0; None: offsets of views are not asked for.
    tolerance_mm
        What a sound part may deviate by: larger deviations soon lose their say.
    correlation_mm
        Distance over which the errors' correlation falls to 1/e; 0 where they are independent.
    pose_known
        Nothing is taken for a pose that is off, nor for an offset of all views.

    Raises
    ------
    InputError
        If a sound part may not deviate at all.
    """
    if not tolerance_mm > 0:
        raise InputError(f"the tolerance is {tolerance_mm} mm; it must be above zero")
    views = 0 if view is None else int(view.max()) + 1
    side_mm = max(correlation_mm, float(np.ptp(place_mm, axis=0).max()) / CELLS_ACROSS, 1e-9)
    cells = gather(
        place_mm,
        normal,
        deviation_mm,
        weight,
        np.zeros(len(weight), np.int64) if view is None else view,
        side_mm=side_mm,
        correlation_mm=correlation_mm,
    )
    frame = Frame.of(cells.place_mm)
    shape = shape_columns(cells.place_mm, cells.normal, frame)
    columns = np.column_stack([shape, cells.view[:, None] == np.arange(views)]).astype(float)
    physical, terms = priors(frame.half_extent_mm, views, pose_known=pose_known)
    solution, kept, spread = _supported(columns @ physical, terms, cells, tolerance_mm)
    on = physical[:, kept]
    value = on @ solution.unknown
    return Nuisance(
        frame,
        twist=value[:SCALE_AT],
        scale_ratio=float(value[SCALE_AT]),
        bow_mm=value[BOW_AT:VIEWS_AT],
        view_offset_mm=value[VIEWS_AT:],
        covariance=on @ spread @ on.T,
        sigma_mm=solution.sigma_mm,
        supported=tuple(name for name, at in terms.items() if name != "pose" and kept[at].all()),
        used_ratio=float(cells.share @ solution.weight / cells.share.sum()),
        independent=float(cells.share.sum()),
    )


def _supported(
    design: Float[np.ndarray, "n q"],
    terms: dict[str, Int[np.ndarray, " ..."]],
    cells: Cells,
    tolerance_mm: float,
) -> tuple[Solution, np.ndarray, Float[np.ndarray, "k k"]]:
    """Fit all terms, then leave out the one with the least evidence as long as it is too little.

    One at a time: of two terms that do the same, one goes and the other takes all.
    """
    kept = np.ones(design.shape[1], bool)
    block = blocks(cells.place_mm)
    spare = max(int(block.max()), 1)  # degrees of freedom that leaving out blocks has
    problem = Problem(design, cells.deviation_mm, cells.share, tolerance_mm)
    starts = starts_by_block(problem, block)
    while True:
        solution = solve(problem, starts)
        spread = covariance(problem, solution, block)
        place = np.cumsum(kept) - 1
        chance = {
            name: _chance(solution.unknown[place[at]], spread, place[at], spare)
            for name, at in terms.items()
            if name != "pose" and kept[at].all()
        }
        weakest = max(chance, key=chance.__getitem__, default="")
        if not weakest or chance[weakest] < DEFAULT_NUISANCE.support_p:
            return solution, kept, spread
        stay = np.delete(np.arange(int(kept.sum())), place[terms[weakest]])
        starts = (solution.unknown[stay],)
        kept[terms[weakest]] = False
        problem = Problem(design[:, kept], cells.deviation_mm, cells.share, tolerance_mm)


def _chance(value: Values, spread: Float[np.ndarray, "q q"], at: Numbers, spare: int) -> float:
    """How probable so large a value is where the truth is zero (Hotelling's test)."""
    within = spread[np.ix_(at, at)]
    size = float(value @ np.linalg.solve(within, value)) / len(value)
    return float(fdtrc(len(value), spare, size))
