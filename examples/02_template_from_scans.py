"""Nobody has the part's mesh: a template is made from scans of good parts, and holds a broken one.

python examples/02_template_from_scans.py        writes template.safetensors and template.stl

Every scan lies in a frame of its own; one of them is of a part that is not good. They are placed
on each other, what most of them agree on is kept, and where they differ a defect must be larger.
"""

from __future__ import annotations

import manifold3d as m3
import numpy as np
from _shared import mesh_of, out_folder, scan_of

import amrepair
from amrepair.frames import rotation_from_vector
from amrepair.merge import fit_from_scans
from amrepair.template import MeshSdf, extract_mesh


def part() -> m3.Manifold:
    """A plate with a tower and a hole: it looks the same from no two sides."""
    body = m3.Manifold.cube((40.0, 25.0, 8.0))
    body += m3.Manifold.cylinder(10.0, 6.0, circular_segments=64).translate((30.0, 15.0, 4.0))
    return body - m3.Manifold.cylinder(12.0, 4.0, circular_segments=64).translate((10, 9, -1))


def scanned(solid: m3.Manifold, seed: int) -> tuple[amrepair.Scan, amrepair.Transform]:
    """A scan from all sides, the part held up at any angle, and how it was held."""
    rng = np.random.default_rng(seed)
    scan = scan_of(solid, frame="part", count=40_000, seed=seed, underside=True)
    pose = amrepair.Transform.from_rotation_translation(
        "scanner", "part", rotation=rotation_from_vector(rng.normal(size=3)),
        translation_mm=rng.normal(size=3) * 50.0,
    )  # fmt: skip
    points = scan.moved(pose).points_mm
    return amrepair.Scan(points, 0.03, "scanner", source=f"part {seed}"), pose


def main() -> None:
    out = out_folder(__doc__)
    whole = part()
    dented = whole - m3.Manifold.sphere(4.0).translate((30.0, 15.0, 15.0))
    held = [scanned(whole, seed) for seed in (1, 2, 3)] + [scanned(dented, 4)]
    scans = [scan for scan, _ in held]
    fit = fit_from_scans(scans)
    fit.template.save(out / "template.safetensors")
    extract_mesh(fit.template, 0.4).export(out / "template.stl")
    for note in fit.notes:
        print(note)

    # How good is it? Here the truth is known: on the true surface, distances should be zero.
    surface, _ = MeshSdf.from_mesh(mesh_of(whole)).surface_points(1.0)
    first = held[0][1]  # the template lies as the first part was held
    error_mm = np.abs(fit.template.distance(first.apply(surface)))
    print(f"{len(scans)} scans, template off by {error_mm.mean():.3f} mm on average")

    broken = whole - m3.Manifold.cube((8.0, 8.0, 2.0)).translate((0.0, 17.0, 6.0))
    scan, _ = scanned(broken, 9)
    found = amrepair.align_scan(scan, fit.template)
    anomaly = amrepair.detect_defects(scan.moved(found.template_from_scan), fit.template)
    print(f"a piece of {(whole - broken).volume():.0f} mm³ is broken off another part; found:")
    for region in anomaly.regions:
        if region.volume_mm3 > 2.0:
            print(f"{region.label.name.lower()}, about {region.volume_mm3:.0f} mm³")


if __name__ == "__main__":
    main()
