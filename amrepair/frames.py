"""Rigid transforms that carry their frames: `target_from_source`.

Frames in use: `build` (bed corner at the origin, Z up), `scanner` (whatever the sensor says),
`template` (the part's own coordinates, as its mesh file has them). All lengths are mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from amrepair.arrays import Box, Mask, Matrix, Points, Values, Vector
from amrepair.errors import InputError

# A product of a few float64 rotations stays orthonormal to about 1e-15; files carry 6 digits.
ORTHONORMAL_TOLERANCE = 1e-5


@dataclass(frozen=True, slots=True)
class Transform:
    """A rigid motion that takes coordinates in `source` to coordinates in `target`.

    Attributes
    ----------
    matrix
        (4, 4) float64, row-major, acts on column vectors.

    Raises
    ------
    InputError
        If the matrix is not rigid.

    Examples
    --------
    >>> import numpy as np
    >>> from amrepair import Transform
    >>> build_from_template = Transform.from_rotation_translation(
    ...     "build", "template", rotation=np.eye(3), translation_mm=np.array([100.0, 80.0, 0.0])
    ... )
    >>> build_from_template.apply(np.array([[1.0, 2.0, 3.0]]))
    array([[101.,  82.,   3.]])
    >>> build_from_template @ build_from_template.inverse() @ build_from_template.inverse()
    Traceback (most recent call last):
    ...
    amrepair.errors.InputError: cannot compose build_from_build with template_from_build: build ...
    """

    target: str
    source: str
    matrix: Matrix

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        rotation = matrix[:3, :3]
        defect = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        bottom_is_affine = bool(np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0)))
        if not np.isfinite(matrix).all() or not bottom_is_affine:
            raise InputError(
                f"the transform {self.target}_from_{self.source} is not a finite rigid motion: "
                "its last row must be 0 0 0 1 and every entry finite"
            )
        if defect > ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise InputError(
                f"the transform {self.target}_from_{self.source} is not rigid: "
                f"its rotation is off by {defect:.2e}, the limit is {ORTHONORMAL_TOLERANCE:.0e}"
            )
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def identity(cls, target: str, source: str) -> Transform:
        """The motion that moves nothing."""
        return cls(target, source, np.eye(4))

    @classmethod
    def from_rotation_translation(
        cls, target: str, source: str, *, rotation: Float[np.ndarray, "3 3"], translation_mm: Vector
    ) -> Transform:
        """A motion from its (3, 3) rotation and (3,) translation in mm."""
        return cls(target, source, rigid(rotation, translation_mm))

    @classmethod
    def on_bed(cls, x_mm: float, y_mm: float, z_mm: float, turn_deg: float) -> Transform:
        """Build from template: where a part's own origin stands, and its turn about Z."""
        turn = rotation_from_vector(np.array([0.0, 0.0, np.deg2rad(turn_deg)]))
        return cls.from_rotation_translation(
            "build", "template", rotation=turn, translation_mm=np.array([x_mm, y_mm, z_mm])
        )

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """(3, 3) rotation."""
        return self.matrix[:3, :3]

    @property
    def translation_mm(self) -> Vector:
        """(3,) translation, mm."""
        return self.matrix[:3, 3]

    def inverse(self) -> Transform:
        """`source_from_target`."""
        back = self.rotation.T
        return Transform(self.source, self.target, rigid(back, -back @ self.translation_mm))

    def __matmul__(self, other: Transform) -> Transform:
        """Compose: (a_from_b @ b_from_c) is a_from_c; frames that do not meet are refused."""
        if self.source != other.target:
            raise InputError(
                f"cannot compose {self.target}_from_{self.source} with "
                f"{other.target}_from_{other.source}: {self.source} is not {other.target}"
            )
        return Transform(self.target, other.source, self.matrix @ other.matrix)

    def apply(self, points_mm: Points) -> Points:
        """(n, 3) points in the target frame, mm."""
        return moved(points_mm, self.matrix)

    def solid(self, of: Any) -> Any:
        """A `manifold3d.Manifold` in the target frame."""
        return of.transform(self.matrix[:3])

    def rotate(self, vectors: Points) -> Points:
        """(n, 3) directions in the target frame."""
        return vectors @ self.rotation.T


def moved(points_mm: Points, matrix: Matrix) -> Points:
    """(n, 3) points turned and shifted by a homogeneous matrix."""
    out = points_mm @ matrix[:3, :3].T
    for axis in range(3):  # a row of three is too short a loop for numpy: 40 ms of 500,000
        out[:, axis] += matrix[axis, 3]
    return np.asarray(out)


def box_of(points_mm: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "2 k"]:
    """(2, k) lowest and highest corner; axis by axis, an eighth of the time."""
    return np.array([[fold(along) for along in points_mm.T] for fold in (np.min, np.max)])


