"""`template fit` of scans that do not belong together: who is named, and what the template is.

Bad views are told by the names of their files; a defect of one scan stays out of the template.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from amrepair.frames import moved, rotation_from_vector
from amrepair.scans import Scan, write_ply
from amrepair.template import load_template
from tests.analytic import AnalyticTemplate, box, cylinder, difference, sample_surface, union
from tests.commands import here

pytestmark = pytest.mark.slow  # half a minute each: whole fits

SIGMA_MM, SPACING_MM = 0.03, 0.6
DENT_MM, DENT_WIDE_MM, DENT_DEEP_MM = np.array([10.0, 20.0, 8.0]), 4.0, 1.5


def lug() -> AnalyticTemplate:
    """A plate with a tower and a through hole."""
    body = union(box((0, 0, 0), (40, 25, 8)), cylinder((30, 15, 4), 6, 14))
    return difference(body, cylinder((10, 9, -1), 4, 12))


def step() -> AnalyticTemplate:
    """A stepped block with a slot, about as large."""
    body = union(box((0, 0, 0), (38, 20, 5)), box((0, 0, 0), (15, 20, 16)))
    return difference(body, box((22, -1, 2), (27, 21, 6)))


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(100 + seed)
    axis = rng.normal(size=3)
    found = np.eye(4)
    if seed:
        found[:3, :3] = rotation_from_vector(2.5 * axis / np.linalg.norm(axis))
        found[:3, 3] = 50.0 * rng.normal(size=3)
    return found


def cloud(part: AnalyticTemplate, seed: int, spacing_mm: float = SPACING_MM) -> np.ndarray:
    points = sample_surface(part.body, spacing_mm, seed=seed)[0]
    return points + np.random.default_rng(seed).normal(0.0, SIGMA_MM, points.shape)


def written(path: Path, points: np.ndarray, seed: int) -> Path:
    """A scan in a frame of its own."""
    write_ply(Scan(moved(points, pose(seed)), SIGMA_MM, "scanner"), path)
    return path


def fitted(scans: list[Path], out: Path) -> subprocess.CompletedProcess[str]:
    return here("template", "fit", *scans, "-o", out, "--json")


def test_views_of_two_parts_are_refused_with_the_groups_by_name(tmp_path: Path) -> None:
    lugs = [written(tmp_path / f"lug_{k}.ply", cloud(lug(), k), k) for k in range(2)]
    steps = [written(tmp_path / f"step_{k}.ply", cloud(step(), k), k + 2) for k in range(2)]
    mixed = [lugs[0], steps[0], lugs[1], steps[1]]
    answer = fitted(mixed, tmp_path / "t.safetensors")
    assert answer.returncode == 2
    said = " ".join(answer.stderr.split()).split("agree with each other: ")[1]
    groups = [set(each.split(", ")) for each in said.split(". Check")[0].rstrip(")").split("; ")]
    expected = [{path.name for path in some} for some in (lugs, steps)]
    found = [{Path(name.strip()).name for name in group} for group in groups]
    assert sorted(map(sorted, found)) == sorted(map(sorted, expected))
    assert not (tmp_path / "t.safetensors").exists()


def test_the_one_scan_of_another_part_is_left_out_and_named(tmp_path: Path) -> None:
    scans = [written(tmp_path / f"lug_{k}.ply", cloud(lug(), k), k) for k in range(3)]
    scans.insert(1, written(tmp_path / "other.ply", cloud(step(), 5), 5))
    answer = fitted(scans, tmp_path / "t.safetensors")
    assert answer.returncode == 0, answer.stderr
    told = json.loads(answer.stdout)["scans"]
    assert [one["pose"] is None for one in told] == [False, True, False, False]
    assert any(
        "other.ply" in note and "left out" in note for note in json.loads(answer.stdout)["notes"]
    )


def test_views_that_share_too_little_are_named(tmp_path: Path) -> None:
    """Two from above share a face; one from below and one from a side share nothing with them."""
    whole = [cloud(lug(), k, 0.5 * SPACING_MM) for k in range(4)]
    keep = [
        (whole[0][:, 2] > 4.0) & (whole[0][:, 0] < 36.0),
        (whole[1][:, 2] > 4.0) & (whole[1][:, 0] > 4.0),
        whole[2][:, 2] < 0.5,
        whole[3][:, 1] > 24.5,
    ]
    names = ["above_1", "above_2", "below", "side"]
    scans = [
        written(tmp_path / f"{name}.ply", points[which], k)
        for k, (name, points, which) in enumerate(zip(names, whole, keep, strict=True))
    ]
    answer = fitted(scans, tmp_path / "t.safetensors")
    assert answer.returncode == 2
    said = " ".join(answer.stderr.split())
    agree, hang = said.split("agree with each other: ")[1].split("; ", 1)
    assert all(f"{name}.ply" in agree for name in names[:2])
    assert all(f"{name}.ply" in hang for name in names[2:])


def test_a_defective_scan_among_sound_ones_is_named_and_does_not_enter(tmp_path: Path) -> None:
    clouds = [cloud(lug(), k) for k in range(4)]
    dent = np.linalg.norm(clouds[2] - DENT_MM, axis=1) < DENT_WIDE_MM
    clouds[2][dent & (clouds[2][:, 2] > 7.5), 2] -= DENT_DEEP_MM
    scans = [written(tmp_path / f"scan_{k}.ply", points, k) for k, points in enumerate(clouds)]
    answer = fitted(scans, tmp_path / "t.safetensors")
    assert answer.returncode == 0, answer.stderr
    told = json.loads(answer.stdout)
    outvoted = [one["outvoted_mm2"] > 0 for one in told["scans"]]
    assert outvoted == [False, False, True, False]
    assert any("scan_2.ply" in note and "outvoted" in note for note in told["notes"])
    top = cloud(lug(), 9)
    top = top[(np.linalg.norm(top - DENT_MM, axis=1) < DENT_WIDE_MM) & (top[:, 2] > 7.5)]
    template = load_template(tmp_path / "t.safetensors")
    # the template's frame is the first scan's, which was not turned
    assert np.abs(template.distance(top)).max() < 6 * SIGMA_MM
