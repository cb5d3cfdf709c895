"""What stands on the bed, as a scan shows it, against a job: first contact, picture, print-onto."""

from __future__ import annotations

import json
import struct
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from gcode import clouds
from gcode.check import find_refusals
from gcode.cli.app import app
from gcode.cli.options import standing_on_bed
from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import job_for
from gcode.resumption import print_onto
from gcode.slicing.job import slice_part
from gcode.surfaces import HeightField, scanned
from gcode.writer import write

SETUP = load_setup("prusa_mk3s", "pla", "standard_0.20")
NO_SKIRT = load_setup("prusa_mk3s", "pla", "standard_0.20")
SIDE_MM, TOP_MM = 12.0, 6.0
PART = m3.Manifold.cube((30.0, 30.0, TOP_MM)).translate((100.0, 90.0, 0.0))


def sampled(step_mm: float = 0.15) -> np.ndarray:
    """The bed and the part as a camera above sees them: tops alone."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.arange(80.0, 150.0, step_mm)] * 2))
    on_part = (x > 100) & (x < 130) & (y > 90) & (y < 120)
    return np.column_stack([x, y, np.where(on_part, TOP_MM, 0.0)])


POINTS = sampled()


def ply(points: np.ndarray, form: str) -> bytes:
    kind = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    head = f"ply\nformat {form} 1.0\nelement vertex {len(points)}\nproperty float x\n"
    head += "property float y\nproperty float z\nproperty uchar red\nend_header\n"
    if not kind:
        rows = "".join(f"{x:.4f} {y:.4f} {z:.4f} 7\n" for x, y, z in points)
        return (head + rows).encode()
    table = np.zeros(len(points), [(k, f"{kind}f4") for k in "xyz"] + [("red", "u1")])
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    return head.encode() + table.tobytes()


def pcd(points: np.ndarray, form: str) -> bytes:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z n\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 2\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA {form}\n"
    if form == "ascii":
        return (head + "".join(f"{x:.4f} {y:.4f} {z:.4f} 1 2\n" for x, y, z in points)).encode()
    rows = b"".join(struct.pack("<fffII", *point, 1, 2) for point in points)
    return head.encode() + rows


FORMS = {
    "a.ply": lambda p: ply(p, "ascii"),
    "b.ply": lambda p: ply(p, "binary_little_endian"),
    "c.ply": lambda p: ply(p, "binary_big_endian"),
    "a.pcd": lambda p: pcd(p, "ascii"),
    "b.pcd": lambda p: pcd(p, "binary"),
    "a.xyz": lambda p: "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in p).encode(),
    "a.csv": lambda p: b"x,y,z\n" + "".join(f"{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in p).encode(),
}


@pytest.mark.parametrize("name", FORMS)
def test_clouds_are_read_as_they_are(tmp_path: Path, name: str) -> None:
    few = POINTS[::97]
    path = tmp_path / name
    path.write_bytes(FORMS[name](few))
    assert clouds.read_points(path) == pytest.approx(few, abs=1e-4)


def test_points_that_are_no_places_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """They count as not seen, and whoever checks a job against them is to know."""
    few = POINTS[::97].copy()
    few[3:5, 2] = np.nan
    path = tmp_path / "a.pcd"
    path.write_bytes(FORMS["b.pcd"](few))
    assert len(clouds.read_points(path)) == len(few) - 2
    assert f"a.pcd: 2 of {len(few)} points are not finite numbers" in caplog.text


@pytest.mark.parametrize("name", ["a.ply", "b.ply", "c.ply", "a.pcd", "b.pcd"])
def test_a_cut_cloud_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    data = FORMS[name](POINTS[:500])
    path.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(InputError, match=r"a\.|b\.|c\."):
        clouds.read_points(path)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.ply", b"solid", "not a PLY file"),
        ("a.pcd", b"VERSION 0.7\n", "no DATA line"),
        ("a.xyz", b"1 2\n3 4\n", "three numbers"),
        ("a.pcd", pcd(POINTS[:200], "binary").replace(b"COUNT 1 1 1 2", b"COUNT 1 1 1 99999999"),
         "the file holds 0"),
        ("a.ply", ply(POINTS[:200], "ascii").replace(b"vertex 200", b"vertex 99999999999"),
         "99999999999 of vertex"),
        ("a.xyz", b"1 2 3\n", "are the least"),
    ],
)  # fmt: skip
def test_files_that_promise_too_much_or_hold_too_little(
    tmp_path: Path, name: str, data: bytes, said: str
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=said):
        clouds.read_points(path)


def test_a_hole_in_a_scan_is_as_high_as_its_rim() -> None:
    x, y, _ = POINTS.T
    hole = (x > 110) & (x < 113) & (y > 100) & (y < 103)  # within the part's top
    shadow = (x > 99) & (x < 101) & (y > 95) & (y < 110)  # over its edge
    field = scanned.from_points(POINTS[~(hole | shadow)], 0.2, what="scan")
    at = field.sample(np.array([[111.5, 101.5], [100.0, 100.0], [90.0, 100.0], [115.0, 95.0]]))
    assert at == pytest.approx([TOP_MM, TOP_MM, 0.0, TOP_MM], abs=1e-9)
    seen = field.seen[tuple(field.cells_of(np.array([[111.5, 101.5]]))[0])]
    assert not seen


def test_a_scan_of_another_frame_is_refused() -> None:
    with pytest.raises(InputError, match="below the bed"):
        scanned.from_points(POINTS - [0.0, 0.0, 300.0], 0.2, what="scan.ply")


def test_a_scan_in_metres_is_refused() -> None:
    """As a real one was, which would have stood there as a speck that nothing touches."""
    with pytest.raises(InputError, match=r"spreads over 0\.0699 × 0\.0699 mm.*is it in metres"):
        scanned.from_points(POINTS / 1000.0, 0.2, what="the scan")


def test_an_arc_that_hits_is_told_once() -> None:
    field = scanned.from_points(POINTS, 0.2, what="the scan")
    lines = ["G21", "G90", "M83", "G1 Z20 F600", "G28 X Y", "G1 X90 Y105 F6000", "G1 Z1 F600"]
    arc = "G2 X140 Y105 I25 J0 F1200"
    program = Program("\n".join([*lines, arc]) + "\n", SETUP.printer.dialect)
    hits = [r for r in find_refusals(program, SETUP, as_built=field) if r.text.startswith("G2")]
    assert len(hits) == 1
    assert "hits what stands there" in hits[0].what


def test_a_scanners_open_mesh_stands_there(tmp_path: Path) -> None:
    vertices = np.array([[100, 90, 6], [130, 90, 6], [130, 120, 6], [100, 120, 6.0]])
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.export(tmp_path / "top.ply")
    field = standing_on_bed(tmp_path / "top.ply")
    assert field.sample(np.array([[115.0, 105.0], [90.0, 90.0]])) == pytest.approx([6.0, 0.0])


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box that is printed where the part stands."""
    box = m3.Manifold.cube((SIDE_MM, SIDE_MM, 1.2)).translate((109.0, 99.0, 0.0))
    path = tmp_path_factory.mktemp("job") / "job.gcode"
    path.write_text(write(slice_part(box, SETUP), SETUP, title="box").text)
    return path


