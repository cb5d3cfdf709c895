"""`amrepair synth`: from any mesh, a data set in either published layout, with exact labels.

Normal samples have random poses, noise, uneven density, full and single views. Each defect is
made on the solid, so labels come from the construction: a point is anomalous where the surface
was moved by more than 2σ of the noise, or is new. `synth.json` keeps the true poses. It writes
files; making and looking at shapes is left to `synth_defects` and `synth_views`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amrepair.arrays import Matrix, Points, Vector
from amrepair.bench.options import DEFAULT_LABELS, DEFAULT_MAKING
from amrepair.bench.samples import Format, SampleCloud
from amrepair.bench.synth_defects import Part, Size, SynthDefect, damage, make_part
from amrepair.bench.synth_views import (
    Rays,
    SeenSurface,
    Shape,
    look,
    random_rotation,
    sample_shape,
    sensor_towards,
    sensors_around,
)
from amrepair.errors import InputError
from amrepair.frames import moved, rigid
from gcode.progress import Progress, silent

MANIFEST = "synth.json"
# A desktop structured-light scanner: 0.05 mm on a part of 100 mm.
SIGMA_RATIO = 5e-4
SINGLE_VIEW_RATIO = {Format.SHAPENET: 1 / 3, Format.REAL3D: 2 / 3}
FIRST_NUMBER = 101  # Real3D-AD names start with a running number
# Width of the smallest bulges of the data sets' own size.
USUAL_RATIO = 2 * DEFAULT_MAKING.bulge_ratio[0]
REAL3D_WORDS = {SynthDefect.CONCAVITY: "sink"}


@dataclass(frozen=True, slots=True)
class SynthOptions:
    """Sizes of a data set, by class.

    Attributes
    ----------
    train, normal, per_defect
        Training clouds; normal test samples; test samples of each of the six defects.
    points
        Points in a cloud on average (single clouds vary by ±40 %).
    sigma_ratio
        Noise, relative to the part's diagonal.
    single_view_ratio
        Share of test samples from one sensor; None: a third, or two thirds in Real3D-AD's layout.
    smallest_ratio
        Width of the smallest bulges, relative to the part's diagonal; None: none is made smaller
        than the data sets' own (8 to 16 %). Below that sizes are drawn evenly in their logarithm,
        and other defects are as much smaller.
    smooth_ratio
        Share of bulges and concavities that run out smoothly, without an edge.
    mesh
        Whether Anomaly-ShapeNet's layout gets the normal shape; without, training clouds alone.
    """

    train: int = 4
    normal: int = 6
    per_defect: int = 2
    points: int = 12_000
    sigma_ratio: float = SIGMA_RATIO
    single_view_ratio: float | None = None
    smallest_ratio: float | None = None
    smooth_ratio: float = 0.0
    mesh: bool = True

    def __post_init__(self) -> None:
        if min(self.train, self.normal, self.per_defect) < 1 or self.points < 500:
            raise InputError(
                "a data set needs at least one training cloud, one normal sample and one of each "
                f"defect, and 500 points a cloud; got {self.train}, {self.normal}, "
                f"{self.per_defect} and {self.points}"
            )
        if not 0 <= self.sigma_ratio <= 0.01:
            raise InputError(f"the noise ratio {self.sigma_ratio} is out of range 0…0.01")
        if self.single_view_ratio is not None and not 0 <= self.single_view_ratio <= 1:
            raise InputError(f"the share of single views {self.single_view_ratio} is not in 0…1")
        if self.smallest_ratio is not None and not 0.01 <= self.smallest_ratio <= USUAL_RATIO:
            raise InputError(
                f"the smallest defect {self.smallest_ratio} is out of range 0.01…{USUAL_RATIO:g} "
                "of the part's diagonal"
            )
        if not 0 <= self.smooth_ratio <= 1:
            raise InputError(f"the share of smooth defects {self.smooth_ratio} is not in 0…1")

    def size(self, rng: np.random.Generator) -> Size:
        """How large the next defect is, and whether it has an edge."""
        if self.smallest_ratio is None and self.smooth_ratio == 0:
            return Size()
        smallest = 1.0 if self.smallest_ratio is None else self.smallest_ratio / USUAL_RATIO
        return Size(float(smallest ** rng.random()), bool(rng.random() < self.smooth_ratio))


@dataclass(frozen=True, slots=True)
class _Made:
    """One cloud to write."""

    cloud: SampleCloud
    role: str  # train or test
    kind: str  # good or a defect
    index: int
    single: bool
    scan_from_template: Matrix


def synthesize(
    parts: Sequence[Path | str],
    out: Path,
    format: str = Format.SHAPENET,
    seed: int = 0,
    *,
    options: SynthOptions | None = None,
    progress: Progress = silent,
) -> Path:
    """Make a data set.

    Parameters
    ----------
    parts
        Meshes (STL, OBJ, 3MF, PLY); each becomes a class named after its file.
    out
        Folder to write to; must not hold a data set yet.
    format
        `anomaly-shapenet` or `real3d-ad`.
    seed
        Same parts, options and seed: the same files, bit for bit.

    Returns
    -------
    Path
        `out`: what `open_dataset` reads.

    Raises
    ------
    InputError
        If a part cannot be read or damaged, two share a name, or `out` is in use.
    """
    layout = _layout(format)
    chosen = options or SynthOptions()
    paths = [Path(part) for part in parts]
    names = _class_names(paths, layout)
    out = Path(out)
    if (out / MANIFEST).exists():
        raise InputError(f"{out}: a data set is here already; choose another --out")
    manifest: dict[str, object] = {}
    for i, (path, name) in enumerate(zip(paths, names, strict=True)):
        progress("synth", float(i), float(len(paths)))
        manifest[name] = _write_class(path, name, out, layout=layout, options=chosen, key=(seed, i))
    progress("synth", float(len(paths)), float(len(paths)))
    said = {
        "format": str(layout),
        "seed": seed,
        "sigma_ratio": chosen.sigma_ratio,
        "points": chosen.points,
        "classes": manifest,
    }
    (out / MANIFEST).write_text(json.dumps(said, indent=1) + "\n")
    return out


def _layout(format: str) -> Format:
    if format not in SINGLE_VIEW_RATIO:
        raise InputError(
            f"a data set is written as {' or '.join(SINGLE_VIEW_RATIO)}, not as '{format}'"
        )
    return Format(format)


def _class_names(paths: Sequence[Path], layout: Format) -> list[str]:
    if not paths:
        raise InputError("no part was given; name at least one mesh")
    names = [re.sub(r"[^a-z0-9]+", "_", path.stem.lower()).strip("_") for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"two parts have the same name ({', '.join(sorted(names))}); rename one")
    return [f"{name}0" for name in names] if layout is Format.SHAPENET else names


def _write_class(
    path: Path,
    name: str,
    out: Path,
    *,
    layout: Format,
    options: SynthOptions,
    key: tuple[int, int],
) -> dict[str, object]:
    from amrepair.template.mesh_file import load_mesh

    mesh = load_mesh(path)
    vertices = np.array(mesh.vertices, dtype=np.float64)
    faces = np.array(mesh.faces, dtype=np.int64)
    part = make_part(vertices, faces, np.random.default_rng([*key, 0]))
    if layout is Format.SHAPENET and options.mesh:
        _write_obj(out / "dataset" / "obj" / name / "train" / f"{name}_template0.obj", part.shape)
    samples: dict[str, object] = {}
    for made in _make_all(part, options, layout, key):
        stem = _write_cloud(made, name, out, layout, np.random.default_rng([*key, 4, made.index]))
        samples[f"{made.role}/{stem}"] = {
            "kind": made.kind,
            "view": "single" if made.single else "full",
            "scan_from_template": made.scan_from_template.tolist(),
        }
    return {"part": path.name, "diagonal_mm": part.diagonal_mm, "samples": samples}


def _make_all(
    part: Part, options: SynthOptions, layout: Format, key: tuple[int, int]
) -> Iterator[_Made]:
    """Training clouds, normal samples, then defects; each from a generator of its own."""
    share = options.single_view_ratio
    ratio = SINGLE_VIEW_RATIO[layout] if share is None else share
    for i in range(options.train):
        rng = np.random.default_rng([*key, 1, i])
        # The first cloud lies as the mesh does.
        yield _made(
            part, part.shape, options, rng, kind="good", index=i, role="train", at_rest=i == 0
        )
    for i in range(options.normal):
        rng = np.random.default_rng([*key, 2, i])
        single = _is_single(i, ratio)
        yield _made(part, part.shape, options, rng, kind="good", index=i, single=single)
    for k, defect in enumerate(SynthDefect):
        for i in range(options.per_defect):
            rng = np.random.default_rng([*key, 3, k, i])
            single = _is_single(k * options.per_defect + i, ratio)
            yield _defective(part, defect, options, rng, index=i, single=single)


def _is_single(index: int, ratio: float) -> bool:
    """Spread single views evenly over the samples."""
    return int((index + 1) * ratio + 1e-9) > int(index * ratio + 1e-9)


def _made(
    part: Part,
    shape: Shape,
    options: SynthOptions,
    rng: np.random.Generator,
    *,
    kind: str,
    index: int,
    role: str = "test",
    single: bool = False,
    at_rest: bool = False,
) -> _Made:
    """One view of a shape in a random pose."""
    sigma_mm = options.sigma_ratio * part.diagonal_mm
    sensors = sensor_towards(shape, _side(shape, rng)) if single else sensors_around(shape)
    surface = look(
        shape,
        Rays(shape),
        sensors_mm=sensors,
        count=int(options.points * rng.uniform(0.6, 1.4)),
        sigma_mm=sigma_mm,
        rng=rng,
    )
    pose = np.eye(4)
    if not at_rest:
        pose = rigid(random_rotation(rng), rng.uniform(-1, 1, 3) * part.diagonal_mm)
    cloud = SampleCloud(moved(surface.points_mm, pose), _labels(surface, sigma_mm))
    return _Made(cloud, role, kind, index, single, pose)


def _side(shape: Shape, rng: np.random.Generator) -> Vector:
    """A direction to look from: any for a normal part, towards the defect for a damaged one."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    points = sample_shape(shape, DEFAULT_LABELS.side_points, rng)
    changed = points.take(points.change_mm > 0)
    if len(changed.points_mm):
        outward = changed.normals.mean(axis=0)
        length = float(np.linalg.norm(outward))
        direction = outward / max(length, 1e-9) + DEFAULT_LABELS.looseness * direction
    return direction


