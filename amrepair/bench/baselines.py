"""BTF and PatchCore on raw coordinates or FPFH: the baselines of PASDF's Table 3.

They follow the published code (M-3LAB/Real3D-AD) in features, radii, banks and object scores.
Differences, all in the baselines' favour or for want of a GPU: every point is scored up to 20,000
a cloud (the code scores every 500th), the coreset is exact greedy on at most 40,000 candidates,
and FPFH+Raw is scaled by training scores instead of the test set's own minimum and maximum. The
variants without `+pam` get clouds as they are; the published code has a RANSAC in PatchCore.

References
----------
Horwitz and Hoshen, Back to the Feature: Classical 3D Features are (Almost) All You Need for 3D
Anomaly Detection, CVPR workshops 2023. Roth et al., PatchCore, CVPR 2022, eqs. (6) and (7).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Numbers, Points, Values
from amrepair.bench.features import coreset, fill_in, fpfh, nearest
from amrepair.bench.method import DIAGONAL_MM, ClassInput, Model, Scores
from amrepair.bench.metrics import CloudDistance
from amrepair.errors import AlignmentError

Extractor = Callable[[Points], tuple[Float[np.ndarray, "k d"], Int[np.ndarray, " k"]]]
"""Features, and which points they are of (all, or the centres of patches)."""
Aligner = Callable[
    [Points, np.random.Generator],
    tuple[Points, Values],
]
"""Aligned points and each one's distance to the normal surface; raises AlignmentError."""

# The published code's 0.5 on Real3D-AD, whose parts have a diagonal of about 35 units.
VOXEL_MM = 0.015 * DIAGONAL_MM
MEMORY_SIZE = 10_000
CORESET_RATIO = 0.1
CANDIDATES = 40_000
QUERIES = 20_000
REWEIGHT_NEIGHBOURS = 3
# Scores of normal points that scale FPFH+Raw: this quantile over the training clouds.
SCALE_QUANTILE = 0.99


def raw_features(points_mm: Points) -> tuple[Points, Numbers]:
    """The coordinates themselves, about their mean as in the published readers."""
    return points_mm - points_mm.mean(axis=0), np.arange(len(points_mm))


def aligned_raw_features(points_mm: Points) -> tuple[Points, Numbers]:
    """The coordinates as alignment left them."""
    return points_mm, np.arange(len(points_mm))


def fpfh_features(points_mm: Points) -> tuple[Float[np.ndarray, "n 33"], Numbers]:
    """FPFH at the published radii."""
    return fpfh(points_mm, VOXEL_MM), np.arange(len(points_mm))


@dataclass(frozen=True, slots=True)
class Bank:
    """A memory of normal features, and how to ask it.

    Attributes
    ----------
    features
        (m, d) rows kept.
    scale
        Score of a rather unusual normal point: brings banks to one scale.
    """

    extract: Extractor
    features: Float[np.ndarray, "m d"]
    scale: float

    def scores(
        self, points_mm: Points, rng: np.random.Generator
    ) -> tuple[Values, Float[np.ndarray, "q d"], Float[np.ndarray, " q"]]:
        """(n,) distances to the bank at all points; features and distances where asked."""
        features, index = self.extract(points_mm)
        chosen = np.sort(rng.permutation(len(index))[:QUERIES])
        distance, _ = nearest(features[chosen], self.features)
        return fill_in(points_mm, index[chosen], distance), features[chosen], distance


