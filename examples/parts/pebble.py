"""A curved part: a twisted, lobed body without a single flat face but its foot and its top.

python examples/parts/pebble.py            writes pebble.stl beside this file
"""

from __future__ import annotations

import argparse
from pathlib import Path

import manifold3d as m3
import numpy as np
from _modelling import write_stl

HEIGHT_MM = 18.0
RADIUS_MM = 11.0
LOBES = 5
AROUND, UP = 120, 36


def pebble() -> m3.Manifold:
    """The whole part, centred on the origin, Z up; no wall leans out by more than 40°."""
    angle_rad = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    circle = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
    unit = m3.CrossSection([circle]).extrude(HEIGHT_MM, UP)

    def bend(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        share = z / HEIGHT_MM
        turn = np.arctan2(y, x)
        profile = RADIUS_MM * (0.82 + 0.30 * np.sin(np.pi * (0.15 + 0.8 * share)) - 0.28 * share**3)
        lobes = 1.0 + 0.10 * np.cos(LOBES * (turn + 0.5 * share))
        radius = np.hypot(x, y) * profile * lobes
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)

    return unit.warp_batch(bend)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path(__file__).with_suffix(".stl"))
    out: Path = parser.parse_args().out
    solid = pebble()
    write_stl(solid, out, "amrepair example: pebble")
    print(f"{out.name}: {solid.volume() / 1000:.2f} cm3, {solid.num_tri()} triangles")


if __name__ == "__main__":
    main()