def _labels(surface: SeenSurface, sigma_mm: float) -> np.ndarray:
    return (surface.change_mm > DEFAULT_LABELS.visible_sigmas * sigma_mm).astype(np.int64)


def _defective(
    part: Part,
    defect: SynthDefect,
    options: SynthOptions,
    rng: np.random.Generator,
    *,
    index: int,
    single: bool,
) -> _Made:
    """A defect that the view shows; another place or view is drawn until it does."""
    for attempt in range(DEFAULT_LABELS.most_views):
        size = options.size(rng)
        shape = damage(part, defect, rng, size)
        made = _made(
            part,
            shape,
            options,
            rng,
            kind=str(defect),
            index=index,
            single=single and attempt < DEFAULT_LABELS.most_single_views,
        )
        labels = made.cloud.labels
        # The share that a view must show falls with the defect's surface.
        need = max(
            DEFAULT_LABELS.least_labelled,
            DEFAULT_LABELS.least_labelled_ratio * size.scale**2 * len(labels),
        )
        if labels.sum() >= need and 1.0 - labels.mean() >= DEFAULT_LABELS.least_normal_ratio:
            return made
    raise InputError(
        f"no view of a {defect} on this part showed {DEFAULT_LABELS.least_labelled_ratio:.1%} of "
        f"its points and {DEFAULT_LABELS.least_normal_ratio:.0%} beside it in "
        f"{DEFAULT_LABELS.most_views} tries; ask for more points or leave the part out"
    )


