"""What normal parts differ by is no defect: a template's spread, taken off a scan's deviations.

It changes what the labels are made from, never the deviations that are reported.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from amrepair.detect.surfels import Surfels
from amrepair.template.port import Template

# Normal parts lie within three standard deviations; few scans know theirs no better.
TOLERATED_SPREADS = 3.0


def forgiven(surfels: Surfels, template: Template) -> Surfels:
    """Surfels whose deviations are nearer to 0 by what normal parts differ there."""
    spread = getattr(template, "spread_mm", None)
    if spread is None:
        return surfels
    tolerance_mm = TOLERATED_SPREADS * spread(surfels.place_mm)
    if not tolerance_mm.any():
        return surfels

    def less(deviation_mm: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
        return np.sign(deviation_mm) * np.maximum(np.abs(deviation_mm) - tolerance_mm, 0.0)

    return surfels.judged_by(less)
