"""Both programs as people and scripts call them: exit codes, sentences, JSON, whole files."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.cli import error_calibration
from tests.commands import ROOT, here

KNOB = ROOT / "examples" / "parts" / "knob.stl"
DATA = os.environ.get("AMREPAIR_DATA")


def refused(done: subprocess.CompletedProcess[str], said: str) -> None:
    """Exit 2 with one sentence, no traceback."""
    assert done.returncode == 2, done.stderr
    assert said in done.stderr, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


def write_mesh(path: Path, mesh: trimesh.Trimesh) -> Path:
    mesh.export(path)
    return path


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bad")
    rng = np.random.default_rng(0)
    soup = trimesh.Trimesh(rng.uniform(0, 30, (300, 3)), np.arange(300).reshape(-1, 3))
    box = trimesh.creation.box((10, 10, 10))
    nan = folder / "nan.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices]
    lines[3] = "v nan 1 2"
    lines += ["f " + " ".join(str(v + 1) for v in face) for face in box.faces]
    nan.write_text("\n".join(lines))
    (folder / "empty.stl").write_bytes(b"")
    (folder / "words.stl").write_text("this is no mesh")
    return {
        "missing": folder / "nothing.stl",
        "empty": folder / "empty.stl",
        "words": folder / "words.stl",
        "soup": write_mesh(folder / "soup.stl", soup),
        "nan": nan,
        "large": write_mesh(folder / "large.stl", trimesh.creation.box((500, 20, 20))),
        "folder": folder,
    }


@pytest.mark.parametrize("kind", ["missing", "empty", "words", "soup", "nan", "large", "folder"])
def test_a_bad_part_is_refused_in_one_sentence(
    bad: dict[str, Path], kind: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    refused(here("simulate", bad[kind], "--out", out), "larger" if kind == "large" else "mesh")
    assert not out.exists()


@pytest.mark.skipif(DATA is None, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize(
    "name",
    [
        "empty.stl",
        pytest.param("soup.stl", marks=pytest.mark.slow),
        pytest.param("busted.STL", marks=pytest.mark.slow),
        pytest.param("wallhole.obj", marks=pytest.mark.slow),
    ],
)
def test_broken_meshes_from_the_wild_end_in_words(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    done = here("template", "fit", Path(str(DATA)) / "bad" / name, "-o", out)
    if done.returncode != 0:
        refused(done, "mesh")
        assert not out.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["simulate", "--printer", "toaster"], "toaster"),
        (["simulate", "--material", "cheese"], "cheese"),
        (["simulate", "--process", "no/such.toml"], "no such profile"),
        (["simulate", "--defect", "earthquake"], "earthquake"),
        (["simulate", "--defect", "void:diameter=-1"], "diameter"),
        (["simulate", "--scale", "huge"], "--scale"),
        (["repair", "x.ply", "--template", "y.stl", "-o", "z.gcode", "--scan-frame", "unknown"],
         "--part-pose"),
        (["repair", "x.ply", "--template", "y.stl", "-o", "z.gcode"], "no such file"),
        (["detect", "x.ply", "--template", "y.stl", "--out", "/proc/nowhere"], "no such file"),
        (["template", "mesh", "nothing.safetensors", "-o", "/tmp/x.stl"], "does not exist"),
    ],
)  # fmt: skip
def test_bad_usage_is_refused(words: list[str], said: str) -> None:
    refused(here(*words), said)


def test_an_output_that_cannot_be_written_is_refused_before_work_begins() -> None:
    refused(here("simulate", KNOB, "--out", "/proc/nowhere/out"), "cannot be written")


def test_an_unknown_option_is_a_usage_error() -> None:
    done = here("simulate", "--nonsense")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("program", ["amrepair", "gcode"])
def test_help_and_version(program: str) -> None:
    assert here("--help", program=program).returncode == 0
    assert "0.1.0" in here("--version", program=program).stdout


@pytest.fixture(scope="module")
def chipped(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A block on the bed with a corner gone, scanned from above and around."""
    folder = tmp_path_factory.mktemp("chipped")
    block = m3.Manifold.cube((40.0, 30.0, 12.0))
    corner = m3.Manifold.cube((8.0, 8.0, 1.2)).translate((32.0, 22.0, 10.8))
    meshes = {}
    for name, solid in (("part", block), ("broken", block - corner)):
        mesh = solid.to_mesh64()
        tri = trimesh.Trimesh(np.array(mesh.vert_properties), np.array(mesh.tri_verts))
        meshes[name] = tri
        tri.export(folder / f"{name}.stl")
    points, faces = trimesh.sample.sample_surface(meshes["broken"], 150_000, seed=1)
    normals = meshes["broken"].face_normals[faces]
    seen = normals[:, 2] > -0.5
    rng = np.random.default_rng(0)
    points = np.asarray(points)[seen] + rng.normal(size=(int(seen.sum()), 3)) * 0.03
    np.savetxt(folder / "scan.xyz", points + np.array([100.0, 80.0, 0.0]), fmt="%.4f")
    return {name: folder / name for name in ("part.stl", "broken.stl", "scan.xyz", "")}


