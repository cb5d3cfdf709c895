"""A knob with teeth and a D-shaped bore: a small part with many short edges.

python examples/parts/knob.py            writes knob.stl beside this file
"""

from __future__ import annotations

import argparse
from pathlib import Path

import manifold3d as m3
import numpy as np
from _modelling import cylinder, write_stl

TEETH = 18
RADIUS_MM = 13.0
TOOTH_MM = 1.2
HEIGHT_MM = 12.0


def knob() -> m3.Manifold:
    """The whole part, centred on the origin, Z up."""
    angle_rad = np.linspace(0, 2 * np.pi, TEETH * 16, endpoint=False)
    wave = np.tanh(2.0 * np.cos(TEETH * angle_rad)) / np.tanh(2.0)
    radius_mm = RADIUS_MM + 0.5 * TOOTH_MM * wave
    outline = np.stack([radius_mm * np.cos(angle_rad), radius_mm * np.sin(angle_rad)], axis=1)
    body = m3.CrossSection([outline]).extrude(HEIGHT_MM)
    # the top is chamfered by a cone, and dished for a finger
    cone = cylinder(RADIUS_MM + 8.0, 16.0, RADIUS_MM - 8.0).translate((0, 0, HEIGHT_MM - 10.0))
    dish = m3.Manifold.sphere(20.0, 160).translate((0, 0, HEIGHT_MM + 18.5))
    flat = m3.Manifold.cube((10.0, 10.0, 60.0)).translate((2.4, -5.0, -15.0))
    bore = cylinder(3.1, 30.0).translate((0, 0, -0.5)) - flat
    return (
        (body ^ cone) + (body.trim_by_plane((0, 0, -1), 1.0 - HEIGHT_MM)) - dish - bore
    ).simplify(5e-3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path(__file__).with_suffix(".stl"))
    out: Path = parser.parse_args().out
    solid = knob()
    write_stl(solid, out, "amrepair example: knob")
    print(f"{out.name}: {solid.volume() / 1000:.2f} cm3, {solid.num_tri()} triangles")


if __name__ == "__main__":
    main()
