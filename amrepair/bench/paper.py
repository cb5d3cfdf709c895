"""`pasdf-paper` and `+pam`: the published system on the benchmark's data.

The template is the paper's network, the alignment PAM, the score |f| and its mean over the 1,000
highest. On the single views of Real3D-AD the two-way Chamfer loss never falls below the paper's
threshold (most of the template has nothing near), so there the released code's directed loss runs,
as the released code has it. The schedule is shortened by default (`BENCH_PAPER`): the released one
takes more than an hour for each class on two cores.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from amrepair.align.options import PUBLISHED_PAM, RELEASED_PAM, PamOptions
from amrepair.align.pam import PamError, pam
from amrepair.arrays import Points, Values
from amrepair.bench.baselines import Aligner
from amrepair.bench.house import class_template, repair_distance
from amrepair.bench.method import ClassInput, Model, Scores
from amrepair.bench.metrics import CloudDistance
from amrepair.bench.samples import Format
from amrepair.frames import moved
from amrepair.merge.cloud import planes, spacing_of
from amrepair.template import MeshSdf
from amrepair.template.paper import RELEASED_NETWORK as CODE_RECIPE
from amrepair.template.paper import PaperOptions
from amrepair.template.port import Template
from amrepair.template.surface import sample_surface

# 1,000 steps of 8,192 instead of 2.4 million of 16; the rate is raised with the batch. Without
# dropout, as released: in so few steps it leaves f = 0 within 0.3 mm of the surface (knob), and the
# published system found nothing.
BENCH_PAPER = replace(CODE_RECIPE, batch=8_192, rate=5e-4, epochs=500)
TOP_SCORES = 1_000
ON_SURFACE_SPACINGS = 2.0  # spacings of the cloud: a point of the surface has one of it so near
TARGET_POINTS = 20_000  # of the template's cloud: as many as the largest test clouds need


# The released configuration of that data set.
REAL3D_PAM = replace(RELEASED_PAM, threshold=1.8)


def pam_options(format: str) -> PamOptions:
    """The paper's, or the released code's where only parts of the surface are seen."""
    return REAL3D_PAM if format == Format.REAL3D else PUBLISHED_PAM


@dataclass(frozen=True, slots=True)
class Target:
    """What PAM aligns to, and how far a point is from the normal surface.

    Attributes
    ----------
    cloud_mm
        (m, 3) points of the template.
    exact
        The normal shape; None: the planes through the cloud's points stand for it.
    """

    cloud_mm: Float[np.ndarray, "m 3"]
    exact: MeshSdf | None
    _normals: Float[np.ndarray, "m 3"]
    _spacing_mm: float

    @classmethod
    def of(cls, data: ClassInput) -> Target:
        """From the class's mesh, or from its first training cloud."""
        if data.mesh is None:
            return cls.of_cloud(data.clouds_mm[0])
        mesh = data.mesh
        cloud = sample_surface(
            np.asarray(mesh.vertices), np.asarray(mesh.faces), count=TARGET_POINTS
        )[0]
        return cls.of_cloud(cloud, MeshSdf.from_mesh(mesh))

    @classmethod
    def of_cloud(cls, cloud_mm: Float[np.ndarray, "m 3"], exact: MeshSdf | None = None) -> Target:
        """From points, and the shape that they are of where it is known."""
        spacing_mm = spacing_of(cloud_mm)
        return cls(cloud_mm, exact, planes(cloud_mm, spacing_mm).normals, spacing_mm)

    def residual(self, points_mm: Points) -> Values:
        """(n,) distance to the normal surface, mm."""
        if self.exact is not None:
            return self.exact.unsigned_distance(points_mm)
        # The distance to the nearest point alone would be half the cloud's spacing in any case.
        distance, index = cKDTree(self.cloud_mm).query(points_mm, workers=-1)
        offset = points_mm - self.cloud_mm[index]
        height = np.abs((offset * self._normals[index]).sum(axis=1))
        beside = np.sqrt(np.maximum(distance**2 - height**2, 0.0))
        return np.asarray(
            np.hypot(height, np.maximum(beside - ON_SURFACE_SPACINGS * self._spacing_mm, 0.0))
        )


def make_pam_aligner(data: ClassInput, seed: int, cache: Path) -> Aligner:
    """PAM for a class, as `BankMethod` wants it."""
    target, options = Target.of(data), pam_options(data.format)

    def place(points_mm: Points, rng: np.random.Generator) -> tuple[Points, Values]:
        matrix = pam(points_mm, target.cloud_mm, options=options, rng=rng).matrix
        placed = moved(points_mm, matrix)
        return placed, target.residual(placed)

    return place


@dataclass(frozen=True, slots=True)
class PaperModel:
    """A network and PAM."""

    template: Template
    target: Target
    options: PamOptions
    template_distance: CloudDistance | None

    def score(self, points_mm: Points, rng: np.random.Generator) -> Scores:
        """A(x) = |f(x)|; a cloud that PAM gave up on is scored in its last pose, and counted."""
        aligned = True
        try:
            matrix = pam(points_mm, self.target.cloud_mm, options=self.options, rng=rng).matrix
        except PamError as error:
            matrix, aligned = error.matrix, False
        placed = moved(points_mm, matrix)
        score = np.abs(self.template.distance(placed))
        rest = max(0, len(score) - TOP_SCORES)
        top = float(np.partition(score, rest)[rest:].mean())
        return Scores(score, top, self.target.residual(placed), aligned=aligned)


@dataclass(frozen=True, slots=True)
class PaperMethod:
    """The published system.

    Attributes
    ----------
    options
        Of the recipe.
    """

    options: PaperOptions = BENCH_PAPER

    def fit(self, data: ClassInput, *, seed: int, cache: Path) -> Model:
        """Train the network, and measure it."""
        template = class_template(data, seed, cache, recipe="paper", paper=self.options)
        distance = repair_distance(template, data, np.random.default_rng(seed))
        return PaperModel(template, Target.of(data), pam_options(data.format), distance)
