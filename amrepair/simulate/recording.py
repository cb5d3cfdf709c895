"""What a real scanner left on a surface that is known: residuals of placed views, kept in a file.

A view is kept as a raster in its own image plane (X and Y of its frame, Z towards the sensor): by
cell the residual to the surface, the cosine of the angle of incidence, and how far the next edge of
what the view saw is. So its noise keeps what a sigma cannot say: how errors hang together, how many
are far off, and what edges do. What shifts a view as a whole is fitted first and kept apart.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.arrays import PlanePoints, Points, Values, Vector
from amrepair.errors import InputError
from amrepair.simulate.options import USUAL_RECORDING

RECORDING_VERSION = 1
SIGMA_OF_MAD = 1.4826  # normal distribution
LARGEST_BYTES = 2**30  # of an array: 200 views of a megapixel
PITCH_MM = (0.02, 5.0)  # as a scanner's spacing_mm
_KEYS = ("version", "pitch_mm", "residual_mm", "cosine", "edge_mm", "offset_mm", "source")
_HOW = "make it anew with benchmarks/record_scanner.py"


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

    points_mm: Points
    normals: Points
    deviation_mm: Values


@dataclass(frozen=True, slots=True)
class Recording:
    """Views of a real scanner as rasters; NaN where nothing is known.

    Attributes
    ----------
    pitch_mm
        Edge of a cell.
    residual_mm, cosine, edge_mm
        (k, ny, nx) signed residual along the surface's normal with the view's shift taken out,
        cosine of the angle of incidence, distance from the next edge in the image plane.
    offset_mm
        (k, 3) by how much each view was shifted, its own frame.
    source
        What was scanned, in words.
    """

    pitch_mm: float
    residual_mm: Float[np.ndarray, "k ny nx"]
    cosine: Float[np.ndarray, "k ny nx"]
    edge_mm: Float[np.ndarray, "k ny nx"]
    offset_mm: Float[np.ndarray, "k 3"]
    source: str

    @property
    def sigma_mm(self) -> float:
        """Robust standard deviation of all residuals."""
        found = self.residual_mm[np.isfinite(self.residual_mm)]
        return SIGMA_OF_MAD * float(np.median(np.abs(found - np.median(found))))


def edge_distance_mm(plane_mm: PlanePoints, depth_mm: Values, cell_mm: float) -> Values:
    """(n,) distance of points of a view from the next gap or step in depth, in its image plane."""
    at = np.floor((plane_mm - plane_mm.min(axis=0)) / cell_mm).astype(np.int64) + 1
    depth = np.full(tuple(at.max(axis=0) + 2), np.nan)
    depth[at[:, 0], at[:, 1]] = depth_mm
    edge = ~np.isfinite(depth)
    steep_mm = np.tan(np.deg2rad(USUAL_RECORDING.steepest_deg)) * cell_mm
    for axis in range(2):
        step = np.abs(np.diff(depth, axis=axis)) > steep_mm
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        edge[tuple(before)] |= step
        edge[tuple(after)] |= step
    away = ndimage.distance_transform_edt(~edge) * cell_mm - 0.5 * cell_mm
    return np.asarray(np.maximum(away[at[:, 0], at[:, 1]], 0.0))


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
        residual[np.abs(residual) > USUAL_RECORDING.farthest_mm] = np.nan
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


def view_offset_mm(normals: Points, deviation_mm: Values) -> Vector:
    """(3,) the shift that explains most of a view's deviations: least squares, outliers cut."""
    use = np.isfinite(deviation_mm) & (np.abs(deviation_mm) < USUAL_RECORDING.farthest_mm)
    shift = np.zeros(3)
    for _ in range(5):
        left = deviation_mm - normals @ shift
        spread = SIGMA_OF_MAD * float(np.median(np.abs(left[use])))
        near = use & (np.abs(left) <= USUAL_RECORDING.clip_sigmas * max(spread, 1e-6))
        shift = np.linalg.lstsq(normals[near], deviation_mm[near], rcond=1e-3)[0]
    return np.asarray(shift)


