"""Bad scans on the command line: exit 2, one sentence that names file and reason, no file left."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.bench import shapenet
from amrepair.bench.samples import Sample
from amrepair.errors import InputError
from amrepair.scans import Scan, write_ply
from amrepair.template import MeshSdf, fit_template
from amrepair.template.options import FitOptions
from tests.commands import here

PART = Path(__file__).parents[2] / "examples" / "parts" / "bracket.stl"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rough template: what is refused here does not depend on its details."""
    path = tmp_path_factory.mktemp("template") / "bracket.safetensors"
    fit_template(PART, fast=FitOptions(cells=40, samples=20_000)).save(path)
    return path


def surface(scale: float = 1.0) -> np.ndarray:
    mesh = trimesh.load(PART, force="mesh")
    return np.asarray(trimesh.sample.sample_surface(mesh, 4_000, seed=1)[0]) * scale


def text(path: Path, points: np.ndarray) -> None:
    path.write_text("\n".join(" ".join(map(repr, row)) for row in points.tolist()))


def pcd(path: Path, points: np.ndarray, *, cut: int) -> None:
    rows = points.astype("<f4").tobytes()
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + rows[: len(rows) - cut])


def make(folder: Path, kind: str) -> Path:
    path = folder / ("cut.pcd" if kind == "corrupt" else f"{kind}.xyz")
    points = surface()
    if kind == "empty":
        path.write_bytes(b"")
    elif kind == "nan":
        points[17, 1] = np.nan
        text(path, points)
    elif kind == "one":
        text(path, points[:1])
    elif kind == "duplicates":
        text(path, np.repeat(points[:12], 200, axis=0))
    elif kind == "same":
        text(path, np.repeat(points[:1], 2_000, axis=0))
    elif kind == "metres":
        text(path, surface(1e-3))
    elif kind == "micrometres":
        text(path, surface(1e3))
    elif kind == "another":
        ball = trimesh.creation.icosphere(subdivisions=3, radius=33.0)
        text(path, np.asarray(ball.vertices))
    else:
        pcd(path, points, cut=100)
    return path


SAID = {
    "empty": "no points",
    "nan": "not finite",
    "one": "fewer points (1)",
    "duplicates": "12 different points",
    "same": "1 different points",
    "metres": "metres for millimetres",
    "micrometres": "same unit",
    "another": "does not fit",
    "corrupt": "cut.pcd",
}


CASES = [("align", kind) for kind in SAID] + [
    ("detect", kind)
    for kind in SAID
    if kind != "another"  # the same alignment a second time
]


@pytest.fixture(scope="module")
def answers(
    template: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[tuple[str, str], tuple[Path, Path, list[object]]]:
    """Scan, output and [exit code, standard output, standard error] of every case."""
    calls, files = [], []
    for command, kind in [*CASES, ("fit", "metres")]:
        folder = tmp_path_factory.mktemp(f"{command}-{kind}")
        path = make(folder, kind)
        out = folder / ("found" if command == "detect" else "out.ply")
        option = "--out" if command == "detect" else "-o"
        words = [command, path, "--template", template, option, out, "--json"]
        if command == "fit":
            out = folder / "t.safetensors"
            write_ply(Scan(surface(), 0.03, "scanner"), folder / "a.ply")
            words = ["template", "fit", folder / "a.ply", path, "-o", out]
        calls.append([str(word) for word in words])
        files.append((path, out))
    said = [here(*words) for words in calls]
    keys = [*CASES, ("fit", "metres")]
    return {
        key: (*pair, [done.returncode, done.stdout, done.stderr])
        for key, pair, done in zip(keys, files, said, strict=True)
    }


@pytest.mark.parametrize(("command", "kind"), CASES)
def test_a_bad_scan_is_refused(
    command: str, kind: str, answers: dict[tuple[str, str], tuple[Path, Path, list[object]]]
) -> None:
    path, out, (code, shown, said) = answers[command, kind]
    assert code == 2, said
    assert SAID[kind] in str(said)
    assert path.name in str(said)
    assert "Traceback" not in str(said)
    sentences = str(said).strip().splitlines()
    assert len(sentences) == 1
    assert json.loads(str(shown)) == {"error": sentences[0], "exit_code": 2}
    assert not out.is_file()
    assert not (out.is_dir() and list(out.iterdir()))


def test_templates_from_bad_scans_leave_no_file(
    answers: dict[tuple[str, str], tuple[Path, Path, list[object]]],
) -> None:
    _, out, (code, _, said) = answers["fit", "metres"]
    assert code == 2
    assert "same part in the same unit" in str(said)
    assert not out.exists()


@pytest.mark.parametrize("method", ["robust", "paper"])
def test_duplicate_points_are_counted_once(method: str) -> None:
    from amrepair.align import align
    from amrepair.errors import AlignmentError

    # regression: 12 places, each 200 times, were taken for 2,400 points
    part = MeshSdf.from_mesh(trimesh.load(PART, force="mesh"))
    points = np.repeat(surface()[:12], 200, axis=0)
    with pytest.raises(AlignmentError, match="12 different points"):
        align(Scan(points, 0.03, "scanner"), part, method=method)


def test_labels_of_the_wrong_length_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "cup0"
    (folder / "test").mkdir(parents=True)
    cloud = surface()[:500]
    pcd(folder / "test" / "cup0_bulge0.pcd", cloud, cut=0)
    far = np.column_stack([cloud[:20] + 500.0, np.ones(20)])
    truth = folder / "cup0_bulge0.txt"
    np.savetxt(truth, far, delimiter=",")
    sample = Sample(
        "cup0", "cup0_bulge0", "bulge", folder / "test" / "cup0_bulge0.pcd", truth, shapenet.load
    )
    with pytest.raises(InputError, match=r"cup0_bulge0\.txt"):
        sample.load()
