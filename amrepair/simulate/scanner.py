"""A simulated scanner: rays from sensor positions through the world, occlusion and noise.

It implements the `Scanner` port and knows the world only as solid. Stated simplifications: the bed
is a plane at z = 0; a point is the surface averaged over a spot of three columns (see
`scanner_kernels`), which also keeps the columns' staircase out of the walls' mean position; a
laser line is swept by a mirror from one place, so that it differs from stripes in how densely, how
well and from where it sees; rays meet the part before it shrank and curled, and the points are
moved with it afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.arrays import HeightMap, Mask, Numbers, Points, Values, Vector
from amrepair.errors import ScannerError
from amrepair.frames import Transform, in_box, rotation_from_vector, unit_vectors
from amrepair.scans.scan import Scan
from amrepair.scans.scanner import ScanRequest
from amrepair.simulate.columns import IntervalMap
from amrepair.simulate.options import DEFAULT_TRUTH
from amrepair.simulate.parameters import ScannerModel, WorldParameters
from amrepair.simulate.recording import Recording
from amrepair.simulate.replay import Replay
from amrepair.simulate.scanner_kernels import BED, cast, unhidden
from amrepair.simulate.world import World

USUAL_SCANNER = ScannerModel()


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
    model: ScannerModel = USUAL_SCANNER,
) -> ScannerPose:
    """A scanner frame that is not the build frame, and a calibration slightly off.

    Parameters
    ----------
    rng
        Chooses both.
    centre_mm
        XY of the build frame where the calibration is off by the model's `offset_mm`: where the
        target stood.
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
    off = calibration_error(rng, centre_mm=centre_mm, model=model)
    return ScannerPose(true, off @ true)