def test_offline_repair_of_a_chipped_block(chipped: dict[str, Path], tmp_path: Path) -> None:
    out, report = tmp_path / "repair.gcode", tmp_path / "report.html"
    words = ["repair", chipped["scan.xyz"], "--template", chipped["part.stl"], "-o", out]
    standing = tmp_path / "standing.npz"
    words += ["--part-pose", "100,80,0,0", "--report", report, "--standing", standing, "--json"]
    done = here(*words)
    # 3: a strip beside the chip's cliff stays out of the nozzle's reach
    assert done.returncode in (0, 3), done.stderr
    # neither warnings of libraries nor what they think is leaked at the end; only progress
    said = [line for line in done.stderr.splitlines() if not line.endswith(" %")]
    assert said == []
    result = json.loads(done.stdout)
    assert result["missing_mm3_before"] == pytest.approx(8 * 8 * 1.2, rel=0.08)
    assert result["missing_mm3_after"] is None
    assert result["regions"][0]["reachable_ratio"] > 0.75
    text = out.read_text()
    # regression: a person whose printer is another one was told nowhere that this is a Prusa's
    assert (result["printer"], result["printer_from"]) == ("prusa_mk3s", "default")
    head = text.splitlines()[:4]
    assert head[:2] == ["; repair of scan.xyz", "; profiles: prusa_mk3s, pla, repair_0.20"]
    assert head[2] == "; the printer is the default: none was named"
    assert head[3].startswith(f"; printer: {result['printer_name']} (prusa_mk3s), bed 250 x 210 mm")
    homing = [line for line in text.splitlines() if line.startswith("G28")]
    assert homing == ["G28 X Y"]
    assert report.stat().st_size > 10_000
    # regression: nothing wrote what --as-built needs, so nobody could check or send a repair
    assert here("check", out, program="gcode").returncode == 2  # Z is not homed
    checked = here("check", out, "--as-built", standing, program="gcode")
    assert checked.returncode == 0, checked.stderr
    assert "prusa_mk3s is taken, for which it was sliced" in checked.stderr
    copy = f"file:{tmp_path / 'sent.gcode'}"
    sent = here("send", out, "--as-built", standing, "--port", copy, program="gcode")
    assert sent.returncode == 0, sent.stderr
    assert (tmp_path / "sent.gcode").read_text().rstrip() == text.rstrip()
    estimate = json.loads(here("estimate", out, "--json", program="gcode").stdout)
    assert estimate["filament_mm"] == pytest.approx(result["filament_mm"], rel=0.01)
    (x0, y0, _), (x1, y1, z1) = result["regions"][0]["box_mm"]
    assert 131 < x0 < 133.5
    assert 101 < y0 < 103.5
    assert (x1, y1, z1) == pytest.approx((140.0, 110.0, 12.0), abs=0.4)


