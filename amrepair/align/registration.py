"""`Registration`: where the scan lies in the template, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.options import AlignOptions
from amrepair.frames import Transform

KNOWN_INFORMATION = 1e12  # of a pose that is known: a micrometre, a millionth of a turn
UNKNOWN_INFORMATION_RATIO = (
    1e-12  # of the best known motion's information: a motion with less is free
)


@dataclass(frozen=True, slots=True)
class Registration:
    """A converged alignment (one that does not converge raises instead).

    Attributes
    ----------
    template_from_scan
        The pose found.
    rmse_mm
        Root mean square of |f| over the inliers.
    inlier_ratio
        Share of the scan's points explained by the template, clutter left aside.
    clutter_ratio
        Share of the scan that is not taken for the part: scattered points, bed, other pieces.
    information
        (6, 6) Gauss–Newton Hessian JᵀWJ / σ², order (rotation x y z about the scan's centroid in
        rad, translation x y z in mm), along the template's axes.
    symmetric_alternatives
        Other poses (template_from_scan) that fit as well, within noise.
    method, iterations, options
        How it was found; None where nothing was searched.
    """

    template_from_scan: Transform
    rmse_mm: float
    inlier_ratio: float
    information: Float[np.ndarray, "6 6"]
    symmetric_alternatives: tuple[Transform, ...]
    method: str
    iterations: int
    clutter_ratio: float = 0.0
    options: AlignOptions | None = None

    @classmethod
    def known(cls, template_from_scan: Transform) -> Registration:
        """A pose that nobody need find: the scan is in the printer's own axes."""
        return cls(template_from_scan, 0.0, 1.0, KNOWN_INFORMATION * np.eye(6), (), "known", 0)

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """(6, 6) inverse of the information: what the points' noise alone leaves open.

        Very large, never infinite, along motions that nothing hinders.
        """
        return bounded_inverse(self.information, UNKNOWN_INFORMATION_RATIO)

    def to_json(self) -> dict[str, object]:
        """As results have it."""
        return {
            "template_from_scan": self.template_from_scan.matrix.tolist(),
            "rmse_mm": self.rmse_mm,
            "inlier_ratio": self.inlier_ratio,
            "clutter_ratio": self.clutter_ratio,
            "symmetric_alternatives": [t.matrix.tolist() for t in self.symmetric_alternatives],
        }


def bounded_inverse(
    information: Float[np.ndarray, "n n"], free_ratio: float
) -> Float[np.ndarray, "n n"]:
    """(n, n) inverse of a symmetric matrix, very large, never infinite, along what is free.

    Free is a direction with less than `free_ratio` of the best known one's information.
    """
    values, vectors = np.linalg.eigh(information)
    least = free_ratio * max(float(values[-1]), np.finfo(float).tiny / free_ratio)
    return np.asarray((vectors / np.maximum(values, least)) @ vectors.T)
