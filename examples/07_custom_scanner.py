"""A scanner that amrepair does not know: a depth camera over the bed becomes a `Scanner`.

python examples/07_custom_scanner.py        prints a repair into sent.gcode

An adapter needs two members: `build_from_scanner`, the calibrated pose, and `scan`, which measures.
The points come in the scanner's own frame, with their noise and the place that the rays came from:
that is how amrepair tells what is missing from what nobody saw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import manifold3d as m3
import numpy as np
from _shared import mesh_of, out_folder

import amrepair
import gcode
from amrepair.loop import locate_part, plan_stops
from amrepair.scans import ScanRequest
from amrepair.template import MeshSdf

HEIGHT_MM = 260.0
PLACE_MM = (115.0, 95.0, 0.0)


@dataclass
class DepthCamera:
    """Looks straight down from `HEIGHT_MM`; X to the right, Y away from it, Z towards the bed.

    `read_depth_mm` is where the maker's own library is called: it returns (rows, columns) depths
    along Z, NaN where nothing was seen.
    """

    read_depth_mm: Callable[[], np.ndarray]
    focal_px: float = 2600.0
    sigma_mm: float = 0.04

    @property
    def build_from_scanner(self) -> amrepair.Transform:
        """From a calibration: the camera hangs over the middle of the bed, looking down."""
        return amrepair.Transform.from_rotation_translation(
            "build",
            "scanner",
            rotation=np.diag([1.0, -1.0, -1.0]),
            translation_mm=np.array([125.0, 105.0, HEIGHT_MM]),
        )

    def scan(self, request: ScanRequest) -> amrepair.Scan:
        """One depth image as points; called once the nozzle is parked and still."""
        depth_mm = self.read_depth_mm()
        rows, columns = depth_mm.shape
        v, u = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        rays = np.stack(
            [
                (u + 0.5 - columns / 2) / self.focal_px,
                (v + 0.5 - rows / 2) / self.focal_px,
                np.ones_like(depth_mm),
            ],
            axis=-1,
        )
        seen = np.isfinite(depth_mm)
        points = rays[seen] * depth_mm[seen][:, None]
        return amrepair.Scan(
            points,
            self.sigma_mm,
            "scanner",
            sensors_mm=np.zeros((1, 3)),
            sensor_index=np.zeros(len(points), dtype=np.int64),
            source=f"depth camera, {request.label}",
        )


def part() -> m3.Manifold:
    """A block with a step, so that it looks the same from no two sides."""
    return m3.Manifold.cube((30.0, 22.0, 5.0)) + m3.Manifold.cube((12.0, 9.0, 3.0)).translate(
        (0.0, 0.0, 4.0)
    )


def rendered(solid: m3.Manifold, camera: DepthCamera, *, pixels: int = 640) -> np.ndarray:
    """What such a camera sees of a solid on the bed: the stand-in for the maker's library."""
    mesh = mesh_of(solid).union(mesh_of(m3.Manifold.cube((250, 210, 1)).translate((0, 0, -1))))
    v, u = np.meshgrid(np.arange(pixels), np.arange(pixels), indexing="ij")
    rays = np.stack([u + 0.5 - pixels / 2, v + 0.5 - pixels / 2], axis=-1) / camera.focal_px
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).reshape(-1, 3)
    pose = camera.build_from_scanner
    origins = np.tile(pose.translation_mm, (len(rays), 1))
    hits, which, _ = mesh.ray.intersects_location(origins, pose.rotate(rays), multiple_hits=False)
    depth = np.full(len(rays), np.nan)
    depth[which] = pose.inverse().apply(hits)[:, 2]
    noise = np.random.default_rng(0).normal(scale=camera.sigma_mm, size=len(depth))
    return (depth + noise).reshape(pixels, pixels)


def main() -> None:
    out = out_folder(__doc__)
    setup = gcode.load_setup("prusa_mk3s", "pla", "repair_0.20")
    standing = part().translate(PLACE_MM)
    chip = m3.Manifold.cube((10.0, 8.0, 1.4)).translate((130.0, 104.0, 3.6))
    image: list[np.ndarray] = []
    camera = DepthCamera(lambda: image[0])
    image.append(rendered(standing - chip, camera))
    assert isinstance(camera, amrepair.Scanner)

    # the job that the part was printed from says where it stands
    template = MeshSdf.from_mesh(mesh_of(part()))
    program = gcode.write_program(gcode.slice_part(standing, setup), setup, title="block")
    job = gcode.read_job(program, dialect=program.dialect)
    placed = locate_part(job, template, layer_height_mm=0.2)
    printer = gcode.connect(f"file:{out / 'sent.gcode'}", dialect=program.dialect)
    printer.connect()
    report = amrepair.run_loop(
        job,
        gcode.check_program(program, setup),
        printer,
        camera,
        lambda stop: amrepair.Site.of_part(template, setup, build_from_template=placed),
        stops=plan_stops(job, []),
    )
    printer.close()
    first = report.looks[0]
    print(f"{len(first.scan)} points; broken off {(chip ^ standing).volume():.1f} mm³, measured")
    print(f"{first.plan.deficit.missing_mm3:.1f} mm³; a repair was sent: {first.printed}")


if __name__ == "__main__":
    main()
