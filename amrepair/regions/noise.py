"""Noise: what a scan itself tells of its errors, for the person who has to trust it."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from amrepair.field.scales import Scale
from amrepair.field.scales_kernels import NORMAL_MEDIAN
from amrepair.observe.order import views_from
from amrepair.observe.views import Shares
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import OUTLIER_SIGMAS, Level, point_sigma_mm
from amrepair.scans import Scan

# Errors hang together over the distance at which their variogram has reached this share (1 − 1/e).
SILL_SHARE = 0.632
# A window is a cell with those around it, as they lie in a surface.
CELLS_OF_WINDOW = 9.0
# Of a scan that shows a surface no more than a tenth strays, or lies alone at a rim.
LEAST_JUDGED = 0.9


@dataclass(frozen=True, slots=True)
class Noise:
    """What a scan's own deviations tell of its errors.

    Attributes
    ----------
    sigma_mm
        Standard deviation of one point about its neighbours.
    tail_share
        Share of the places that are off by more than three standard deviations.
    correlation_mm
        Over which distance errors hang together; 0 where no farther than a cell.
    view_disagreement_mm
        Standard deviation between what views say of the same place; None with one view.
    views_from
        What tells views apart: the scan's sensors, or the order of its points; None with one view.
    smallest_mm
        Of each scale: area of a window, mm², and the least depth that it would show, mm.
    source
        Where the noise is from: this scan, or a profile where it has too few points.
    judged_share
        Of the points: of the others too few lie together, in windows of any width, for anything to
        be told of them.
    """

    sigma_mm: float
    tail_share: float
    correlation_mm: float
    view_disagreement_mm: float | None
    smallest_mm: tuple[tuple[float, float], ...]
    source: str
    judged_share: float = 1.0
    views_from: str | None = None

    @property
    def too_sparse(self) -> bool:
        """Whether more is not judged than strays."""
        return self.judged_share < LEAST_JUDGED

    def told_sparse(self) -> str:
        """What a scan with too few points cannot tell, in a sentence."""
        cell_mm = float(np.sqrt(self.smallest_mm[-1][0] / CELLS_OF_WINDOW))
        return (
            f"Only {100 * self.judged_share:.0f} % of the points could be judged: elsewhere fewer "
            f"than two lie in a cell of {cell_mm:.1f} mm, and a defect there would not be seen; "
            "scan more finely."
        )

    def told(self) -> str:
        """All but the smallest depths, in a sentence."""
        words = [
            f"One point is off by {self.sigma_mm:.3f} mm (standard deviation, from {self.source})",
            f"{100 * self.tail_share:.1f} % of places by over {OUTLIER_SIGMAS:g} times that",
        ]
        if self.correlation_mm:
            words.append(f"errors hang together over {self.correlation_mm:.1f} mm")
        if self.view_disagreement_mm is not None:
            words.append(
                f"views, told apart by {self.views_from}, differ by "
                f"{self.view_disagreement_mm:.3f} mm"
            )
        return "; ".join(words) + "."

    def to_json(self) -> dict[str, object]:
        """As results have it."""
        said = asdict(self)
        said["smallest"] = [{"area_mm2": a, "depth_mm": d} for a, d in said.pop("smallest_mm")]
        return said


def noise_of(
    levels: tuple[Level, ...], shares: Shares | None, scan: Scan, options: RegionOptions
) -> Noise:
    """Tell the noise of a scan from its tested scales.

    Parameters
    ----------
    levels
        The first scale's third deviations and medians, then every wider scale's medians.
    shares
        What each view says of each cell; None where views are not told apart.
    scan
        Its sigma is the scanner's own word on its noise, where the scan has too few cells to tell.
    """
    first = levels[0].scale
    told = len(first) >= options.least_cells
    sigma_mm = point_sigma_mm(first) if told else scan.sigma_mm
    off = np.abs(first.value_mm - first.median_mm) > OUTLIER_SIGMAS * np.maximum(
        first.noise_mm, 1e-9
    )
    return Noise(
        sigma_mm=float(sigma_mm),
        tail_share=float(off.mean()),
        correlation_mm=_correlation_mm([level.scale for level in levels[1:]]),
        view_disagreement_mm=None if shares is None else shares.apart_mm,
        smallest_mm=tuple(
            (CELLS_OF_WINDOW * level.scale.cell_mm**2, level.smallest_mm) for level in levels[1:]
        ),
        source="this scan" if told else f"the profile's, {len(first)} cells are too few to tell",
        judged_share=_judged_share(levels),
        views_from=None if shares is None else views_from(scan),
    )


def _judged_share(levels: tuple[Level, ...]) -> float:
    """Of the points, how many lie where a window of some width is surface."""
    first = levels[0].scale
    judged = np.zeros(len(first.of_base), bool)
    for level in levels[1:]:
        judged |= level.scale.is_surface[level.scale.of_base]
    points = first.weight / np.bincount(first.of_base, minlength=len(first))
    each = points[first.of_base]
    return float(each[judged].sum() / each.sum())


def _correlation_mm(scales: list[Scale]) -> float:
    """The distance over which errors hang together, by how window means spread with their width.

    Means of independent errors spread as one over the width of their window; where they spread
    more, the rest is common to the window.
    """
    spread = [float(np.median(np.abs(s.median_mm))) / NORMAL_MEDIAN for s in scales]
    alone = [float(np.median(s.noise_mm / np.sqrt(np.maximum(s.count, 1)))) for s in scales]
    common = np.sqrt(np.maximum(np.square(spread) - np.square(alone), 0.0))
    if common[0] <= alone[0]:
        return 0.0
    together = common >= (1.0 - SILL_SHARE) * common[0]
    last = int(np.argmin(together)) if not together.all() else len(scales)
    return float(scales[max(last - 1, 0)].width_mm)
