"""`pasdf`, our own method: the class's template, robust alignment, a test against sound clouds.

It stands on `template`, `align` and `regions`. A point's score is in standard errors of what sound
clouds leave there, and averages the signed deviation over neighbours before taking its size: noise
falls with the root of their number, a defect's offset does not. What a bend moved along the surface
scores by how far it was moved. The object's score is the test's p-value.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from amrepair.align import align
from amrepair.align.thinning import order_of
from amrepair.arrays import Matrix, Points, Values
from amrepair.bench.bodies import pieces_of, surface_of
from amrepair.bench.method import DIAGONAL_MM, ClassInput, Model, Scores
from amrepair.bench.metrics import CloudDistance, cloud_distance
from amrepair.bench.options import DEFAULT_HOUSE
from amrepair.bench.sound_test import SoundTest, SoundTestOptions
from amrepair.errors import AlignmentError
from amrepair.frames import diagonal, moved
from amrepair.merge import fit_from_scans
from amrepair.scans.scan import Scan
from amrepair.template import (
    GridSdf,
    MeshSdf,
    PaperSdf,
    extract_mesh,
    fit_template,
    load_template,
)
from amrepair.template.paper import PUBLISHED_NETWORK, PaperOptions
from amrepair.template.port import Template
from amrepair.template.sound import learn
from amrepair.template.surface import sample_surface

if TYPE_CHECKING:
    import trimesh

_log = logging.getLogger(__name__)


def class_template(
    data: ClassInput,
    seed: int,
    cache: Path,
    *,
    recipe: str = "fast",
    paper: PaperOptions = PUBLISHED_NETWORK,
) -> GridSdf | PaperSdf:
    """The class's template; fitted once for each seed, then read from the cache.

    A class without a normal mesh gets a template of its training clouds together.
    """
    words = "" if recipe == "fast" else hashlib.sha256(repr(paper).encode()).hexdigest()[:8]
    path = cache / f"{data.name}-{recipe}{words}-{seed}.safetensors"
    if path.is_file():
        return load_template(path)
    template: GridSdf | PaperSdf
    if data.mesh is None:
        template = _from_clouds(data, seed)
        if recipe != "fast":
            template = fit_template(template.mesh, recipe=recipe, paper=paper, seed=seed)
    else:
        template = fit_template(data.mesh, recipe=recipe, paper=paper, seed=seed)
    cache.mkdir(parents=True, exist_ok=True)
    template.save(path)
    return template


def _from_clouds(data: ClassInput, seed: int) -> GridSdf:
    scans = [
        Scan(cloud, data.sigma_mm, "scanner", source=f"{data.name}, training cloud {k}")
        for k, cloud in enumerate(data.clouds_mm)
    ]
    made = fit_from_scans(scans, seed=seed)
    template = made.template
    placed = [
        moved(cloud, pose)
        for cloud, pose in zip(data.clouds_mm, made.poses, strict=True)
        if pose is not None
    ]
    for _ in range(DEFAULT_HOUSE.learning_rounds):
        template, _ = learn(template, placed)
    return template


def _laid(
    points_mm: Points, template: Template, *, sigma_mm: float, rng: np.random.Generator
) -> list[Matrix]:
    """Poses of points in the template, the best first; a failed alignment is tried again."""
    scan = Scan(points_mm, sigma_mm, "scanner", source="sample")
    for left in reversed(range(DEFAULT_HOUSE.retries)):
        try:
            found = align(scan, template, part_is_known=True, rng=rng)
            break
        except AlignmentError as error:
            if not left:
                raise
            _log.info("alignment failed (%s); trying again", error)
    return [pose.matrix for pose in (found.template_from_scan, *found.symmetric_alternatives)]


def repair_distance(
    template: Template, data: ClassInput, rng: np.random.Generator
) -> CloudDistance | None:
    """The template's zero level against the normal shape, in units of its radius.

    References
    ----------
    PASDF, section 3.4: marching cubes, then points sampled from the mesh; eq. (7).
    """
    if data.mesh is None:
        return None
    made = extract_mesh(template, DEFAULT_HOUSE.surface_spacing_mm)
    first, second = (
        sample_surface(
            np.asarray(mesh.vertices),
            np.asarray(mesh.faces),
            count=DEFAULT_HOUSE.repair_points,
            offset=float(rng.random()),
        )[0]
        for mesh in (made, data.mesh)
    )
    radius_mm = float(np.linalg.norm(second - second.mean(axis=0), axis=1).max())
    found = cloud_distance(first / radius_mm, second / radius_mm, rng=rng)
    made.metadata["notes"] = ()  # closed as marching cubes leaves it: only distances are asked
    return replace(
        found,
        to_surface=_mean_distance(data.mesh, first) / radius_mm,
        from_surface=_mean_distance(made, second) / radius_mm,
    )


def _mean_distance(mesh: trimesh.Trimesh, points_mm: Points) -> float:
    return float(MeshSdf.from_mesh(mesh).unsigned_distance(points_mm).mean())


def smoothed_score(points_mm: Points, offset_mm: Values, sigma_mm: Values) -> Values:
    """(n,) |mean offset over near neighbours|, with some of the wider context.

    In standard deviations `sigma_mm` of what sound parts leave there.
    """
    limit_mm = DEFAULT_HOUSE.most_offset_ratio * diagonal(points_mm)
    order = order_of(points_mm)  # near points in a row are found sooner
    points = points_mm[order]
    offset = (np.clip(offset_mm, -limit_mm, limit_mm) / sigma_mm)[order]
    count = min(DEFAULT_HOUSE.near_neighbours, len(points))
    tree = cKDTree(points, balanced_tree=False)
    index = tree.query(points, k=[*range(1, count + 1)], workers=-1)[1]
    near = np.abs(offset[index].mean(axis=1))
    wide = near
    for _ in range(DEFAULT_HOUSE.wide_passes):
        wide = wide[index].mean(axis=1)
    score = np.empty(len(points))
    score[order] = near + DEFAULT_HOUSE.wide_weight * wide
    return score


@dataclass(frozen=True, slots=True)
class FieldModel:
    """A template, the test of what sound clouds leave in it, (m, 3) places of its surface."""

    template: Template
    sigma_mm: float
    sound: SoundTest
    template_distance: CloudDistance | None
    surface_mm: Float[np.ndarray, "m 3"]

    def score(self, points_mm: Points, rng: np.random.Generator) -> Scores:
        """Align, test, score; what cannot be aligned is not this part."""
        try:
            known = _laid(points_mm, self.template, sigma_mm=self.sigma_mm, rng=rng)
        except AlignmentError:
            return Scores(np.zeros(len(points_mm)), np.inf, None, aligned=False)
        placed = moved(points_mm, known[0])
        seen = self.sound.look(placed)
        followed = seen.followed(DEFAULT_HOUSE.followed_ratio * DIAGONAL_MM)
        some = points_mm[followed] if followed.mean() > DEFAULT_HOUSE.least_followed else points_mm
        pieces = pieces_of(some, self.template, known, self.sigma_mm, rng, self.surface_mm)
        if not np.array_equal(pieces.pose, known[0]):
            placed = moved(points_mm, pieces.pose)
            seen = self.sound.look(placed)
        judged = self.sound.judge(placed, seen)
        # Published clouds may have no noise at all; the unit does not matter then.
        least_mm = DEFAULT_HOUSE.least_sigma_ratio * DIAGONAL_MM
        sigma_mm = np.maximum(judged.sigma_mm, least_mm)
        score = smoothed_score(placed, judged.off_mm, sigma_mm)
        aside = pieces.moved_mm(points_mm) / max(self.sigma_mm, least_mm)
        return Scores(score + aside, -judged.log_expected, np.abs(seen.f_mm))


@dataclass(frozen=True, slots=True)
class FieldMethod:
    """The fast template with robust alignment."""

    def fit(self, data: ClassInput, *, seed: int, cache: Path) -> Model:
        """Fit the template, measure it, and test the training clouds against each other.

        Raises
        ------
        AlignmentError
            If no training cloud can be laid in the template.
        """
        template = class_template(data, seed, cache)
        distance = repair_distance(template, data, np.random.default_rng(seed))
        rng = np.random.default_rng(seed)
        laid, refused = [], None
        for cloud in data.clouds_mm:
            try:
                pose = _laid(cloud, template, sigma_mm=data.sigma_mm, rng=rng)[0]
            except AlignmentError as error:
                refused = error
            else:
                laid.append(moved(cloud, pose))
        if refused is not None and not laid:
            raise refused
        options = SoundTestOptions(template_is_known=data.mesh is not None)
        sound = SoundTest.of(template, laid, options)
        model = FieldModel(template, data.sigma_mm, sound, distance, surface_of(template))
        model.score(data.clouds_mm[0], np.random.default_rng(seed))  # compiled before it is timed
        return model
