"""The generator: labels against an analytic box, poses undone, both layouts read back."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.bench.dataset import open_dataset
from amrepair.bench.synth import SynthOptions, synthesize
from amrepair.bench.synth_defects import Part, Size, SynthDefect, damage, make_part
from amrepair.bench.synth_views import Rays, look, sample_shape, sensor_towards, sensors_around
from amrepair.errors import InputError
from gcode.solids import as_manifold
from tests.draws import draws

SIZE_MM = np.array([60.0, 40.0, 20.0])
SMALL = SynthOptions(train=2, normal=2, per_defect=1, points=3000)


def box_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance to the box, negative inside: the analytic truth."""
    q = np.abs(points) - SIZE_MM / 2
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
    return outside + np.minimum(q.max(axis=1), 0.0)


@pytest.fixture(scope="module")
def box() -> Part:
    mesh = trimesh.creation.box(extents=SIZE_MM)
    return make_part(
        np.array(mesh.vertices, float),
        np.array(mesh.faces, dtype=np.int64),
        np.random.default_rng(0),
    )


@pytest.fixture(scope="module")
def box_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("parts") / "Hole-Template box.stl"  # words that readers look for
    trimesh.creation.box(extents=SIZE_MM).export(path)
    return path


@pytest.mark.parametrize("defect", list(SynthDefect))
@pytest.mark.parametrize("seed", [0, 1])
def test_only_what_the_defect_moved_leaves_the_box(
    box: Part, defect: SynthDefect, seed: int
) -> None:
    shape = damage(box, defect, np.random.default_rng(seed))
    solid = as_manifold(np.array(shape.vertices_mm), shape.faces)
    assert str(solid.status()) == "Error.NoError"
    points = sample_shape(shape, 40_000, np.random.default_rng(seed))
    off_mm = box_distance(points.points_mm)
    same = points.change_mm == 0
    assert same.any()
    # Embree-free and double precision: what is labelled normal lies on the box
    assert np.abs(off_mm[same]).max() < 1e-6
    moved = off_mm[~same]
    if defect is SynthDefect.BULGE:
        assert moved.min() > -1e-6
        assert solid.volume() > SIZE_MM.prod()
    elif defect is SynthDefect.BEND:
        # a point moved by d is at most d from where the box was
        assert (np.abs(moved) <= points.change_mm[~same] + 1e-6).all()
        assert np.abs(moved).max() > 0.5
    else:
        assert moved.max() < 1e-6
        assert solid.volume() < SIZE_MM.prod()
    if defect is SynthDefect.BREAK:
        assert 0.85 < solid.volume() / SIZE_MM.prod() < 0.98
    assert 0.0005 < (~same).mean() < 0.6


def test_single_view_sees_what_faces_the_sensor(box: Part) -> None:
    rays = Rays(box.shape)
    surface = look(
        box.shape,
        rays,
        sensors_mm=sensor_towards(box.shape, np.array([0.0, 0.0, 1.0])),
        count=2000,
        sigma_mm=0.0,
        rng=np.random.default_rng(0),
    )
    # from straight above at four diagonals only the top is nearer than 80° of incidence
    assert np.allclose(surface.points_mm[:, 2], SIZE_MM[2] / 2)
    around = look(
        box.shape,
        rays,
        sensors_mm=sensors_around(box.shape),
        count=3000,
        sigma_mm=0.0,
        rng=np.random.default_rng(0),
    )
    sides = np.isclose(np.abs(around.points_mm), SIZE_MM / 2)
    assert (sides.sum(axis=0) > 200).all()


def test_noise_and_density_are_as_asked(box: Part) -> None:
    rays = Rays(box.shape)
    sigma_mm = 0.05
    surface = look(
        box.shape,
        rays,
        sensors_mm=sensors_around(box.shape),
        count=20_000,
        sigma_mm=sigma_mm,
        rng=np.random.default_rng(3),
    )
    inner = (np.abs(surface.points_mm) < SIZE_MM / 2 - 1).sum(axis=1) == 2  # away from edges
    measured = box_distance(surface.points_mm[inner]).std()
    assert measured == pytest.approx(sigma_mm, rel=0.03)  # 3σ of a deviation from 15,000 values
    counts = np.histogram(surface.points_mm[:, 0], bins=4)[0]
    assert len(surface.points_mm) == 20_000
    assert counts.max() < 5 * counts.min()  # uneven, within the stated e^1.5


