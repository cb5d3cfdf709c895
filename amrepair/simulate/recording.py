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
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from amrepair.arrays import PlanePoints, Values
from amrepair.errors import InputError
from amrepair.observe.robust import sigma_by_median
from amrepair.simulate.options import DEFAULT_RECORDING

RECORDING_VERSION = 1
LARGEST_BYTES = 2**30  # of an array: 200 views of a megapixel
PITCH_MM = (0.02, 5.0)  # as a scanner's spacing_mm
_KEYS = ("version", "pitch_mm", "residual_mm", "cosine", "edge_mm", "offset_mm", "source")
_HOW = "make it anew with benchmarks/record_scanner.py"


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
        return sigma_by_median(found)


def edge_distance_mm(plane_mm: PlanePoints, depth_mm: Values, cell_mm: float) -> Values:
    """(n,) distance of points of a view from the next gap or step in depth, in its image plane."""
    at = np.floor((plane_mm - plane_mm.min(axis=0)) / cell_mm).astype(np.int64) + 1
    depth = np.full(tuple(at.max(axis=0) + 2), np.nan)
    depth[at[:, 0], at[:, 1]] = depth_mm
    edge = ~np.isfinite(depth)
    steep_mm = np.tan(np.deg2rad(DEFAULT_RECORDING.steepest_deg)) * cell_mm
    for axis in range(2):
        step = np.abs(np.diff(depth, axis=axis)) > steep_mm
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        edge[tuple(before)] |= step
        edge[tuple(after)] |= step
    away = ndimage.distance_transform_edt(~edge) * cell_mm - 0.5 * cell_mm
    return np.asarray(np.maximum(away[at[:, 0], at[:, 1]], 0.0))


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
    if float(np.abs(content["residual_mm"][known]).max()) > DEFAULT_RECORDING.farthest_mm:
        return f"residual_mm goes beyond {DEFAULT_RECORDING.farthest_mm:g}"
    cosine, edge = content["cosine"][known], content["edge_mm"][known]
    if not (np.isfinite(cosine).all() and cosine.min() >= 0.0 and cosine.max() <= 1.0):
        return "cosine is not 0 to 1 wherever there is a residual"
    if not (np.isfinite(edge).all() and edge.min() >= 0.0):
        return "edge_mm is not a distance wherever there is a residual"
    return ""
