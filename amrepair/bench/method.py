"""What a method is to the runner: fitted on a class's normal data, then asked for scores.

It also brings a class to one scale, so that every method sees parts of 100 mm: the data sets'
units differ, and every radius of a method is relative to the part.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.stats import chi2

from amrepair.arrays import Points, Values
from amrepair.bench.metrics import CloudDistance
from amrepair.bench.samples import BenchClass

if TYPE_CHECKING:
    import trimesh

DIAGONAL_MM = 100.0
NOISE_POINTS, CLOUD_NOISE_NEIGHBOURS, CLOUD_NOISE_QUANTILE = 4000, 10, 0.1


@dataclass(frozen=True, slots=True)
class ClassInput:
    """Normal data of a class, scaled to a diagonal of 100 mm.

    Attributes
    ----------
    clouds_mm
        Training clouds, each (n, 3), in frames of their own.
    mesh
        The normal shape, or None.
    sigma_mm
        Noise of the training clouds, estimated from them.
    mm_per_unit
        What the files' coordinates were multiplied by.
    """

    name: str
    format: str
    clouds_mm: tuple[Float[np.ndarray, "_ 3"], ...]
    mesh: trimesh.Trimesh | None
    sigma_mm: float
    mm_per_unit: float


@dataclass(frozen=True, slots=True)
class Scores:
    """What a method says of one cloud.

    Attributes
    ----------
    point
        (n,) anomaly score of each point.
    whole
        Anomaly score of the cloud.
    residual_mm
        (n,) distance to the normal surface after alignment; None where nothing was aligned.
    aligned
        False where an alignment was tried and failed.
    """

    point: Values
    whole: float
    residual_mm: Values | None = None
    aligned: bool = True


@runtime_checkable
class Model(Protocol):
    """A method fitted to one class."""

    @property
    def template_distance(self) -> CloudDistance | None:
        """How far the method's repair template is from the normal shape; None without one."""

    def score(self, points_mm: Points, rng: np.random.Generator) -> Scores:
        """Score a cloud, whatever its pose."""


@runtime_checkable
class Method(Protocol):
    """Something that can be fitted to a class's normal data."""

    def fit(self, data: ClassInput, *, seed: int, cache: Path) -> Model:
        """Fit; `cache` is a folder for what other seeds or methods may use again."""


def class_input(one: BenchClass, format: str) -> ClassInput:
    """Read a class's normal data and scale it."""
    import trimesh

    clouds = [one.read_train(path) for path in one.train]
    diagonal = float(np.linalg.norm(np.ptp(clouds[0], axis=0)))
    scale = DIAGONAL_MM / diagonal
    mesh = None
    if one.mesh is not None:
        from amrepair.template.mesh_file import load_mesh

        found = load_mesh(one.mesh)
        mesh = trimesh.Trimesh(
            np.array(found.vertices) * scale, np.array(found.faces), process=False
        )
    scaled = tuple(np.asarray(cloud * scale) for cloud in clouds)
    return ClassInput(one.name, format, scaled, mesh, noise_mm(scaled[0]), scale)


def noise_mm(points_mm: Points) -> float:
    """Noise across the surface, from the residuals of planes through ten neighbours.

    On flat ground the smallest eigenvalue of k points is σ² χ² with k − 3 degrees of freedom;
    edges, curves and thin walls only add to it. So a low quantile is compared with the χ² quantile:
    one place in five must be flat, not one in two.
    """
    step = max(1, len(points_mm) // NOISE_POINTS)
    count = min(CLOUD_NOISE_NEIGHBOURS, len(points_mm))
    if count <= 3:
        return 0.0
    index = cKDTree(points_mm).query(points_mm[::step], k=[*range(1, count + 1)])[1]
    near = points_mm[index] - points_mm[index].mean(axis=1, keepdims=True)
    smallest = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", near, near))[:, 0]
    low = float(np.quantile(np.maximum(smallest, 0.0), CLOUD_NOISE_QUANTILE))
    return float(np.sqrt(low / chi2.ppf(CLOUD_NOISE_QUANTILE, count - 3)))