def strided_bank(
    clouds: list[Float[np.ndarray, "_ 3"]], extract: Extractor, rng: np.random.Generator
) -> Bank:
    """BTF's bank: every k-th feature, about 10,000 in all."""
    features = np.concatenate([extract(cloud)[0] for cloud in clouds])
    step = max(1, len(features) // MEMORY_SIZE)
    return _scaled(extract, features[::step], features, rng)


def coreset_bank(
    clouds: list[Float[np.ndarray, "_ 3"]], extract: Extractor, rng: np.random.Generator
) -> Bank:
    """PatchCore's bank: a tenth of the features, at most 10,000, chosen greedily."""
    features = np.concatenate([extract(cloud)[0] for cloud in clouds])
    candidates = features[np.sort(rng.permutation(len(features))[:CANDIDATES])]
    count = min(MEMORY_SIZE, int(np.ceil(CORESET_RATIO * len(candidates))))
    return _scaled(extract, candidates[coreset(candidates, count, rng)], features, rng)


def _scaled(
    extract: Extractor,
    bank: Float[np.ndarray, "m d"],
    features: Float[np.ndarray, "n d"],
    rng: np.random.Generator,
) -> Bank:
    sample = features[rng.permutation(len(features))[: CANDIDATES // 4]]
    usual = float(np.quantile(nearest(sample, bank)[0], SCALE_QUANTILE))
    return Bank(extract, bank, max(usual, 1e-12))


def reweighted(
    features: Float[np.ndarray, "q d"],
    distance: Float[np.ndarray, " q"],
    bank: Float[np.ndarray, "m d"],
) -> float:
    """BTF's object score: the largest distance, less in sparse parts of the bank (eq. 7)."""
    worst = int(np.argmax(distance))
    row = int(nearest(features[worst : worst + 1], bank)[1][0])
    around = np.linalg.norm(bank - bank[row], axis=1)
    near = np.argsort(around, kind="stable")[1:REWEIGHT_NEIGHBOURS]  # but itself
    gaps = np.linalg.norm(bank[near] - features[worst], axis=1) / np.sqrt(bank.shape[1])
    own = distance[worst] / np.sqrt(bank.shape[1])
    # The softmax is shifted so that large distances do not overflow.
    top = max(float(gaps.max()), float(own))
    weight = 1.0 - np.exp(own - top) / np.exp(gaps - top).sum()
    return float(weight * distance[worst])


@dataclass(frozen=True, slots=True)
class BankModel:
    """A fitted baseline."""

    banks: tuple[Bank, ...]
    reweight: bool
    aligner: Aligner | None
    template_distance: CloudDistance | None = None

    def score(self, points_mm: Points, rng: np.random.Generator) -> Scores:
        """Align if asked, ask every bank, average."""
        residual, aligned = None, True
        if self.aligner is not None:
            try:
                points_mm, residual = self.aligner(points_mm, rng)
            except AlignmentError:
                aligned = False  # scored as it lies, and counted
        point = np.zeros(len(points_mm))
        whole = 0.0
        for bank in self.banks:
            at_points, features, distance = bank.scores(points_mm, rng)
            top = (
                reweighted(features, distance, bank.features)
                if self.reweight
                else float(distance.max())
            )
            point += at_points / bank.scale / len(self.banks)
            whole += top / bank.scale / len(self.banks)
        return Scores(point, whole, residual, aligned)


@dataclass(frozen=True, slots=True)
class BankMethod:
    """BTF or PatchCore on some features.

    Attributes
    ----------
    extractors
        One bank each.
    greedy
        PatchCore (coreset, maximum) or BTF (stride, re-weighted maximum).
    make_aligner
        Makes an aligner for a class, or None: clouds are taken as they lie.
    """

    extractors: tuple[Extractor, ...]
    greedy: bool
    make_aligner: Callable[[ClassInput, int, Path], Aligner] | None = field(default=None)

    def fit(self, data: ClassInput, *, seed: int, cache: Path) -> Model:
        """Fill the banks from the training clouds, aligned to the template if asked."""
        rng = np.random.default_rng(seed)
        clouds = list(data.clouds_mm)
        aligner = None
        if self.make_aligner is not None:
            aligner = self.make_aligner(data, seed, cache)
            clouds = [moved for cloud in clouds if (moved := _try(aligner, cloud, rng)) is not None]
            if not clouds:
                raise AlignmentError(
                    f"none of the {len(data.clouds_mm)} training clouds of {data.name} could be "
                    "aligned to its template; run the method without +pam"
                )
        fill = coreset_bank if self.greedy else strided_bank
        banks = tuple(fill(clouds, extract, rng) for extract in self.extractors)
        return BankModel(banks, not self.greedy, aligner)


def _try(aligner: Aligner, cloud: Points, rng: np.random.Generator) -> Points | None:
    try:
        return aligner(cloud, rng)[0]
    except AlignmentError:
        return None
