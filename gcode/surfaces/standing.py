"""What beads stand as once they are laid: how wide and how high, for all that is near them later.

Whoever plans a way over what it will have laid and whoever judges one over what a program has laid
predict the same thing from the same figures. They share this prediction and nothing else.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gcode.surfaces import standing_kernels as kernels
from gcode.surfaces.heightfield import HeightField

# A bead's plastic spreads as if it lay no higher: most layers are as high, or higher and narrower.
LEAST_HIGH_MM = 0.2
# In bores: no bead is wider; the flat around the bore is 2.5 wide (E3D V6) and presses no farther.
WIDEST_NOZZLES = 2.0


def half_widths_mm(section_mm2: Float[np.ndarray, " n"], bore_mm: float) -> Float[np.ndarray, " n"]:
    """(n,) how far beads of some cross-sections reach to each side, from a nozzle of a bore."""
    return 0.5 * np.clip(section_mm2 / LEAST_HIGH_MM, 0.0, WIDEST_NOZZLES * bore_mm)


def with_beads(
    field: HeightField,
    start_mm: Float[np.ndarray, "n 3"],
    end_mm: Float[np.ndarray, "n 3"],
    section_mm2: Float[np.ndarray, " n"],
    bore_mm: float,
) -> HeightField:
    """What stands there, and beads on it: each as high as its nozzle was, as wide as it may be.

    Parameters
    ----------
    start_mm, end_mm
        (n, 3) of the nozzle's tip, build frame.
    section_mm2
        (n,) of the plastic between them.
    bore_mm
        Of the nozzle.
    """
    z_mm = field.z_mm.astype(np.float64)
    start, end = (np.ascontiguousarray(at, dtype=np.float64) for at in (start_mm, end_mm))
    kernels.raise_by_beads(
        z_mm, start, end, half_widths_mm(section_mm2, bore_mm),
        field.origin_mm.astype(np.float64), field.cell_mm,
    )  # fmt: skip
    return field.raised(z_mm)