def test_the_first_contact_is_one_sentence_with_place_and_layer(job: Path, tmp_path: Path) -> None:
    scan, picture = tmp_path / "scan.ply", tmp_path / "contact.svg"
    scan.write_bytes(ply(POINTS, "binary_little_endian"))
    words = ["check", str(job), "--as-built", str(scan), "--printer", "prusa_mk3s"]
    done = CliRunner().invoke(app, [*words, "--picture", str(picture)])
    assert done.exit_code == 2
    first = done.stderr.splitlines()[0]
    assert first.startswith("First contact: ")
    told = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)["contact"]
    x, y, z = told["place_mm"]
    # the head reaches 40 mm to the front, so it touches before the nozzle is over the part
    assert 95.0 - 40.0 < x < 135.0 + 40.0
    assert z < TOP_MM
    assert told["words"] in first
    assert "layer " in first or f"line {told['line']}" in first
    drawn = ET.fromstring(picture.read_text())
    (circle,) = (e for e in drawn.iter() if e.tag.endswith("circle"))
    assert float(circle.attrib["cx"]) == pytest.approx(x, abs=0.01)
    assert float(circle.attrib["cy"]) == pytest.approx(210.0 - y, abs=0.01)
    assert "data:image/png;base64" in picture.read_text()


def test_the_place_of_a_contact_is_where_it_is() -> None:
    """A nozzle 5.7 mm up, along Y = 105, meets a wall of 6 mm whose face is at X 100."""
    wall = m3.Manifold.cube((1.0, 100.0, 6.0)).translate((100.0, 60.0, 0.0))
    field = HeightField.from_manifold(wall, 0.1, margin_mm=60.0)
    lines = ["G28 X Y", "G90", "G1 Z20 F600", "G1 X30 Y105 F6000", "G1 Z5.7 F600", "G1 X150"]
    from gcode.check import judge

    verdict = judge(Program("\n".join(lines) + "\n", "prusa"), SETUP, as_built=field)
    assert verdict.contact is not None
    flat_mm = next(part.reach_mm for part in SETUP.printer.envelope if part.is_tip)
    assert verdict.contact.line == 6
    # found in 200 steps of 0.6 mm, in cells of 0.1 mm
    assert verdict.contact.place_mm[0] == pytest.approx(100.0 - flat_mm, abs=0.7)
    assert verdict.contact.place_mm[1:] == pytest.approx((105.0, 5.7))


