"""Names for arrays that signatures are full of: what they hold, and their shapes.

Every array of one of the first four names in a signature has the same number n of rows, or of
entries; where a second number is needed the shape stands there itself. Units and frames are told
by the names of the parameters, as everywhere.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

Points = Float[np.ndarray, "n 3"]
"""Places, or ways, one a row."""
Values = Float[np.ndarray, " n"]
"""A number for each."""
Mask = Bool[np.ndarray, " n"]
"""Whether, for each."""
Numbers = Int[np.ndarray, " n"]
"""A whole number for each: which, how many, of what class."""
HeightMap = Float[np.ndarray, "ny nx"]
"""Columns of a field, by rows."""
ColumnMask = Bool[np.ndarray, "ny nx"]
"""Whether, for each column."""
Voxels = Float[np.ndarray, "x y z"]
"""A number for each voxel."""
VoxelMask = Bool[np.ndarray, "x y z"]
"""Whether, for each voxel."""