def _write_cloud(
    made: _Made, name: str, out: Path, layout: Format, rng: np.random.Generator
) -> str:
    """Write one cloud and its truth; returns the file's stem."""
    if layout is Format.SHAPENET:
        folder = out / "dataset" / "pcd" / name
        word = "template" if made.role == "train" else made.kind
        stem = f"{name}_{'positive' if word == 'good' else word}{made.index}"
        _write_pcd_ascii(folder / made.role / f"{stem}.pcd", made.cloud.points)
        if word not in {"template", "good"}:
            order = rng.permutation(len(made.cloud.points))  # as in the published files
            shuffled = SampleCloud(made.cloud.points[order], made.cloud.labels[order])
            _write_truth(folder / "GT" / f"{stem}.txt", shuffled, ",")
        return stem
    folder = out / name
    number = FIRST_NUMBER + made.index
    if made.role == "train":
        stem = f"{number}_template"
    else:
        kinds = ["good", *SynthDefect]
        word = (
            REAL3D_WORDS.get(SynthDefect(made.kind), made.kind) if made.kind != "good" else "good"
        )
        stem = f"{number + 100 * kinds.index(made.kind)}_{word}{'_cut' if made.single else ''}"
    _write_pcd_binary(folder / made.role / f"{stem}.pcd", made.cloud.points)
    if made.role == "test" and made.kind != "good":
        _write_truth(folder / "gt" / f"{stem}.txt", made.cloud, " ")
    return stem


def _pcd_header(count: int, data: str) -> str:
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {count}\nDATA {data}\n"
    )


def _write_pcd_ascii(path: Path, points: Points) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="ascii", newline="\n") as stream:
        stream.write(_pcd_header(len(points), "ascii"))
        np.savetxt(stream, points, fmt="%.6f")


def _write_pcd_binary(path: Path, points: Points) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    head = _pcd_header(len(points), "binary").encode("ascii")
    path.write_bytes(head + points.astype("<f4").tobytes())


def _write_truth(path: Path, cloud: SampleCloud, separator: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.concatenate([cloud.points, cloud.labels[:, None]], axis=1)
    with path.open("w", encoding="ascii", newline="\n") as stream:
        np.savetxt(stream, rows, fmt="%.6f", delimiter=separator)


def _write_obj(path: Path, shape: Shape) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="ascii", newline="\n") as stream:
        np.savetxt(stream, shape.vertices_mm, fmt="v %.9g %.9g %.9g")
        np.savetxt(stream, shape.faces + 1, fmt="f %d %d %d")