@cache
def plain_job() -> str:
    """Without a skirt."""
    box = m3.Manifold.cube((SIDE_MM, SIDE_MM, 1.2)).translate((109.0, 99.0, 0.0))
    process = NO_SKIRT.process.model_copy(update={"skirt_loops": 0})
    setup = replace(NO_SKIRT, process=process)
    return write(slice_part(box, setup), setup, title="box").text


def test_a_job_is_raised_onto_what_stands_there() -> None:
    field = scanned.from_points(POINTS, 0.2, what="scan")
    made = print_onto(Program(plain_job(), "prusa"), SETUP, field, title="box")
    assert made.raised_mm == pytest.approx(TOP_MM)
    before = job_for(plain_job(), SETUP.printer).beads
    after = job_for(made.checked.program.text, SETUP.printer).beads
    of_job = after.start_mm[:, 2] > TOP_MM + 0.01  # what primes lies on the bed
    own = before.layer >= 0
    # the same beads, TOP_MM higher: place by place
    raised = before.end_mm[own][-int(of_job.sum()) :] + np.array([0.0, 0.0, TOP_MM])
    assert after.end_mm[of_job] == pytest.approx(raised, abs=2e-3)
    assert of_job.sum() == own.sum()
    text = made.checked.program.text
    assert "G28 X Y" in text
    assert "\nG28\n" not in text
    assert find_refusals(made.checked.program, SETUP, as_built=field) == ()


def test_homing_x_at_a_jobs_end_changes_no_height() -> None:
    """regression: PrusaSlicer's own default job ends so, and could be raised onto nothing."""
    field = scanned.from_points(POINTS, 0.2, what="scan")
    ends = "G28 X0  ; home X axis\nM84\n"
    made = print_onto(Program(plain_job() + ends, "prusa"), SETUP, field)
    assert "\nG28 X0  ; home X axis\nM84\n" in made.checked.program.text
    for homes_z in ("G28", "G28 Z", "G28 X Z0", "G28 W"):
        with pytest.raises(InputError, match="changes what a height means"):
            print_onto(Program(f"{plain_job()}{homes_z}\n", "prusa"), SETUP, field)


def test_a_skirt_would_hang_in_the_air(job: Path) -> None:
    small = m3.Manifold.cube((14.0, 14.0, 6.0)).translate((108.0, 98.0, 0.0))
    field = HeightField.from_manifold(small, 0.2, margin_mm=30.0)
    with pytest.raises(InputError, match="would hang in the air"):
        print_onto(Program(job.read_text(), "prusa"), SETUP, field)


def test_nothing_stands_under_the_job() -> None:
    field = HeightField.flat((250.0, 210.0), 1.0)
    with pytest.raises(InputError, match="Nothing stands under"):
        print_onto(Program(plain_job(), "prusa"), SETUP, field)


def test_the_command_writes_a_job_that_passes_with_the_part(tmp_path: Path) -> None:
    mesh = PART.to_mesh64()
    part, job, out = tmp_path / "part.stl", tmp_path / "box.gcode", tmp_path / "onto.gcode"
    vertices = np.array(mesh.vert_properties)[:, :3]
    trimesh.Trimesh(vertices, np.array(mesh.tri_verts).astype(int), process=False).export(part)
    job.write_text(plain_job())
    done = CliRunner().invoke(
        app, ["print-onto", str(part), str(job), "-o", str(out), "--printer", "prusa_mk3s"]
    )
    assert done.exit_code == 0, done.output
    assert "raised by 6 mm" in done.stdout
    words = ["check", str(out), "--as-built", str(part), "--printer", "prusa_mk3s"]
    assert CliRunner().invoke(app, words).exit_code == 0
