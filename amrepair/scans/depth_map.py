"""Depth maps as scans: a 16-bit PNG or a TIFF, and a JSON file beside it with the camera.

They are read by `gcode.surfaces.depth_maps`, which says what the JSON file says; its `pose` is
frame_from_camera here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amrepair.frames import Transform
from amrepair.scans.range_grid import RangeGrid
from amrepair.scans.scan import Scan
from gcode.surfaces.depth_maps import read_depth


def read_depth_map(path: Path, *, frame: str, sigma_mm: float) -> Scan:
    """The seen pixels as points; the camera is their sensor.

    Raises
    ------
    gcode.errors.InputError
        If the image is damaged, is no depth map, or is not of the camera's size.
    """
    depth = read_depth(path)
    pose = None if depth.camera.pose is None else Transform("file", "camera", depth.camera.pose)
    return Scan(
        points_mm=depth.points_mm if pose is None else pose.apply(depth.points_mm),
        sigma_mm=sigma_mm,
        frame=frame,
        sensors_mm=np.zeros((1, 3)) if pose is None else pose.translation_mm[None].copy(),
        sensor_index=np.zeros(len(depth.points_mm), np.int64),
        source=str(path),
        grids=(RangeGrid.of_seen(depth.seen, "perspective"),),
    )
