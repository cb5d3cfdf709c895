"""Names for arrays that signatures are full of: what they hold, and their shapes.

Every array of one of the first five names in a signature has the same number n of rows, or of
entries; where a second number is needed the shape stands there itself. Units and frames are told
by the names of the parameters, as everywhere.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

Points = Float[np.ndarray, "n 3"]
"""Places, or ways, one a row."""
PlanePoints = Float[np.ndarray, "n 2"]
"""Places in a plane, one a row."""
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
Vector = Float[np.ndarray, " 3"]
"""One place, or one way."""
Box = Float[np.ndarray, "2 3"]
"""Lowest and highest corner."""
Matrix = Float[np.ndarray, "4 4"]
"""A pose, as it acts on homogeneous columns."""
Vertices = Float[np.ndarray, "v 3"]
"""Corners of a mesh."""
Faces = Int[np.ndarray, "f 3"]
"""A mesh's triangles: which corners, counter-clockwise from outside."""
