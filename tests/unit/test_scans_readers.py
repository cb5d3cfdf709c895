"""Readers: what a scanner or a peer writes comes back point by point, and damage is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.errors import InputError
from amrepair.scans import Scan, read_scan, write_ply
from gcode.surfaces import HeightField


@pytest.fixture
def scan() -> Scan:
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Scan(
        rng.uniform(0, 50, (50, 3)),
        0.03,
        "scanner",
        normals,
        np.array([[0.0, 0, 300], [100, 0, 250]]),
        rng.integers(0, 2, 50),
    )


def lzf_literals(data: bytes) -> bytes:
    """A valid LZF stream that only uses literals."""
    out = bytearray()
    for i in range(0, len(data), 32):
        piece = data[i : i + 32]
        out += bytes([len(piece) - 1]) + piece
    return bytes(out)


def pcd_header(n: int, kind: str) -> str:
    return (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {kind}\n"
    )


def test_ply_round_trip_keeps_everything(tmp_path: Path, scan: Scan) -> None:
    path = tmp_path / "a.ply"
    write_ply(scan, path, colours=np.full((50, 3), 7), scalars={"deviation": np.zeros(50)})
    back = read_scan(path, frame="scanner")
    assert np.array_equal(back.points_mm, scan.points_mm)
    assert back.normals is not None
    assert scan.normals is not None
    assert np.allclose(back.normals, scan.normals, atol=1e-6)
    assert back.sigma_mm == 0.03
    assert np.array_equal(back.sensors_mm, scan.sensors_mm)  # type: ignore[arg-type]
    assert np.array_equal(back.sensor_index, scan.sensor_index)  # type: ignore[arg-type]


def test_ply_is_read_by_a_peer(tmp_path: Path, scan: Scan) -> None:
    path = tmp_path / "a.ply"
    write_ply(scan, path)
    assert np.allclose(trimesh.load(path).vertices, scan.points_mm)


def test_ascii_ply_of_a_peer(tmp_path: Path, scan: Scan) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(trimesh.PointCloud(scan.points_mm).export(file_type="ply", encoding="ascii"))
    assert np.allclose(read_scan(path, frame="scanner").points_mm, scan.points_mm, atol=1e-5)


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd(tmp_path: Path, scan: Scan, kind: str) -> None:
    rows = scan.points_mm.astype("<f4")
    if kind == "ascii":
        body = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in rows).encode()
    elif kind == "binary":
        body = rows.tobytes()
    else:
        flat = rows.T.tobytes()
        packed = lzf_literals(flat)
        body = np.array([len(packed), len(flat)], "<u4").tobytes() + packed
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd_header(50, kind).encode() + body)
    # nine digits of text hold a float32, read back as float64
    assert np.allclose(read_scan(path, frame="scanner").points_mm, rows, rtol=1e-7)


@pytest.mark.parametrize("kind", ["binary", "binary_compressed"])
def test_pcd_of_open3d(tmp_path: Path, scan: Scan, kind: str) -> None:
    from amrepair.device import open3d

    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.repeat(scan.points_mm, 4, 0)))
    path = tmp_path / "a.pcd"
    o3d.io.write_point_cloud(str(path), cloud, compressed=kind == "binary_compressed")
    back = read_scan(path, frame="scanner").points_mm
    assert np.allclose(back, np.repeat(scan.points_mm, 4, 0), atol=1e-5)


@pytest.mark.parametrize(
    ("name", "separator", "head"),
    [
        ("a.xyz", " ", ""),
        ("a.csv", ",", "x,y,z\n"),
        ("a.txt", ";", ""),
        ("a.pts", " ", "400\n"),
    ],
)
def test_text(tmp_path: Path, scan: Scan, name: str, separator: str, head: str) -> None:
    path = tmp_path / name
    path.write_text(head + "\n".join(separator.join(map(repr, r)) for r in scan.points_mm.tolist()))
    assert np.array_equal(read_scan(path, frame="scanner").points_mm, scan.points_mm)


def test_colours_after_the_points_are_no_normals(tmp_path: Path, scan: Scan) -> None:
    """Regression: x y z red green blue, as CloudCompare writes it, was read as with normals."""
    points = scan.points_mm
    rng = np.random.default_rng(0)
    colours = rng.integers(1, 256, points.shape)
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for name, more, kept in (("rgb.asc", colours, False), ("n.asc", normals, True)):
        np.savetxt(tmp_path / name, np.column_stack([points, more]), fmt="%.4f")
        back = read_scan(tmp_path / name, frame="scanner")
        assert (back.normals is not None) == kept


def test_gltf_is_in_metres_and_y_up(tmp_path: Path) -> None:
    box = trimesh.creation.box(extents=[0.03, 0.012, 0.02])  # 20 mm deep, 12 mm high
    trimesh.Scene(box).export(tmp_path / "phone.glb")
    points = read_scan(tmp_path / "phone.glb", frame="scanner").points_mm
    assert np.ptp(points, axis=0) == pytest.approx([30.0, 20.0, 12.0], abs=0.01)
    assert points[:, 2].max() == pytest.approx(6.0, abs=0.01)


@pytest.mark.parametrize("name", ["h.npz", "h.tif"])
def test_height_map_is_seen_from_straight_above(tmp_path: Path, name: str) -> None:
    field = HeightField(
        np.array([10.0, 20.0]), 0.5, np.arange(12.0).reshape(3, 4), np.ones((3, 4), bool)
    )
    field.seen[1, 1] = False
    field.write(tmp_path / name)
    scan = read_scan(tmp_path / name, frame="build")
    assert len(scan) == 11
    assert np.allclose(scan.points_mm[0], [10.25, 20.25, 0.0])
    assert scan.sensors_mm is not None
    tilt = (scan.points_mm - scan.sensors_mm[0])[:, :2] / scan.sensors_mm[0, 2]
    assert np.abs(tilt).max() < 1e-3


def test_npy_height_map_needs_its_cell(tmp_path: Path) -> None:
    np.save(tmp_path / "h.npy", np.ones((5, 7)))
    with pytest.raises(InputError, match="cell"):
        read_scan(tmp_path / "h.npy", frame="build")
    assert len(read_scan(tmp_path / "h.npy", frame="build", cell_mm=0.5)) == 35


def test_mesh_is_sampled_on_its_surface(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=4, radius=5.0).export(tmp_path / "s.stl")
    scan = read_scan(tmp_path / "s.stl", frame="scanner")
    radius = np.linalg.norm(scan.points_mm, axis=1)
    assert np.abs(radius - 5.0).max() < 0.02  # sagitta of the facets
    assert scan.normals is not None
    assert ((scan.normals * scan.points_mm).sum(axis=1) > 4.9).all()


def test_the_users_word_on_sensors_goes_first(tmp_path: Path, scan: Scan) -> None:
    path = tmp_path / "a.xyz"
    path.write_text("\n".join(" ".join(map(repr, r)) for r in scan.points_mm.tolist()))
    told = read_scan(path, frame="scanner", sensor_at=(1.0, 2.0, 300.0), sigma_mm=0.1)
    assert told.sigma_mm == 0.1
    assert told.sensors_mm is not None
    assert told.sensors_mm.tolist() == [[1.0, 2.0, 300.0]]


BROKEN = {
    "cut.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty double x\n"
    b"property double y\nproperty double z\nend_header\nabc",
    "none.ply": b"solid nothing",
    "cut.pcd": pcd_header(9, "binary").encode() + b"123",
    "packed.pcd": pcd_header(2, "binary_compressed").encode()
    + np.array([4, 24], "<u4").tobytes()
    + b"\xff\xff\xff\xff",
    "size.pcd": pcd_header(2, "binary_compressed").encode() + b"\x01",
    "no.pcd": b"hello",
    "empty.xyz": b"",
    "words.xyz": b"a b c\nd e f\n",
    "two.csv": b"1,2\n3,4\n",
    "nan.xyz": b"1 2 3\nnan 1 2\n",
    "bad.npy": b"\x93NUMPY",
    "bad.npz": b"PK",
    "bad.stl": b"",
    "bad.glb": b"glTF\x02\x00\x00\x00\x0c\x00\x00\x00",
    "bad.off": b"OFF\n8 6",
    "bad.pts": b"3\n1 2\n",
    "bad.tif": b"II*",
    "what.doc": b"1 2 3",
}


@pytest.mark.parametrize("name", sorted(BROKEN))
def test_damage_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(BROKEN[name])
    with pytest.raises(InputError) as caught:
        read_scan(path, frame="scanner")
    assert name in str(caught.value)
    assert "\n" not in str(caught.value).strip()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_scan(tmp_path / "gone.ply", frame="scanner")


def test_several_sensors_need_to_be_told_apart(tmp_path: Path) -> None:
    # regression: the nearest sensor was taken, its rays crossed the part and called it empty
    path = tmp_path / "scan.xyz"
    path.write_text("0 0 0\n1 0 0\n0 1 0\n")
    with pytest.raises(InputError, match="which of them saw each point"):
        read_scan(path, frame="scanner", sensor_at=np.array([[0, 0, 300.0], [300.0, 0, 300.0]]))
    assert read_scan(path, frame="scanner", sensor_at=(0.0, 0.0, 300.0)).sensor_index is not None


def test_an_archive_round_trip_keeps_everything(tmp_path: Path, scan: Scan) -> None:
    """regression: normals of any length were taken as they were, and one sensor was dropped."""
    path = tmp_path / "a.npz"
    assert scan.normals is not None
    said = {"points_mm": scan.points_mm, "normals": 3.0 * scan.normals, "sigma_mm": scan.sigma_mm}
    np.savez(path, **said, sensors_mm=scan.sensors_mm, sensor_index=scan.sensor_index)
    back = read_scan(path, frame="scanner")
    assert np.array_equal(back.points_mm, scan.points_mm)
    assert back.normals == pytest.approx(scan.normals)
    assert back.sigma_mm == scan.sigma_mm
    assert np.array_equal(back.sensors_mm, scan.sensors_mm)
    assert np.array_equal(back.sensor_index, scan.sensor_index)
    np.savez(path, points=scan.points_mm, sensors_mm=scan.sensors_mm[:1])
    assert np.array_equal(read_scan(path, frame="scanner").sensor_index, np.zeros(50))


def _ply_with_sensors(path: Path, column: list[int] | None) -> Path:
    points = np.arange(9.0).reshape(3, 3).tolist()
    rows = [[*xyz, *([] if column is None else column[k : k + 1])] for k, xyz in enumerate(points)]
    head = [
        "ply", "format ascii 1.0", "comment sensor_mm 0 0 300", "comment sensor_mm 300 0 300",
        "element vertex 3", *(f"property float {axis}" for axis in "xyz"),
        *([] if column is None else ["property int sensor"]), "end_header",
    ]  # fmt: skip
    path.write_text("\n".join([*head, *(" ".join(map(str, row)) for row in rows)]) + "\n")
    return path


@pytest.mark.parametrize("column", [None, [0, 1, 2], [0, -1, 1]], ids=str)
def test_a_file_that_does_not_tell_its_sensors_apart_is_refused(
    tmp_path: Path, column: list[int] | None
) -> None:
    """regression: its points were taken to be the first sensor's, or the last's."""
    assert read_scan(_ply_with_sensors(tmp_path / "good.ply", [0, 1, 1]), frame="scanner")
    with pytest.raises(InputError, match="sensor"):
        read_scan(_ply_with_sensors(tmp_path / "a.ply", column), frame="scanner")
    xyz, sensors = np.eye(3), np.array([[0.0, 0.0, 300.0], [300.0, 0.0, 300.0]])
    told = {} if column is None else {"sensor_index": np.array(column)}
    np.savez(tmp_path / "a.npz", points_mm=xyz, sensors_mm=sensors, **told)
    with pytest.raises(InputError, match="sensor"):
        read_scan(tmp_path / "a.npz", frame="scanner")


@pytest.mark.parametrize("name", ["a.xyz", "a.ply", "a.pcd", "a.npy", "a.stl"])
def test_a_unit_is_said_where_the_file_leaves_it_open(name: str, tmp_path: Path) -> None:
    box = trimesh.creation.box((0.04, 0.03, 0.02))
    points = box.vertices.view(np.ndarray)
    path = tmp_path / name
    if path.suffix == ".stl":
        box.export(path)
    elif path.suffix == ".npy":
        np.save(path, points)
    else:
        rows = "\n".join(" ".join(f"{v:.6f}" for v in row) for row in points)
        head = {
            ".xyz": "",
            ".ply": f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\n"
            "property float y\nproperty float z\nend_header\n",
            ".pcd": "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
            f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0.5 1 0 0 0\nPOINTS {len(points)}\n"
            "DATA ascii\n",
        }
        path.write_text(head[path.suffix] + rows + "\n")
    scan = read_scan(path, frame="scanner", unit="m")
    assert np.ptp(scan.points_mm, axis=0) == pytest.approx([40.0, 30.0, 20.0], rel=1e-4)
    if path.suffix == ".pcd":  # its sensor stands in the file's unit, too
        assert scan.sensors_mm == pytest.approx(np.array([[0.0, 0.0, 500.0]]))


def test_a_unit_that_the_file_contradicts_or_nobody_knows_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\nformat ascii 1.0\ncomment unit cm\nelement vertex 1\nproperty float x\n"
        "property float y\nproperty float z\nend_header\n1 2 3\n"
    )
    assert read_scan(path, frame="scanner", unit="cm").points_mm.tolist() == [[10.0, 20.0, 30.0]]
    with pytest.raises(InputError, match=r"its unit is 'cm', of 10 mm, and one of 1000 mm"):
        read_scan(path, frame="scanner", unit="m")
    with pytest.raises(InputError, match=r"the scan's unit is 'ells'; known are mm, cm, m"):
        read_scan(path, frame="scanner", unit="ells")
    other = tmp_path / "a.step"
    other.write_text("ISO-10303-21;")
    with pytest.raises(InputError, match=r"a scan is one of .*, not '\.step'"):
        read_scan(other, frame="scanner", unit="m")
    image = tmp_path / "a.ptx"
    image.write_text("1\n1\n")
    with pytest.raises(InputError, match=r"has its unit by its format; leave the scan's unit out"):
        read_scan(image, frame="scanner", unit="m")