@pytest.mark.slow
def test_a_report_that_cannot_be_written_leaves_the_repair_told(
    chipped: dict[str, Path], tmp_path: Path
) -> None:
    """regression: a temporary file was named, and nothing said of the program that was there."""
    out, report = tmp_path / "repair.gcode", tmp_path / f"{250 * 'r'}.html"
    words = ["repair", chipped["scan.xyz"], "--template", chipped["part.stl"], "-o", out]
    done = here(*words, "--part-pose", "100,80,0,0", "--report", report)
    assert done.returncode == 2
    (said,) = [line for line in done.stderr.splitlines() if line.startswith("amrepair:")]
    assert said.startswith(f"amrepair: the report cannot be written to {report}: File name too")
    assert "missing (a chip)" in done.stdout
    assert str(out) in done.stdout.replace("\n", "")
    assert [path.name for path in tmp_path.iterdir()] == ["repair.gcode"]


def test_a_repair_that_is_not_needed_leaves_no_older_program(
    chipped: dict[str, Path], tmp_path: Path
) -> None:
    # regression: `repair -o r.gcode && send r.gcode` of a whole part sent yesterday's repair
    points, faces = trimesh.sample.sample_surface(trimesh.load(chipped["part.stl"]), 80_000, seed=1)
    seen = trimesh.load(chipped["part.stl"]).face_normals[faces][:, 2] > -0.5
    whole, out = tmp_path / "whole.xyz", tmp_path / "r.gcode"
    # and 0.4 mm in the air: no raft is so thin that nobody needs to know
    np.savetxt(whole, np.asarray(points)[seen] + (100.0, 80.0, 0.4), fmt="%.4f")
    out.write_text("G28\n")
    done = here("repair", whole, "--template", chipped["part.stl"], "-o", out)
    said = " ".join(done.stdout.split())
    assert "(prusa_mk3s): the default, since no --printer is given." in said
    assert done.returncode == 0, done.stderr
    assert not out.exists()
    said = " ".join(done.stdout.split())
    assert "that was there is removed" in said
    assert "0.40 mm above the bed" in said


def test_an_aligned_scan_is_a_ply(chipped: dict[str, Path], tmp_path: Path) -> None:
    words = [chipped["scan.xyz"], "--template", chipped["part.stl"], "-o", tmp_path / "a.foo"]
    refused = here("align", *words)
    assert refused.returncode == 2
    assert ".ply" in refused.stderr
    assert not (tmp_path / "a.foo").exists()


def test_align_and_detect_write_what_the_contract_says(
    chipped: dict[str, Path], tmp_path: Path
) -> None:
    words = [chipped["scan.xyz"], "--template", chipped["part.stl"], "--json"]
    aligned = here("align", *words, "-o", tmp_path / "aligned.ply")
    assert aligned.returncode == 0, aligned.stderr
    result = json.loads(aligned.stdout)
    assert {"template_from_scan", "rmse_mm", "inlier_ratio", "symmetric_alternatives",
            "seconds"} <= set(result)  # fmt: skip
    assert np.array(result["template_from_scan"]).shape == (4, 4)
    # 0.02 mm of noise on some thousand points that determine the pose
    spread = np.sqrt(np.diag(result["covariance"]))
    assert (spread > 1e-7).all()
    assert (spread[:3] < 1e-3).all()
    assert (spread[3:] < 0.02).all()
    detected = here("detect", *words, "--out", tmp_path / "d")
    assert detected.returncode == 0, detected.stderr
    archive = np.load(tmp_path / "d" / "anomaly.npz")
    count = len(np.loadtxt(chipped["scan.xyz"]))
    assert archive["points_mm"].shape == (count, 3)
    assert {int(v) for v in np.unique(archive["label"])} <= {0, 1, 2}
    assert {int(v) for v in np.unique(archive["template_label"])} <= {0, 1, 3}
    assert (archive["label"] == 1).any()
    told = json.loads(detected.stdout)
    # regression: an ambiguous pose was told by align alone
    assert {"object_score", "threshold", "regions", "symmetric_alternatives", "inlier_ratio",
            "clutter_ratio"} <= set(told)  # fmt: skip
    assert told["regions"][0]["volume_mm3"] == pytest.approx(8 * 8 * 1.2, rel=0.05)


