"""Recordings of real scanners: from placed views to rasters that `amrepair simulate` replays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from amrepair.errors import InputError
from amrepair.observe.robust import MAD_TO_SIGMA
from amrepair.simulate.options import DEFAULT_RECORDING
from amrepair.simulate.recording import (
    PITCH_MM,
    RECORDING_VERSION,
    Recording,
    edge_distance_mm,
)

CLIP_SIGMAS = 3.0  # of a view's deviations: others are another surface's


@dataclass(frozen=True, slots=True)
class ViewResiduals:
    """A placed view and what it says of a surface that is known.

    Attributes
    ----------
    points_mm
        (n, 3), view frame: Z towards the sensor.
    normals
        (n, 3) of the surface, view frame, outward.
    deviation_mm
        (n,) signed distance to the surface, positive outside; NaN where it is not known.
    """

    points_mm: np.ndarray
    normals: np.ndarray
    deviation_mm: np.ndarray


def record(views: Sequence[ViewResiduals], *, source: str) -> Recording:
    """Rasters of placed views; a cell is as wide as neighbours are apart in the image planes.

    Parameters
    ----------
    source
        What was scanned, in words.

    Raises
    ------
    InputError
        If no view says anything, or the points lie too dense or too far apart.
    """
    views = [view for view in views if np.isfinite(view.deviation_mm).sum() > 100]
    if not views:
        raise InputError(
            "no view has a hundred points with a known deviation; nothing is recorded from so "
            "little: place more views, on a surface that they follow"
        )
    pitch = float(np.median([_spacing_mm(view.points_mm[:, :2]) for view in views]))
    if not PITCH_MM[0] <= pitch <= PITCH_MM[1]:
        raise InputError(
            f"neighbouring points are {pitch:.3g} mm apart, a recording takes {PITCH_MM[0]:g} to "
            f"{PITCH_MM[1]:g} mm; are the points in mm?"
        )
    offsets, rasters = [], []
    for view in views:
        offset = view_offset_mm(view.normals, view.deviation_mm)
        residual = view.deviation_mm - view.normals @ offset
        residual[np.abs(residual) > DEFAULT_RECORDING.farthest_mm] = np.nan
        edge = edge_distance_mm(view.points_mm[:, :2], view.points_mm[:, 2], 2.0 * pitch)
        cosine = np.clip(view.normals[:, 2], 0.0, 1.0)
        offsets.append(offset)
        rasters.append(_raster(view.points_mm[:, :2], [residual, cosine, edge], pitch))
    shape = np.max([raster.shape[1:] for raster in rasters], axis=0)
    whole = np.full((3, len(views), *shape), np.nan, dtype=np.float32)
    for k, raster in enumerate(rasters):
        whole[:, k, : raster.shape[1], : raster.shape[2]] = raster
    whole[:, np.isnan(whole[0])] = np.nan
    return Recording(pitch, whole[0], whole[1], whole[2], np.array(offsets), source)


def view_offset_mm(normals: np.ndarray, deviation_mm: np.ndarray) -> np.ndarray:
    """(3,) the shift that explains most of a view's deviations: least squares, outliers cut."""
    use = np.isfinite(deviation_mm) & (np.abs(deviation_mm) < DEFAULT_RECORDING.farthest_mm)
    shift = np.zeros(3)
    for _ in range(5):
        left = deviation_mm - normals @ shift
        spread = MAD_TO_SIGMA * float(np.median(np.abs(left[use])))
        near = use & (np.abs(left) <= CLIP_SIGMAS * max(spread, 1e-6))
        shift = np.linalg.lstsq(normals[near], deviation_mm[near], rcond=1e-3)[0]
    return np.asarray(shift)


def _spacing_mm(plane_mm: np.ndarray) -> float:
    return float(np.median(cKDTree(plane_mm).query(plane_mm[::10], k=2)[0][:, 1]))


def _raster(plane_mm: np.ndarray, values: Sequence[np.ndarray], pitch_mm: float) -> np.ndarray:
    """Each cell's values are those of the point nearest to its middle."""
    cell = (plane_mm - plane_mm.min(axis=0)) / pitch_mm
    at = np.floor(cell).astype(np.int64)
    order = np.argsort(-((cell - at - 0.5) ** 2).sum(axis=1), kind="stable")  # the nearest last
    out = np.full((len(values), *(at.max(axis=0)[::-1] + 1)), np.nan)
    for k, value in enumerate(values):
        out[k, at[order, 1], at[order, 0]] = value[order]
    return out


def save_recording(recording: Recording, path: Path) -> None:
    """Write a recording as compressed arrays (.npz)."""
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            version=np.array(RECORDING_VERSION),
            pitch_mm=np.array(recording.pitch_mm),
            residual_mm=recording.residual_mm.astype(np.float32),
            cosine=recording.cosine.astype(np.float32),
            edge_mm=recording.edge_mm.astype(np.float32),
            offset_mm=recording.offset_mm,
            source=np.array(recording.source),
        )