def _spacing_mm(plane_mm: PlanePoints) -> float:
    return float(np.median(cKDTree(plane_mm).query(plane_mm[::10], k=2)[0][:, 1]))


def _raster(
    plane_mm: PlanePoints, values: Sequence[np.ndarray], pitch_mm: float
) -> Float[np.ndarray, "m ny nx"]:
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


@lru_cache(maxsize=4)
def load_recording(path: Path) -> Recording:
    """Read a recording.

    Raises
    ------
    InputError
        If the file cannot be read, is of another version, or does not hold together.
    """
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as file:
            members = {key: file.read(f"{key}.npy") for key in _KEYS if _holds(file, key)}
        content = {
            key: np.load(io.BytesIO(data), allow_pickle=False) for key, data in members.items()
        }
    except OSError as error:
        raise InputError(f"{path}: the recording cannot be read ({error})") from error
    except (ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is no recording of a scanner (.npz); {_HOW}") from error
    lacking = [key for key in _KEYS if key not in content]
    if lacking:
        raise InputError(f"{path} is no recording of a scanner: it lacks {lacking[0]}; {_HOW}")
    version = content["version"]
    if version.shape != () or version.dtype.kind not in "iu" or int(version) != RECORDING_VERSION:
        raise InputError(f"{path}: recording of version {version}, not {RECORDING_VERSION}; {_HOW}")
    wrong = _wrong(content)
    if wrong:
        raise InputError(f"{path}: the recording's {wrong}; {_HOW}")
    return Recording(
        float(content["pitch_mm"]),
        content["residual_mm"],
        content["cosine"],
        content["edge_mm"],
        content["offset_mm"],
        str(content["source"]),
    )


def _holds(file: zipfile.ZipFile, key: str) -> bool:
    """Whether an archive has an array, of a size that can be one."""
    name = f"{key}.npy"
    if name not in file.namelist():
        return False
    if file.getinfo(name).file_size > LARGEST_BYTES:
        raise ValueError(f"{name} is larger than {LARGEST_BYTES} bytes")
    return True


def _wrong(content: dict[str, np.ndarray]) -> str:
    """What does not hold in a recording's arrays; empty where all does."""
    rasters = ("residual_mm", "cosine", "edge_mm")
    numbers = (*rasters, "offset_mm", "pitch_mm")
    for key in numbers:
        if content[key].dtype.kind != "f":
            return f"{key} are not floating-point numbers"
    pitch, shape = content["pitch_mm"], content["residual_mm"].shape
    if pitch.shape != () or not PITCH_MM[0] <= float(pitch) <= PITCH_MM[1]:
        return f"pitch_mm is {pitch}, not {PITCH_MM[0]:g} to {PITCH_MM[1]:g}"
    if len(shape) != 3 or any(content[key].shape != shape for key in rasters):
        return f"rasters are not of one shape (views, rows, columns): residual_mm has {shape}"
    offset = content["offset_mm"]
    if offset.shape != (shape[0], 3) or not np.isfinite(offset).all():
        return f"offset_mm are not three finite numbers for each of {shape[0]} views"
    known = np.isfinite(content["residual_mm"])
    if not known.any():
        return "residual_mm has no finite value"
    if float(np.abs(content["residual_mm"][known]).max()) > USUAL_RECORDING.farthest_mm:
        return f"residual_mm goes beyond {USUAL_RECORDING.farthest_mm:g}"
    cosine, edge = content["cosine"][known], content["edge_mm"][known]
    if not (np.isfinite(cosine).all() and cosine.min() >= 0.0 and cosine.max() <= 1.0):
        return "cosine is not 0 to 1 wherever there is a residual"
    if not (np.isfinite(edge).all() and edge.min() >= 0.0):
        return "edge_mm is not a distance wherever there is a residual"
    return ""