@pytest.mark.slow
def test_a_calibration_by_a_part_that_is_not_sound_is_doubted(
    chipped: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """regression: a scan with dents was learned from in silence, and hid such dents ever after."""
    monkeypatch.setattr(error_calibration, "users_folder", lambda: tmp_path)
    words = ["--sound", chipped["scan.xyz"], "--name", "bench", "--json"]
    made = here("calibrate", *words, "--template", chipped["part.stl"])
    assert made.returncode == 0, made.stderr
    (doubt,) = json.loads(made.stdout)["warnings"]
    assert doubt.startswith("scan.xyz shows a region that would be told as missing")
    assert "the deepest missing, by 1.2" in doubt
    assert doubt in " ".join(made.stderr.split())
    sound = here("calibrate", *words, "--template", chipped["broken.stl"])
    assert json.loads(sound.stdout)["warnings"] == []


@pytest.mark.slow
def test_a_bent_part_is_taken_when_it_is_known(chipped: dict[str, Path], tmp_path: Path) -> None:
    points = np.loadtxt(chipped["scan.xyz"])
    points[:, 2] += 0.006 * np.square(points[:, 0] - 120.0)  # both ends 2.4 mm up
    np.savetxt(tmp_path / "bent.xyz", points, fmt="%.4f")
    words = ["detect", tmp_path / "bent.xyz", "--template", chipped["part.stl"]]
    words += ["--out", tmp_path / "d", "--json"]
    refused = here(*words)
    assert refused.returncode == 2
    assert "--part-is-known" in refused.stderr
    taken = here(*words, "--part-is-known")
    assert taken.returncode == 0, taken.stderr
    assert len(json.loads(taken.stdout)["regions"]) > 2
    # regression: `repair` named the option and did not have it
    words = ["repair", *words[1:4], "-o", tmp_path / "repair.gcode"]
    refused = here(*words)
    assert refused.returncode == 2
    assert "--part-is-known" in refused.stderr
    taken = here(*words, "--part-is-known")
    assert taken.returncode in (0, 3), taken.stderr
    many = here("align", tmp_path / "bent.xyz", "--template", tmp_path, "--part-is-known")
    assert many.returncode == 2
    assert "needs one template" in many.stderr


def test_slice_check_and_estimate_work_together(chipped: dict[str, Path], tmp_path: Path) -> None:
    placed = trimesh.load(chipped["part.stl"])
    placed.apply_translation((100, 80, 0))
    placed.export(tmp_path / "placed.stl")
    job = tmp_path / "job.gcode"
    sliced = here("slice", tmp_path / "placed.stl", "-o", job, "--json", program="gcode")
    assert sliced.returncode == 0, sliced.stderr
    result = json.loads(sliced.stdout)
    assert result["beads_mm3"] == pytest.approx(40 * 30 * 12, rel=0.02)
    assert 1.24e-3 < result["filament_g"] / result["beads_mm3"] < 1.3e-3  # PLA, and the skirt
    assert here("check", job, program="gcode").returncode == 0
    broken = tmp_path / "broken.gcode"
    broken.write_text(job.read_text().replace("M109 S215", "M109 S415", 1))
    done = here("check", broken, "--json", program="gcode")
    assert done.returncode == 2
    assert json.loads(done.stdout)["refusals"][0]["limit"] == "300 °C"
    done = here("slice", chipped["broken.stl"], "-o", "/proc/x.gcode", program="gcode")
    assert done.returncode == 2


def test_a_patch_on_what_stands_there(chipped: dict[str, Path], tmp_path: Path) -> None:
    names = {}
    for name in ("broken", "part"):
        mesh = trimesh.load(chipped[f"{name}.stl"])
        mesh.apply_translation((100, 80, 0))
        names[name] = tmp_path / f"{name}.stl"
        mesh.export(names[name])
    piece = m3.Manifold.cube((8.0, 8.0, 1.2)).translate((132.0, 102.0, 10.8)).to_mesh64()
    solid = trimesh.Trimesh(np.array(piece.vert_properties), np.array(piece.tri_verts))
    solid.export(tmp_path / "piece.stl")
    out = tmp_path / "patch.gcode"
    words = ["slice", tmp_path / "piece.stl", "-o", out, "--as-built", names["broken"], "--json"]
    done = here(*words, program="gcode")
    assert done.returncode == 0, done.stderr
    # less a strip along two walls, where the nozzle's cone does not get down
    assert 0.88 * 76.8 <= json.loads(done.stdout)["beads_mm3"] <= 76.8
    done = here("check", out, "--as-built", names["broken"], program="gcode")
    assert done.returncode == 0, done.stderr
    # the same program on the part as it should be would plough through it
    assert here("check", out, "--as-built", names["part"], program="gcode").returncode == 2


def test_profiles_are_listed_and_shown() -> None:
    listed = json.loads(here("profiles", "list", "--json", program="gcode").stdout)
    assert "prusa_mk3s" in listed["printers"]
    shown = json.loads(here("profiles", "show", "standard_0.20", program="gcode").stdout)
    assert shown["infill_ratio"] == 0.15
    refused(here("profiles", "show", "nothing", program="gcode"), "is no profile")


def test_send_prints_on_an_emulated_printer(tmp_path: Path) -> None:
    from gcode.firmware import EmulatedPrinterProcess
    from gcode.profiles import load_printer

    job = tmp_path / "job.gcode"
    lines = ["G21", "G90", "M83", "M140 S60", "M104 S215", "M190 S60", "M109 S215", "G28 W"]
    lines += ["G1 Z0.3 F720", "G1 X50 Y50 F6000", "G1 X90 E3 F1000", "M104 S0", "M140 S0"]
    job.write_text("\n".join(lines) + "\n")
    with EmulatedPrinterProcess("prusa", printer=load_printer("prusa_mk3s")) as machine:
        done = here("send", job, "--port", machine.port, "--json", program="gcode")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["lines_acked"] == len(lines)
        motion = machine.take_motion()
    assert motion.filament_mm.sum() == pytest.approx(3.0)
    assert here("send", job, "--port", "/dev/nothing", program="gcode").returncode == 4


def test_the_loop_prints_a_job_and_takes_scans_from_a_folder(
    chipped: dict[str, Path], tmp_path: Path
) -> None:
    from gcode.firmware import EmulatedPrinterProcess
    from gcode.profiles import load_printer

    placed = trimesh.load(chipped["part.stl"])
    placed.apply_scale((1.0, 1.0, 0.15))
    placed.export(tmp_path / "part.stl")
    placed.apply_translation((100, 80, 0))
    placed.export(tmp_path / "placed.stl")
    job, drop, out = tmp_path / "job.gcode", tmp_path / "scans", tmp_path / "run"
    drop.mkdir()
    words = ["slice", tmp_path / "placed.stl", "--place", "keep", "-o", job]
    assert here(*words, program="gcode").returncode == 0
    stop = threading.Event()

    def scan() -> None:
        """A sensor that looks every second, whatever the printer does."""
        rng = np.random.default_rng(0)
        points, faces = trimesh.sample.sample_surface(placed, 60_000, seed=1)
        points = np.asarray(points)[placed.face_normals[faces][:, 2] > -0.5]
        k = 0
        while not stop.wait(1.0):
            k += 1
            noisy = points + rng.normal(size=points.shape) * 0.03
            np.save(tmp_path / "partial.npy", noisy)
            (tmp_path / "partial.npy").rename(drop / f"scan{k}.npy")

    eye = threading.Thread(target=scan)
    eye.start()
    try:
        with EmulatedPrinterProcess("prusa", printer=load_printer("prusa_mk3s")) as machine:
            words = ["loop", job, "--template", tmp_path / "part.stl", "--port", machine.port]
            words += ["--scanner", f"watch:{drop}", "--approve", "auto", "--out", out, "--json"]
            done = here(*words)
    finally:
        stop.set()
        eye.join()
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["iterations"] == 0  # the part is whole
    assert result["missing_mm3_after"] is not None
    assert (out / "report.html").is_file()
    assert (out / "scan-1.ply").is_file()
    again = here("replay", out, "--json")
    assert (again.returncode, json.loads(again.stdout)["same"]) == (0, True), again.stderr
    refused(here("loop", "--resume", out), "was printed to its end")
    record = out / "run.jsonl"
    record.write_text(
        record.read_text().replace(
            '"decision": {"action": "go on"', '"decision": {"action": "stop"'
        )
    )
    assert here("replay", out).returncode == 1