def cells_of(
    points_mm: Float[np.ndarray, "n k"], low_mm: Float[np.ndarray, " k"] | float, cell_mm: float
) -> Int[np.ndarray, "n k"]:
    """(n, k) the cell of a grid from `low_mm` on that holds each point."""
    return np.floor((points_mm - low_mm) / cell_mm).astype(np.int64)


def in_box(
    points_mm: Float[np.ndarray, "n k"],
    low_mm: Float[np.ndarray, " k"],
    high_mm: Float[np.ndarray, " k"],
) -> Mask:
    """(n,) which points lie in a box, its faces included; axis by axis, an eighth of the time."""
    inside = np.ones(len(points_mm), bool)
    for along, low, high in zip(points_mm.T, low_mm, high_mm, strict=True):
        inside &= along >= low
        inside &= along <= high
    return inside


def nearest_box(boxes_mm: Sequence[Box], box_mm: Box) -> int:
    """Number of the box whose corners lie nearest to another one's."""
    off_mm = [float(np.abs(np.asarray(box) - box_mm).max()) for box in boxes_mm]
    return int(np.argmin(off_mm))


def boxes_meet(one: Box, other: Box) -> bool:
    """Whether two boxes, lowest and highest corner each, have a place in common."""
    return bool((one[0] <= other[1]).all() and (other[0] <= one[1]).all())


def lengths(vectors: Points) -> Values:
    """(n,) how long vectors are; axis by axis, a third of the time."""
    x, y, z = vectors.T
    return np.asarray(np.sqrt((x * x + y * y) + z * z))


def unit_vectors(vectors: Points) -> Points:
    """The same directions, one long; zero stays zero."""
    length = np.maximum(lengths(vectors), 1e-12)
    out = np.empty_like(length, shape=vectors.shape)
    for axis in range(3):
        np.divide(vectors[:, axis], length, out=out[:, axis])
    return out


def nearest_rotation(matrix: Float[np.ndarray, "... 3 3"]) -> Float[np.ndarray, "... 3 3"]:
    """(..., 3, 3) the rotation next to a matrix, least squares (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def rotation_from_vector(vector_rad: Vector) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of an axis-angle vector (Rodrigues), exact near zero."""
    angle_rad = float(np.linalg.norm(vector_rad))
    x, y, z = vector_rad
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sinc forms keep the series exact where the angle vanishes
    first = np.sinc(angle_rad / np.pi)
    second = 0.5 * np.sinc(angle_rad / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + first * skew + second * (skew @ skew))


def turn_between(one: Vector, other: Vector) -> Vector:
    """The axis-angle vector that turns a unit vector to another, no more than 90° from it."""
    axis = np.cross(one, other)
    sine = float(np.linalg.norm(axis))
    return np.asarray(axis * (np.arcsin(min(1.0, sine)) / max(sine, 1e-12)))


def turned_rad(rotation: Float[np.ndarray, "3 3"]) -> float:
    """By how much a rotation turns, about whatever axis; 0 to π."""
    cosine = (np.trace(rotation) - 1.0) / 2.0
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def rotation_of_quaternion(wxyz: Float[np.ndarray, " 4 *k"]) -> Float[np.ndarray, "*k 3 3"]:
    """(*k, 3, 3) rotations of unit quaternions."""
    w, x, y, z = wxyz
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def rigid(rotation: Float[np.ndarray, "3 3"], translation_mm: Vector) -> Matrix:
    """(4, 4) motion that turns about the origin, and then shifts."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, translation_mm
    return motion


def motion_about(centre_mm: Vector, turn_rad: Vector, shift_mm: Vector) -> Matrix:
    """(4, 4) motion that turns about a place by an axis-angle vector, and then shifts."""
    turn = rotation_from_vector(turn_rad)
    return rigid(turn, centre_mm + shift_mm - turn @ centre_mm)


def ways_across(
    along: Float[np.ndarray, "*any 3"],
) -> tuple[Float[np.ndarray, "*any 3"], Float[np.ndarray, "*any 3"]]:
    """Two unit vectors across each unit vector, and across each other; right-handed before it."""
    helper = np.eye(3)[np.argmin(np.abs(along), axis=-1)]
    across = np.cross(along, helper)
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    return across, np.cross(along, across)


def spread_directions(count: int) -> Float[np.ndarray, "k 3"]:
    """(k, 3) directions spread evenly over the sphere (Fibonacci)."""
    index = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * index / count, np.pi * (1.0 + np.sqrt(5.0)) * index
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def diagonal(points_mm: Points) -> float:
    """Length, from its lowest to its highest corner, of the box of some points; or of a box's."""
    return float(np.linalg.norm(np.ptp(points_mm, axis=0)))


def grid_points(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Any:
    """(n, 3) every combination of values along three axes, those of the last changing first."""
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def box_corners(bounds_mm: Box) -> Float[np.ndarray, "8 3"]:
    """(8, 3) corners of a box, given its lowest and its highest corner."""
    return np.asarray(
        bounds_mm[grid_points([0, 1], [0, 1], [0, 1]), np.arange(3)], dtype=np.float64
    )
