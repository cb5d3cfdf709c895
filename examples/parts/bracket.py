"""The default part: a bracket with what brackets have. Prints without support as modelled.

python examples/parts/bracket.py            writes bracket.stl beside this file
"""

from __future__ import annotations

import argparse
from pathlib import Path

import manifold3d as m3
from _modelling import cylinder, rounded_plate, teardrop_along_y, write_stl

BASE_MM = (80.0, 50.0, 5.0)
WALL_THICKNESS_MM = 5.0
HEIGHT_MM = 45.0
THIN_WALL_MM = 1.1  # between two and three beads of a 0.4 mm nozzle


def base() -> m3.Manifold:
    """The plate with two countersunk screw holes and a slot."""
    plate = rounded_plate((BASE_MM[0], BASE_MM[1]), BASE_MM[2], 4.0)
    for x_mm in (9.0, 71.0):
        hole = cylinder(2.2, BASE_MM[2] + 2).translate((x_mm, 12.0, -1.0))
        sink = cylinder(2.2, 2.2, 4.4).translate((x_mm, 12.0, BASE_MM[2] - 2.2))
        rim = cylinder(4.4, 1.0).translate((x_mm, 12.0, BASE_MM[2]))
        plate = plate - hole - sink - rim
    ends = [cylinder(2.0, BASE_MM[2] + 2).translate((x, 8.0, -1.0)) for x in (32.0, 48.0)]
    return plate - m3.Manifold.batch_hull(ends)


def wall() -> m3.Manifold:
    """The upright wall with rounded shoulders, two teardrop holes and a lightening slot."""
    y_mm = BASE_MM[1] - WALL_THICKNESS_MM
    outline = [cylinder(10.0, WALL_THICKNESS_MM).translate((x, 35.0, 0.0)) for x in (14.0, 66.0)]
    foot = m3.Manifold.cube((72.0, 1.0, WALL_THICKNESS_MM)).translate((4.0, 0.5, 0.0))
    upright = m3.Manifold.batch_hull([*outline, foot]).rotate((90, 0, 0))
    upright = upright.translate((0.0, BASE_MM[1], 0.0))
    for x_mm in (15.0, 65.0):
        hole = teardrop_along_y(3.0, WALL_THICKNESS_MM + 2).translate((x_mm, y_mm - 1, 33.0))
        upright = upright - hole
    slot = [
        teardrop_along_y(3.5, WALL_THICKNESS_MM + 2).translate((27.0, y_mm - 1, z))
        for z in (15.0, 26.0)
    ]
    return upright - m3.Manifold.batch_hull(slot)


def rib() -> m3.Manifold:
    """The gusset between base and wall: a right triangle, its slope facing up."""
    profile = m3.CrossSection(
        [[(10.0, BASE_MM[2] - 0.5), (46.0, BASE_MM[2] - 0.5), (46.0, 38.0), (44.0, 38.0)]]
    )
    # the profile lies in (y, z); extrude along x
    body = profile.extrude(4.0).rotate((90, 0, 90))
    return body.translate((38.0, 0.0, 0.0))


def boss() -> m3.Manifold:
    """A cylinder with a chamfered top and a blind bore."""
    outer = cylinder(7.5, 13.0) + cylinder(7.5, 1.0, 6.5).translate((0, 0, 13.0))
    bore = cylinder(3.0, 20.0).translate((0, 0, 2.0))
    return (outer - bore).translate((60.0, 27.0, BASE_MM[2]))


def thin_wall() -> m3.Manifold:
    """A fin as thin as two beads."""
    fin = m3.Manifold.cube((22.0, THIN_WALL_MM, 12.5))
    return fin.translate((8.0, 27.0, BASE_MM[2] - 0.5))


def bracket() -> m3.Manifold:
    """The whole part, its lowest corner at the origin, Z up."""
    solid = base() + wall() + rib() + boss() + thin_wall()
    return solid.as_original().simplify(1e-3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path(__file__).with_suffix(".stl"))
    out: Path = parser.parse_args().out
    solid = bracket()
    write_stl(solid, out, "amrepair example: bracket")
    print(f"{out.name}: {solid.volume() / 1000:.2f} cm3, {solid.num_tri()} triangles")


if __name__ == "__main__":
    main()
