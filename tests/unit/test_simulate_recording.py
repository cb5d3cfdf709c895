"""A recorded scanner: what is replayed over a scan is like what was recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from runpy import run_path

import manifold3d as m3
import numpy as np
import pytest
from scipy import ndimage

from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.scans.scanner import ScanRequest
from amrepair.simulate.parameters import ScannerModel, load_world
from amrepair.simulate.recording import Recording, edge_distance_mm, load_recording
from amrepair.simulate.scanner import ScannerPose, SimulatedScanner
from amrepair.simulate.world import World

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
noise_figures = run_path(str(BENCHMARKS / "noise_figures.py"))["noise_figures"]
MADE = run_path(str(BENCHMARKS / "recordings.py"))
ViewResiduals, record, save_recording = (
    MADE[name] for name in ("ViewResiduals", "record", "save_recording")
)
PITCH_MM = 0.5
SIDE_MM, TOP_MM = 50.0, 6.0


def field(rng: np.random.Generator, cells: int = 160) -> np.ndarray:
    """Noise that hangs together over 3 mm, some of its own for each point, patches far off."""
    smooth = ndimage.gaussian_filter(rng.normal(size=(cells, cells)), 1.5 / PITCH_MM)
    out = 0.05 * smooth / smooth.std() + rng.normal(0.0, 0.02, (cells, cells))
    seeds = rng.random((cells, cells)) < 0.0015
    far = ndimage.binary_dilation(seeds, iterations=1)
    return np.where(far, out + 0.8, out)


def recorded(residual: np.ndarray, cosine: float = 1.0, edge_mm: float = 50.0) -> Recording:
    return Recording(
        PITCH_MM,
        residual.astype(np.float32),
        np.full(residual.shape, cosine, dtype=np.float32),
        np.full(residual.shape, edge_mm, dtype=np.float32),
        np.zeros((len(residual), 3)),
        "made by a test",
    )


def block_scan(
    recording: Recording | None, seed: int = 0, sensor: tuple[float, float, float] = (30, 30, 900)
) -> np.ndarray:
    """(n, 3) what a sensor far above sees of a block, build frame."""
    world = World((60.0, 60.0))
    world.add(m3.Manifold.cube((SIDE_MM, SIDE_MM, TOP_MM)).translate((5.03, 5.03, 0)))
    here = Transform.identity("build", "scanner")
    device = SimulatedScanner(
        world,
        pose=ScannerPose(here, here),
        sensors_mm=np.array([sensor], dtype=float),
        rng=np.random.default_rng(seed),
        model=ScannerModel(sigma_mm=0.0, spacing_mm=0.35, bed_margin_mm=0.0),
        recording=recording,
    )
    return device.scan(ScanRequest("final", None, TOP_MM)).points_mm


def top_raster(points: np.ndarray, inset_mm: float) -> np.ndarray:
    """(1, ny, nx) heights above the block's top by cells of the recording's pitch."""
    low, high = 5.0 + inset_mm, 5.0 + SIDE_MM - inset_mm
    top = points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]
    at = np.floor((top[:, :2] - low) / PITCH_MM).astype(int)
    out = np.full((1, *(at.max(axis=0) + 1)), np.nan)
    out[0, at[:, 0], at[:, 1]] = top[:, 2] - TOP_MM
    return out


def test_replayed_noise_is_like_the_recorded() -> None:
    rng = np.random.default_rng(3)
    recording = recorded(np.stack([field(rng) for _ in range(4)]))
    ideal = top_raster(block_scan(None), 3.0)
    wanted = noise_figures(recording.residual_mm, PITCH_MM)
    scans = [top_raster(block_scan(recording, seed), 3.0) - ideal for seed in range(3)]
    found = noise_figures(np.concatenate(scans), PITCH_MM)
    # three scans of 44 × 44 mm have some 600 independent pieces of 3 mm: 5 % of a spread
    assert found.sigma_mm == pytest.approx(wanted.sigma_mm, rel=0.1)
    # and some 45 patches of those that are far off: their number is sure to 15 %
    assert found.over_half_ratio == pytest.approx(wanted.over_half_ratio, rel=0.4)
    assert wanted.over_half_ratio > 0.005
    for lag_mm in (1.0, 2.0, 4.0):
        assert found.correlation_at(lag_mm) == pytest.approx(
            wanted.correlation_at(lag_mm), abs=0.08
        )
    assert found.correlation_at(1.0) > 0.5 > found.correlation_at(4.0)
    assert np.abs(noise_figures(ideal, PITCH_MM).sigma_mm) < 0.005


def test_scans_of_one_seed_are_the_same_and_of_another_are_not() -> None:
    recording = recorded(field(np.random.default_rng(4))[None])
    first, again = block_scan(recording, 5), block_scan(recording, 5)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, block_scan(recording, 6)[: len(first)])


def test_edges_get_what_was_recorded_by_edges() -> None:
    residual = np.zeros((1, 120, 120))
    edge_mm = np.minimum(*np.meshgrid(*[np.arange(120.0)] * 2)) * PITCH_MM
    residual[0][edge_mm < 1.5] = 0.4
    recording = replace(recorded(residual), edge_mm=edge_mm[None].astype(np.float32))
    points = block_scan(recording)
    heights = top_raster(points, 4.0)
    assert np.nanmax(np.abs(heights)) < 0.03  # inside: nothing, but for the columns' own steps
    inward = np.minimum(points[:, :2] - 5.0, 5.0 + SIDE_MM - points[:, :2]).min(axis=1)
    rim = points[(inward > 0.1) & (inward < 0.5) & (points[:, 2] > TOP_MM - 1.0)]
    assert len(rim) > 100
    assert np.median(rim[:, 2]) - TOP_MM == pytest.approx(0.4, abs=0.03)


def test_slopes_get_what_was_recorded_on_slopes() -> None:
    square, slope = recorded(np.zeros((1, 120, 120))), recorded(np.full((1, 120, 120), 0.3), 0.5)
    both = Recording(
        PITCH_MM,
        np.concatenate([square.residual_mm, slope.residual_mm]),
        np.concatenate([square.cosine, slope.cosine]),
        np.concatenate([square.edge_mm, slope.edge_mm]),
        np.zeros((2, 3)),
        "two slopes",
    )
    ideal = top_raster(block_scan(None), 4.0)
    np.testing.assert_allclose(np.nanmedian(top_raster(block_scan(both), 4.0) - ideal), 0.0)
    # from 60° off the vertical; the bed's points lie by edges of shadows and elsewhere alike
    aslant = block_scan(both, sensor=(30.0, 30.0 - 900.0 * np.sqrt(3.0), 900.0))
    assert np.nanmedian(top_raster(aslant, 4.0)) == pytest.approx(0.3, abs=0.02)


def test_views_are_shifted_as_recorded() -> None:
    still = recorded(np.zeros((1, 120, 120)))
    shifted = replace(still, offset_mm=np.array([[0.0, 0.0, 0.12]]))  # towards the sensor
    ideal, found = top_raster(block_scan(None), 4.0), top_raster(block_scan(shifted), 4.0)
    assert np.nanmedian(found - ideal) == pytest.approx(0.12, abs=0.005)


def test_recording_of_a_view_has_its_shift_and_its_residuals() -> None:
    rng = np.random.default_rng(0)
    x, y = (grid.ravel() * 0.4 for grid in np.mgrid[:120, :100])
    normals = np.stack([-0.3 * np.sin(x / 9), -0.3 * np.cos(y / 7), np.ones(len(x))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    noise = ndimage.gaussian_filter(rng.normal(size=(120, 100)), 4.0).ravel()
    noise *= 0.05 / noise.std()
    shift = np.array([0.1, -0.05, 0.2])
    deviation = normals @ shift + noise
    deviation[:50] = np.nan  # unknown
    deviation[50:90] = 30.0  # another surface's
    points = np.stack([x, y, np.zeros(len(x))], axis=1)
    recording = record([ViewResiduals(points, normals, deviation)], source="a plane")
    assert recording.pitch_mm == pytest.approx(0.4, rel=0.01)
    np.testing.assert_allclose(recording.offset_mm[0], shift, atol=0.02)
    assert np.isfinite(recording.residual_mm).sum() == pytest.approx(len(x) - 90, rel=0.02)
    assert recording.sigma_mm == pytest.approx(0.05, rel=0.15)
    # errors smoothed over 4 cells (1.6 mm): correlation exp(−h² / (4 · 1.6²))
    told = noise_figures(recording.residual_mm, recording.pitch_mm)
    assert told.length_mm == pytest.approx(3.2, rel=0.15)


def test_edges_are_gaps_and_steps() -> None:
    x, y = (grid.ravel() * 0.5 for grid in np.mgrid[:80, :60])
    plane = np.stack([x, y], axis=1)
    depth = np.where(x < 20.0, 0.0, 15.0)  # a step in the middle
    away = edge_distance_mm(plane, depth, 1.0)
    side = np.minimum.reduce([x, 39.5 - x, y, 29.5 - y, np.abs(x - 20.0)])
    np.testing.assert_allclose(away, side, atol=1.5)  # a cell and a half
    slope = edge_distance_mm(plane, 1.5 * x, 1.0)  # 56°: no edge
    assert slope[np.argmin(np.hypot(x - 20.0, y - 15.0))] > 12.0


def test_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    recording = recorded(field(np.random.default_rng(1))[None])
    path = tmp_path / "noise.npz"
    save_recording(recording, path)
    again = load_recording(path)
    np.testing.assert_array_equal(again.residual_mm, recording.residual_mm)
    assert (again.pitch_mm, again.source) == (recording.pitch_mm, recording.source)
    told = load_world()
    name = f"recorded:{path}"
    assert told.scanner(name).sigma_mm == pytest.approx(recording.sigma_mm)
    assert told.scanner(name).oblique_views == told.scanner().oblique_views
    assert told.recording(name) is not None
    assert told.recording("laser-line") is None


def test_no_file_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.npz: the recording cannot be read"):
        load_world().scanner(f"recorded:{tmp_path / 'none.npz'}")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": np.array(9)}, "version 9, not 1"),
        ({"pitch_mm": np.array(50.0)}, "pitch_mm is 50.0, not 0.02 to 5"),
        ({"cosine": np.ones((1, 3, 3))}, "rasters are not of one shape"),
        ({"cosine": np.full((1, 40, 40), 2.0)}, "cosine is not 0 to 1"),
        ({"edge_mm": np.full((1, 40, 40), np.nan)}, "edge_mm is not a distance"),
        ({"residual_mm": np.full((1, 40, 40), np.nan)}, "residual_mm has no finite value"),
        ({"residual_mm": np.full((1, 40, 40), 40.0)}, "residual_mm goes beyond 5"),
        ({"residual_mm": np.zeros((1, 40, 40), dtype=int)}, "not floating-point"),
        ({"offset_mm": np.full((1, 3), np.inf)}, "offset_mm are not three finite numbers"),
        ({"edge_mm": None}, "lacks edge_mm"),
        ({"source": np.array([{"a": 1}], dtype=object)}, "no recording"),
    ],
)
def test_bad_file_is_one_sentence(
    tmp_path: Path, change: dict[str, np.ndarray | None], says: str
) -> None:
    good = {
        "version": np.array(1),
        "pitch_mm": np.array(0.5),
        "residual_mm": np.zeros((1, 40, 40)),
        "cosine": np.ones((1, 40, 40)),
        "edge_mm": np.ones((1, 40, 40)),
        "offset_mm": np.zeros((1, 3)),
        "source": np.array("a test"),
    }
    content = {key: value for key, value in (good | change).items() if value is not None}
    path = tmp_path / "bad.npz"
    np.savez(path, **content)
    with pytest.raises(InputError, match=says) as error:
        load_recording(path)
    assert "bad.npz" in str(error.value)
    assert "record_scanner.py" in str(error.value)


@pytest.mark.parametrize("content", [b"", b"sigma = 0.1\n", b"PK\x03\x04broken", b"\x93NUMPY\x01"])
def test_file_of_another_kind_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="is no recording of a scanner"):
        load_recording(path)


def test_damaged_file_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "damaged.npz"
    save_recording(recorded(field(np.random.default_rng(2), 60)[None]), path)
    whole = path.read_bytes()
    for at in range(100, len(whole), len(whole) // 40):
        path.write_bytes(whole[:at] + bytes(16) + whole[at + 16 :])
        load_recording.cache_clear()
        with pytest.raises(InputError, match=r"damaged\.npz"):
            load_recording(path)


def test_too_little_is_not_recorded() -> None:
    few = ViewResiduals(np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(5))
    with pytest.raises(InputError, match="a hundred points"):
        record([few], source="nothing")