@pytest.mark.parametrize("layout", draws(["anomaly-shapenet", "real3d-ad"], "anomaly-shapenet"))
def test_a_data_set_reads_back_with_poses_undone(
    box_file: Path, tmp_path: Path, layout: str
) -> None:
    synthesize([box_file], tmp_path / "set", layout, 5, options=SMALL)
    (found,) = open_dataset(tmp_path / "set", layout).classes
    said = json.loads((tmp_path / "set" / "synth.json").read_text())
    samples = said["classes"][found.name]["samples"]
    assert (len(found.train), len(found.test)) == (2, 2 + 6)
    kinds = sorted(sample.kind for sample in found.test)
    hollow = "concavity" if layout == "anomaly-shapenet" else "sink"
    assert kinds == sorted(["good", "good", "bulge", hollow, "hole", "break", "bend", "crack"])
    assert (found.mesh is not None) == (layout == "anomaly-shapenet")
    views = {samples[f"test/{sample.name}"]["view"] for sample in found.test}
    assert views == {"single", "full"}
    sigma_mm = said["sigma_ratio"] * said["classes"][found.name]["diagonal_mm"]
    turns = []
    for sample in found.test:
        cloud = sample.load()
        pose = np.array(samples[f"test/{sample.name}"]["scan_from_template"])
        turns.append(pose[:3, :3])
        at_home = (cloud.points - pose[:3, 3]) @ pose[:3, :3]
        off_mm = np.abs(box_distance(at_home))
        normal = cloud.labels == 0
        # moved by up to 2σ unlabelled, plus five σ of noise in each of three directions
        assert off_mm[normal].max() < (2 + 5 * np.sqrt(3)) * sigma_mm
        assert sample.anomalous == bool(cloud.labels.any())
        if sample.anomalous:
            assert off_mm[~normal].max() > 5 * sigma_mm
    assert np.linalg.matrix_rank(np.stack(turns).reshape(len(turns), 9)) > 5  # random turns


@pytest.mark.parametrize("defect", [SynthDefect.BULGE, SynthDefect.CONCAVITY])
def test_a_smooth_defect_has_no_edge(box: Part, defect: SynthDefect) -> None:
    shape = damage(box, defect, np.random.default_rng(3), Size(smooth=True))
    points = sample_shape(shape, 40_000, np.random.default_rng(3))
    off_mm = np.abs(box_distance(points.points_mm))
    same = points.change_mm == 0
    assert off_mm[same].max() < 1e-6
    # moved along one normal: by no more than is said, and where the box is flat by just that
    assert (off_mm[~same] <= points.change_mm[~same] + 1e-6).all()
    assert off_mm.max() > 0.5
    # a bump with an edge has none of its points near 0; this one runs out
    assert (points.change_mm[~same] < 0.1 * points.change_mm.max()).mean() > 0.1


@pytest.mark.parametrize("defect", [d for d in SynthDefect if d is not SynthDefect.BEND])
def test_smaller_defects_change_less_of_the_surface(box: Part, defect: SynthDefect) -> None:
    shares = []
    for scale in (1.0, 0.4):
        shape = damage(box, defect, np.random.default_rng(2), Size(scale))
        points = sample_shape(shape, 40_000, np.random.default_rng(2))
        shares.append(float((points.change_mm > 0).mean()))
    # a surface goes with the square of its width; depths are bounded by the material, so not quite
    assert 0 < shares[1] < 0.5 * shares[0]


def test_sizes_are_drawn_between_the_smallest_and_the_usual() -> None:
    rng = np.random.default_rng(0)
    drawn = [SynthOptions(smallest_ratio=0.01, smooth_ratio=0.5).size(rng) for _ in range(2000)]
    scales = np.log([size.scale for size in drawn])
    assert scales.min() > np.log(0.125)
    assert scales.max() < 0
    assert abs(scales.mean() - np.log(0.125) / 2) < 0.05  # even in the logarithm, sd 0.6 / √2000
    assert 0.45 < np.mean([size.smooth for size in drawn]) < 0.55
    assert SynthOptions().size(rng) == Size()


@pytest.mark.slow
def test_same_seed_same_bytes(box_file: Path, tmp_path: Path) -> None:
    def digest(folder: Path) -> dict[str, str]:
        return {
            str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }

    options = SynthOptions(train=1, normal=1, per_defect=1, points=1500)
    sets = [
        digest(synthesize([box_file], tmp_path / name, "real3d-ad", seed, options=options))
        for name, seed in (("a", 1), ("b", 1), ("c", 2))
    ]
    assert sets[0] == sets[1]
    assert all(sets[0][name] != sets[2][name] for name in sets[0] if name in sets[2])


def test_what_cannot_be_made_is_refused(box_file: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no part was given"):
        synthesize([], tmp_path / "x")
    with pytest.raises(InputError, match="same name"):
        synthesize([box_file, box_file], tmp_path / "x")
    with pytest.raises(InputError, match="not as 'csv'"):
        synthesize([box_file], tmp_path / "x", "csv")
    with pytest.raises(InputError, match="does not exist"):
        synthesize([tmp_path / "absent.stl"], tmp_path / "x")
    with pytest.raises(InputError, match="at least one"):
        SynthOptions(normal=0)
    with pytest.raises(InputError, match=r"out of range 0\.01…0\.08"):
        SynthOptions(smallest_ratio=0.005)
    with pytest.raises(InputError, match="not in 0…1"):
        SynthOptions(smooth_ratio=2.0)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "synth.json").write_text("{}")
    with pytest.raises(InputError, match="already"):
        synthesize([box_file], tmp_path / "used")
