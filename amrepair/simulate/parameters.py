"""The world's parameters: how plastic lies, wanders, cools, and how well a sensor sees it.

One TOML file says them all, with their sources: `world.toml` beside this module. A file of the
user's says what differs from it; unknown keys and values out of range are refused. Nothing here
prints or scans.
"""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from amrepair.errors import InputError
from amrepair.simulate.recording import Recording, load_recording
from gcode.errors import ProfileError
from gcode.profiles.store import read_toml, validated

SHIPPED = Path(__file__).with_name("world.toml")
DEFAULT_SCANNER = "structured-light"
RECORDED = "recorded:"  # before the file with a real scanner's residuals

Share = Annotated[float, Field(ge=0, le=0.5)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class BeadModel(_Part):
    """How plastic behaves under the nozzle.

    Attributes
    ----------
    step_mm
        Length of path per deposition step.
    reach_ratio
        How far plastic spreads sideways at once, in nozzle diameters from the nozzle's axis.
    spread_ratio
        How far pressure can push it before it rises as a ridge, likewise.
    flat_ratio
        Radius of the nozzle's flat, likewise: ridges stand outside it.
    carry_mm3
        Plastic that rides along with the nozzle before it must go somewhere.
    pools_layers
        Where a strand has no two ends to hang from, it runs down and fills gaps below the nozzle
        of up to so many layers.
    bridges_mm
        Grooves narrower than this are spanned, not filled: a void stays under the strand, unless
        there is more plastic than finds room beside it.
    planes_layers
        What stands above the nozzle's flat by no more than this is melted and taken along.
    swell_ratio
        Diameter of a free strand over that of its section: it swells as it leaves the die.
    sag_per_mm
        A bridge of length L sags by this times L² in its middle.
    droop_per_mm
        A strand held at one end only is this times x² lower at a distance x from it, until it
        lies on something.
    """

    step_mm: Annotated[float, Field(ge=0.05, le=0.5)] = 0.2
    reach_ratio: Annotated[float, Field(ge=0.5, le=3)] = 1.25
    spread_ratio: Annotated[float, Field(ge=1, le=6)] = 2.0
    flat_ratio: Annotated[float, Field(ge=0.5, le=4)] = 1.25
    carry_mm3: Annotated[float, Field(ge=0, le=1)] = 0.02
    pools_layers: Annotated[float, Field(ge=1, le=10)] = 2.75
    bridges_mm: Annotated[float, Field(ge=0, le=1)] = 0.3
    planes_layers: Annotated[float, Field(ge=0, le=2)] = 0.5
    swell_ratio: Annotated[float, Field(ge=1, le=2)] = 1.1
    sag_per_mm: Annotated[float, Field(ge=0, le=0.1)] = 0.001
    droop_per_mm: Annotated[float, Field(ge=0, le=10)] = 0.1


class FlowModel(_Part):
    """How an extruder's flow wanders: an Ornstein-Uhlenbeck process along the path.

    Attributes
    ----------
    mean_ratio
        Mean flow, of what was asked for.
    sigma_ratio
        Standard deviation of the flow, of 1.
    over_mm
        Length of path over which it forgets.
    """

    mean_ratio: Annotated[float, Field(ge=0.5, le=1.5)] = 1.0
    sigma_ratio: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    over_mm: Annotated[float, Field(ge=1, le=100000)] = 400.0


class ThermalModel(_Part):
    """How the part shrinks and curls as it cools; the bed holds its foot.

    Both grow with height z as 1 − exp(−z / held_mm).

    Attributes
    ----------
    shrink_ratio
        Far above the bed every layer ends up this much smaller, towards the part's middle.
    curl_per_mm
        Its edges rise by this times the square of their distance from the middle.
    held_mm
        Height over which the bed holds it.
    warm_mm
        The topmost millimetres that are warm while the nozzle passes, and have contracted by the
        time that a scan is taken.
    """

    shrink_ratio: Annotated[float, Field(ge=0, le=0.03)] = 0.0
    curl_per_mm: Annotated[float, Field(ge=0, le=0.001)] = 0.0
    held_mm: Annotated[float, Field(ge=0.1, le=100)] = 5.0
    warm_mm: Annotated[float, Field(ge=0, le=20)] = 1.0

    def rise(self, z_mm: Any) -> Any:
        """Share of shrinkage and curl that has come about at a height."""
        return 1.0 - np.exp(-np.asarray(z_mm) / self.held_mm)


class ScannerModel(_Part):
    """How well the sensor measures.

    Attributes
    ----------
    sigma_mm
        Noise along the ray where it meets the surface square.
    slope_power
        At an angle of incidence a the noise is sigma / cosᵖ a.
    spacing_mm, line_step_mm
        Distance of neighbouring rays on the bed in X, and in Y (None: the same): a laser line lies
        along X and is swept along Y.
    baseline_mm
        How far the camera stands from the light that it looks at; what either does not see is not
        measured. 0: both in one place.
    max_incidence_rad
        Beyond this angle of incidence nothing comes back.
    spot_half_height_mm
        Half the height of the spot that a point averages over.
    bed_margin_mm
        How much of the bed around each thing that stands on it is measured.
    dropout_ratio
        Share of the points on square surface that do not come back; it grows as 1 / cos a, since
        less light returns from a slope.
    outlier_ratio, outlier_mm
        Share of points that a shiny bead reflects from elsewhere, and the mean distance that they
        are off along their rays, either way (Laplace: a few are far off).
    oblique_views
        Sensor positions around the part at 45°, beside the one above it.
    offset_mm, tilt_deg
        Size of the calibration's error.
    """

    sigma_mm: Annotated[float, Field(ge=0, le=1)] = 0.03
    slope_power: Annotated[float, Field(ge=0, le=3)] = 0.5
    spacing_mm: Annotated[float, Field(ge=0.02, le=5)] = 0.25
    line_step_mm: Annotated[float, Field(ge=0.02, le=5)] | None = None
    baseline_mm: Annotated[float, Field(ge=0, le=1000)] = 0.0
    max_incidence_rad: Annotated[float, Field(gt=0, lt=1.5708)] = float(np.deg2rad(80.0))
    spot_half_height_mm: Annotated[float, Field(ge=0.02, le=1)] = 0.2
    bed_margin_mm: Annotated[float, Field(ge=0, le=100)] = 6.0
    dropout_ratio: Share = 0.0
    outlier_ratio: Share = 0.0
    outlier_mm: Annotated[float, Field(ge=0, le=20)] = 0.5
    oblique_views: Annotated[int, Field(ge=0, le=12)] = 4
    offset_mm: Annotated[float, Field(ge=0, le=2)] = 0.1
    tilt_deg: Annotated[float, Field(ge=0, le=2)] = 0.05


class WorldParameters(_Part):
    """Everything that the simulated world is told.

    Attributes
    ----------
    columns_mm
        Edge of the world's columns.
    scanners
        By name; the file says `scanner.NAME`.
    """

    columns_mm: Annotated[float, Field(ge=0.02, le=0.15)]
    bead: BeadModel
    flow: FlowModel
    thermal: ThermalModel
    scanners: dict[str, ScannerModel] = Field(alias="scanner")

    @property
    def sha256(self) -> str:
        """Of the content, defaults filled in."""
        told = json.dumps(self.model_dump(by_alias=True), sort_keys=True)
        return hashlib.sha256(told.encode()).hexdigest()

    def scanner(self, name: str = DEFAULT_SCANNER) -> ScannerModel:
        """The scanner of a name; of `recorded:FILE` the default one with the file's noise.

        Raises
        ------
        InputError
            If the file has none of that name, or the recording cannot be read.
        """
        recording = self.recording(name)
        if recording is not None:
            # The scanner states its noise as a data sheet would; the noise itself is replayed.
            told = {"sigma_mm": recording.sigma_mm, "slope_power": 0.0, "outlier_ratio": 0.0}
            return self.scanner().model_copy(update=told)
        if name not in self.scanners:
            known = ", ".join(sorted(self.scanners))
            raise InputError(
                f"there is no scanner {name!r} in this world; there are {known}, and "
                f"{RECORDED}FILE for the noise of a real one"
            )
        return self.scanners[name]

    def recording(self, name: str) -> Recording | None:
        """What a scanner `recorded:FILE` replays; None for one that is described by figures.

        Raises
        ------
        InputError
            If the recording cannot be read.
        """
        if not name.startswith(RECORDED):
            return None
        return load_recording(Path(name.removeprefix(RECORDED)))


@lru_cache(maxsize=8)
def load_world(path: Path | None = None) -> WorldParameters:
    """Read a world's parameters: the shipped ones, and what a file changes in them.

    Raises
    ------
    InputError
        If the file cannot be read, has an unknown key, or a value out of range.
    """
    try:
        content = read_toml(SHIPPED)
        if path is not None:
            content = _merged(content, read_toml(path))
        return validated(WorldParameters, content, path or SHIPPED)
    except ProfileError as error:
        raise InputError(f"{error}") from error


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Tables of the second over those of the first, at every depth."""
    out = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        out[key] = _merged(base[key], value) if both else value
    return out
