"""A simulated scanner: rays from sensor positions through the world, occlusion and noise.

It implements the `Scanner` port and knows the world only as solid. Stated simplifications: the bed
is a plane at z = 0; a point is the surface averaged over a spot of three columns (see
`scanner_kernels`), which also keeps the columns' staircase out of the walls' mean position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.errors import ScannerError
from amrepair.frames import Transform, rotation_from_vector
from amrepair.scans.scan import Scan
from amrepair.scans.scanner import ScanRequest
from amrepair.simulate.scanner_kernels import BED, cast
from amrepair.simulate.world import World


@dataclass(frozen=True, slots=True)
class ScannerModel:
    """How well the sensor measures.

    Attributes
    ----------
    sigma_mm
        Noise along the ray where it meets the surface square; at an angle of incidence a it is
        sigma / sqrt(cos a): the mild growth that stripe projection shows.
    spacing_mm
        Distance of neighbouring rays on the bed.
    max_incidence_rad
        Beyond this angle of incidence nothing comes back.
    spot_half_height_mm
        Half the height of the spot that a point averages over.
    bed_margin_mm
        How much of the bed around the part is measured.
    dropout_ratio
        Share of the points on square surface that do not come back; it grows as 1 / cos a, since
        less light returns from a slope.
    outlier_ratio, outlier_mm
        Share of points that a shiny bead reflects from elsewhere, and the mean distance that they
        are off along their rays, either way (Laplace: a few are far off).
    """

    sigma_mm: float = 0.03
    spacing_mm: float = 0.25
    max_incidence_rad: float = float(np.deg2rad(80.0))
    spot_half_height_mm: float = 0.2
    bed_margin_mm: float = 6.0
    dropout_ratio: float = 0.0
    outlier_ratio: float = 0.0
    outlier_mm: float = 0.5


@dataclass(frozen=True, slots=True)
class ScannerPose:
    """Where the scanner is, and where its calibration says it is."""

    build_from_scanner_true: Transform
    build_from_scanner_calibrated: Transform


def default_sensors_mm(
    centre_mm: tuple[float, float], *, distance_mm: float = 300.0, oblique: int = 4
) -> Float[np.ndarray, "k 3"]:
    """(k, 3) positions, build frame: one above the part, the others around it at 45°."""
    angle_rad = 2 * np.pi * (np.arange(oblique) + 0.5) / max(oblique, 1)
    side_mm = distance_mm / np.sqrt(2.0)
    ring = np.stack(
        [
            centre_mm[0] + side_mm * np.cos(angle_rad),
            centre_mm[1] + side_mm * np.sin(angle_rad),
            np.full(oblique, side_mm),
        ],
        axis=1,
    )
    return np.concatenate([[[centre_mm[0], centre_mm[1], distance_mm]], ring])


def seeded_pose(
    rng: np.random.Generator,
    *,
    centre_mm: tuple[float, float],
    offset_mm: float = 0.1,
    tilt_rad: float = float(np.deg2rad(0.05)),
) -> ScannerPose:
    """A scanner frame that is not the build frame, and a calibration slightly off.

    Parameters
    ----------
    rng
        Chooses both.
    centre_mm
        XY of the build frame where the calibration error is `offset_mm`: where the target stood.
    offset_mm, tilt_rad
        Size of the calibration's error.
    """
    axis = rng.normal(size=3)
    turn = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    tilt = rotation_from_vector(0.3 * axis / np.linalg.norm(axis))
    true = Transform.from_rotation_translation(
        "build",
        "scanner",
        rotation=turn @ tilt,
        translation_mm=np.array([*centre_mm, 0.0]) + rng.uniform(-50.0, 50.0, 3),
    )
    direction, spin = rng.normal(size=3), rng.normal(size=3)
    error = rotation_from_vector(tilt_rad * spin / np.linalg.norm(spin))
    centre = np.array([*centre_mm, 0.0])
    shift = offset_mm * direction / np.linalg.norm(direction) + centre - error @ centre
    off = Transform.from_rotation_translation(
        "build", "build", rotation=error, translation_mm=shift
    )
    return ScannerPose(true, off @ true)


class SimulatedScanner:
    """A scanner over a simulated world.

    Parameters
    ----------
    world
        What it looks at; read anew on every scan.
    pose
        True and calibrated pose.
    sensors_mm
        (k, 3) true sensor positions, build frame, above everything that stands there.
    model
        How well it measures.
    rng
        Draws noise and the rays' sub-spacing positions.
    """

    def __init__(
        self,
        world: World,
        *,
        pose: ScannerPose,
        sensors_mm: Float[np.ndarray, "k 3"],
        rng: np.random.Generator,
        model: ScannerModel | None = None,
    ) -> None:
        self.world = world
        self._pose = pose
        self._sensors_mm = np.array(sensors_mm, dtype=np.float64)
        self._rng = rng
        self.model = model or ScannerModel()

    @property
    def build_from_scanner(self) -> Transform:
        """Calibrated pose."""
        return self._pose.build_from_scanner_calibrated

    def scan(self, request: ScanRequest) -> Scan:
        """Measure what stands on the bed now; points are in the scanner frame.

        Raises
        ------
        ScannerError
            If nothing stands there, or a sensor is inside it.
        """
        solid = self.world.snapshot()
        bounds = solid.bounds_mm()
        if bounds is None:
            raise ScannerError("the scanner sees an empty bed; print something before scanning")
        lowest_mm = float(self._sensors_mm[:, 2].min())
        if lowest_mm <= bounds[1, 2] + 1.0:
            raise ScannerError(
                f"the scanner's lowest sensor is at z = {lowest_mm:.1f} mm, but the part is "
                f"{bounds[1, 2]:.1f} mm high; put the sensors higher"
            )
        top_mm = np.ascontiguousarray(solid.top_mm())
        clouds, indices = [], []
        for index, sensor in enumerate(self._sensors_mm):
            targets = self._targets(sensor, bounds)
            points, normals, kinds = cast(
                solid.offsets,
                solid.spans_mm,
                top_mm,
                *solid.window.corner_mm,
                self.world.cell_mm,
                self.model.spot_half_height_mm,
                sensor,
                targets,
            )
            seen = self._measured(points, normals, kinds, sensor, bounds)
            clouds.append(seen)
            indices.append(np.full(len(seen), index, dtype=np.int64))
        scanner_from_build = self._pose.build_from_scanner_true.inverse()
        return Scan(
            points_mm=scanner_from_build.apply(np.concatenate(clouds)),
            sigma_mm=self.model.sigma_mm,
            frame="scanner",
            sensors_mm=scanner_from_build.apply(self._sensors_mm),
            sensor_index=np.concatenate(indices),
            source=f"simulated:{request.label}",
        )

    def _targets(
        self, sensor: Float[np.ndarray, " 3"], bounds: Float[np.ndarray, "2 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """(n, 3) points of the bed that rays aim at: the part's shadow and a margin, dithered."""
        margin_mm = self.model.bed_margin_mm
        low, high = bounds[0, :2] - margin_mm, bounds[1, :2] + margin_mm
        stretch = sensor[2] / (sensor[2] - bounds[1, 2])  # a point at the top, cast on the bed
        corners = np.stack([low, high, sensor[:2] + stretch * (low - sensor[:2])])
        corners = np.concatenate([corners, [sensor[:2] + stretch * (high - sensor[:2])]])
        low, high = corners.min(axis=0), corners.max(axis=0)
        spacing_mm = self.model.spacing_mm
        x = np.arange(low[0], high[0], spacing_mm)
        y = np.arange(low[1], high[1], spacing_mm)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        grid = grid + self._rng.uniform(0.0, spacing_mm, grid.shape)
        return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)

    def _measured(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        kinds: np.ndarray,
        sensor: Float[np.ndarray, " 3"],
        bounds: Float[np.ndarray, "2 3"],
    ) -> Float[np.ndarray, "m 3"]:
        """(m, 3) points that come back, with noise along their rays."""
        rays = points - sensor
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cosine = -np.einsum("ij,ij->i", rays, normals)
        margin_mm = self.model.bed_margin_mm
        low, high = bounds[0, :2] - margin_mm, bounds[1, :2] + margin_mm
        near = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
        keep = (cosine > np.cos(self.model.max_incidence_rad)) & ((kinds != BED) | near)
        noise_mm = self._rng.normal(size=len(points)) * self.model.sigma_mm
        spread = noise_mm / np.sqrt(np.maximum(cosine, 0.1))
        if self.model.dropout_ratio > 0:
            lost = self.model.dropout_ratio / np.maximum(cosine, 0.1)
            keep &= self._rng.random(len(points)) >= lost
        if self.model.outlier_ratio > 0:
            shiny = self._rng.random(len(points)) < self.model.outlier_ratio
            spread = spread + shiny * self._rng.laplace(0.0, self.model.outlier_mm, len(points))
        return (points + rays * spread[:, None])[keep]
