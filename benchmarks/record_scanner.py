"""A recording of a real scanner's noise for `amrepair simulate --scanner recorded:FILE`.

    AMREPAIR_DATA=… python benchmarks/record_scanner.py -o out/bunny.npz
    python benchmarks/record_scanner.py --folder DIR --conf DIR/x.conf -o out/x.npz

The surface is that of all views together (`real_scans`). Where fewer than two other views saw it,
it is the view's own and says nothing of its errors: that is left out, and so is what the surface
does not follow. Prints what the residuals are like beside what a replay of them is like: as many
points at the same places, at random pieces. Nothing of the data is kept in the repository.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
from noise_figures import NoiseFigures, noise_figures
from real_scans import Placed, Surface, closed_surface, read_views, unfollowed
from recordings import ViewResiduals, record, save_recording
from scipy.spatial import cKDTree

from amrepair.simulate.recording import Recording
from amrepair.simulate.replay import Replay

OTHERS, NEAR_MM = 2, 1.0
LAGS_MM = (1.0, 2.0, 5.0, 10.0)


def residuals(views: list[Placed]) -> list[ViewResiduals]:
    """Each view's deviations from the surface of all."""
    surface = Surface(closed_surface(views))
    deviations = [surface.deviation_mm(view.points_mm) for view in views]
    points = np.vstack([view.points_mm for view in views])
    off = unfollowed(points, np.concatenate(deviations))
    off_by_view = np.split(off, np.cumsum([len(d) for d in deviations])[:-1])
    trees = [cKDTree(view.points_mm) for view in views]
    found = []
    for k, view in enumerate(views):
        others = np.zeros(len(view.points_mm), dtype=int)
        for j, tree in enumerate(trees):
            if j != k:
                away, _ = tree.query(view.points_mm, distance_upper_bound=NEAR_MM)
                others += np.isfinite(away)
        known = (others >= OTHERS) & ~off_by_view[k]
        normals = surface.normals(view.points_mm) @ view.pose[:3, :3]  # as the view has them
        deviation = np.where(known, deviations[k], np.nan)
        found.append(ViewResiduals(view.image.points_mm, normals, deviation))
    return found


def replayed(recording: Recording, seed: int = 0) -> NoiseFigures:
    """What a replay of a recording at its own places is like."""
    rng, replay = np.random.default_rng(seed), Replay(recording)
    out = np.full(recording.residual_mm.shape, np.nan)
    for k, residual in enumerate(recording.residual_mm):
        row, column = np.nonzero(np.isfinite(residual))
        plane = np.stack([column, row], axis=1) * recording.pitch_mm
        cosine, edge = recording.cosine[k][row, column], recording.edge_mm[k][row, column]
        out[k, row, column] = replay.residual_mm(plane, cosine, edge, rng)
    return noise_figures(out, recording.pitch_mm)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--folder", type=Path, help="range images (default: the bunny's)")
    parser.add_argument("--conf", type=Path, help="their poses")
    parser.add_argument("--unit-mm", type=float, default=1000.0, help="of the files: metres")
    args = parser.parse_args()
    folder, conf = args.folder, args.conf
    if folder is None:
        if not os.environ.get("AMREPAIR_DATA"):
            print("skipped: set AMREPAIR_DATA, or name range images with --folder and --conf")
            return
        folder = Path(os.environ["AMREPAIR_DATA"]) / "real" / "bunny"
        conf = folder / "bun.conf"
    if conf is None:
        parser.error("--folder needs --conf")
    views = read_views(folder, conf, args.unit_mm)
    recording = record(residuals(views), source=f"{conf.stem}, {len(views)} views")
    args.output.parent.mkdir(parents=True, exist_ok=True)
    save_recording(recording, args.output)
    real = noise_figures(recording.residual_mm, recording.pitch_mm)
    size = args.output.stat().st_size / 1e6
    known = np.isfinite(recording.residual_mm).sum()
    shifts = np.linalg.norm(recording.offset_mm, axis=1)
    print(
        f"{args.output}: {size:.1f} MB, {known:,} points in {len(recording.offset_mm)} views, "
        f"{recording.pitch_mm:.2f} mm apart; views shifted by {np.median(shifts):.3f} mm in the "
        f"median, {shifts.max():.3f} at most\n"
    )
    names = " | ".join(f"at {lag:g} mm" for lag in LAGS_MM)
    print(f"| residuals | sigma (MAD), mm | over 0.5 mm | correlation {names} | falls to 1/e, mm |")
    print("|---|" + "---|" * (len(LAGS_MM) + 3))
    for name, told in (("recorded", real), ("replayed", replayed(recording))):
        row = " | ".join(f"{told.correlation_at(lag):.2f}" for lag in LAGS_MM)
        print(
            f"| {name} | {told.sigma_mm:.4f} | {told.over_half_ratio:.2%} | {row} "
            f"| {told.length_mm:.2f} |"
        )


if __name__ == "__main__":
    main()