def calibration_error(
    rng: np.random.Generator, *, centre_mm: tuple[float, float], model: ScannerModel
) -> Transform:
    """Build from build: by how much a calibration is off, as in `seeded_pose`."""
    direction, spin = rng.normal(size=3), rng.normal(size=3)
    error = rotation_from_vector(np.deg2rad(model.tilt_deg) * spin / np.linalg.norm(spin))
    centre = np.array([*centre_mm, 0.0])
    shift = model.offset_mm * direction / np.linalg.norm(direction) + centre - error @ centre
    return Transform.from_rotation_translation(
        "build", "build", rotation=error, translation_mm=shift
    )


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
    recording
        Residuals of a real scanner, laid over the points instead of the model's noise.
    """

    def __init__(
        self,
        world: World,
        *,
        pose: ScannerPose,
        sensors_mm: Float[np.ndarray, "k 3"],
        rng: np.random.Generator,
        model: ScannerModel | None = None,
        recording: Recording | None = None,
    ) -> None:
        self.world = world
        self._pose, self.build_from_scanner = pose, pose.build_from_scanner_calibrated
        self._sensors_mm = np.array(sensors_mm, dtype=np.float64)
        self._rng = rng
        self.model = model or ScannerModel()
        self._replay = None if recording is None else Replay(recording)

    @classmethod
    def seeded(
        cls,
        world: World,
        told: WorldParameters,
        name: str,
        *,
        centre_mm: tuple[float, float],
        high_mm: float,
        rng: np.random.Generator,
    ) -> SimulatedScanner:
        """The scanner of a name, by a seeded pose, far enough over what may stand `high_mm` high.

        A recorded one replays its recording. Parameters as for `seeded_pose`.

        Raises
        ------
        InputError
            If there is none of that name, or the recording cannot be read.
        """
        model = told.scanner(name)
        return cls(
            world,
            pose=seeded_pose(rng, centre_mm=centre_mm, model=model),
            sensors_mm=default_sensors_mm(
                centre_mm,
                distance_mm=max(300.0, 2.0 * high_mm + 100.0),
                oblique=model.oblique_views,
            ),
            rng=rng,
            model=model,
            recording=told.recording(name),
        )

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
        boxes = solid.apart_mm(self.model.bed_margin_mm)
        clouds, indices = [], []
        for index, sensor in enumerate(self._sensors_mm):
            targets = self._targets(sensor, boxes)
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
            rays = unit_vectors(points - sensor)
            cosine = -np.einsum("ij,ij->i", rays, normals)
            seen = self._measured(points, cosine, kinds, boxes)
            seen &= self._unhidden(solid, top_mm, sensor, points)
            if self._replay is None:
                noise = self._noise(rays, cosine)[seen]
            else:
                noise = self._replay.errors_mm(
                    points[seen],
                    normals[seen],
                    sensor,
                    spacing_mm=self.model.line_step_mm or self.model.spacing_mm,
                    rng=self._rng,
                )
            part = seen & (kinds != BED)
            points[part] = self.world.as_cooled(points[part])
            clouds.append(points[seen] + noise)
            indices.append(np.full(len(noise), index, dtype=np.int64))
        scanner_from_build = self._pose.build_from_scanner_true.inverse()
        return Scan(
            points_mm=scanner_from_build.apply(np.concatenate(clouds)),
            sigma_mm=self.model.sigma_mm,
            frame="scanner",
            sensors_mm=scanner_from_build.apply(self._sensors_mm),
            sensor_index=np.concatenate(indices),
            source=f"simulated:{request.label}",
        )

    def _targets(self, sensor: Vector, boxes: Float[np.ndarray, "k 2 3"]) -> Points:
        """(n, 3) points of the bed that rays aim at: the boxes' shadows and a margin, dithered."""
        margin_mm = self.model.bed_margin_mm
        low, high = boxes[:, 0, :2] - margin_mm, boxes[:, 1, :2] + margin_mm
        # The edges of a box's top, cast on the bed.
        stretch = sensor[2] / (sensor[2] - boxes[:, 1, 2:])
        cast_low, cast_high = sensor[:2] + stretch * [low - sensor[:2], high - sensor[:2]]
        low, high = np.minimum(low, cast_low), np.maximum(high, cast_high)
        spacing_mm = self.model.spacing_mm
        step_mm = self.model.line_step_mm or spacing_mm
        x = np.arange(low[:, 0].min(), high[:, 0].max(), spacing_mm)
        y = np.arange(low[:, 1].min(), high[:, 1].max(), step_mm)
        asked = np.zeros((len(y), len(x)), dtype=bool)
        for one_low, one_high in zip(low, high, strict=True):
            x0, x1 = np.searchsorted(x, [one_low[0] - spacing_mm, one_high[0]], "right")
            y0, y1 = np.searchsorted(y, [one_low[1] - step_mm, one_high[1]], "right")
            asked[y0:y1, x0:x1] = True
        rows, columns = np.nonzero(asked)
        grid = np.stack([x[columns], y[rows]], axis=-1)
        grid += self._rng.uniform(0.0, 1.0, grid.shape) * [spacing_mm, step_mm]
        return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)

    def _measured(
        self, points: Points, cosine: Values, kinds: Numbers, boxes: Float[np.ndarray, "k 2 3"]
    ) -> Mask:
        """(n,) which points send enough light back, and are asked for."""
        margin_mm = self.model.bed_margin_mm
        near = kinds != BED
        for low, high in boxes[:, :, :2]:
            near |= in_box(points[:, :2], low - margin_mm, high + margin_mm)
        keep = (cosine > np.cos(self.model.max_incidence_rad)) & near
        if self.model.dropout_ratio > 0:
            lost = self.model.dropout_ratio / np.maximum(cosine, 0.1)
            keep &= self._rng.random(len(points)) >= lost
        return np.asarray(keep)

    def _unhidden(
        self, solid: IntervalMap, top_mm: HeightMap, sensor: Vector, points: Points
    ) -> Mask:
        """(n,) which points the camera sees too, a baseline beside the light."""
        if self.model.baseline_mm == 0.0:
            return np.ones(len(points), dtype=bool)
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        inward = 0.5 * (low + high) - sensor[:2]
        far_mm = float(np.hypot(*inward))
        # Seen from above every direction is as good as another; Y lies across a laser's line.
        aside = np.array([-inward[1], inward[0]]) / far_mm if far_mm > 1.0 else np.array([0.0, 1.0])
        eye = sensor + np.append(self.model.baseline_mm * aside, 0.0)
        return np.asarray(
            unhidden(
                solid.offsets,
                solid.spans_mm,
                top_mm,
                *solid.window.corner_mm,
                self.world.cell_mm,
                eye,
                points,
                DEFAULT_TRUTH.hidden_mm,
            )
        )

    def _noise(self, rays: Points, cosine: Values) -> Points:
        """(n, 3) errors, all along the rays."""
        noise_mm = self._rng.normal(size=len(rays)) * self.model.sigma_mm
        spread = noise_mm / np.maximum(cosine, 0.1) ** self.model.slope_power
        if self.model.outlier_ratio > 0:
            shiny = self._rng.random(len(rays)) < self.model.outlier_ratio
            spread = spread + shiny * self._rng.laplace(0.0, self.model.outlier_mm, len(rays))
        return np.asarray(rays * spread[:, None])
