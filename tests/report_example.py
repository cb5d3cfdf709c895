"""A report's worth of analytic truth: a plate with a boss, a pocket missing, a blob too many.

Pure geometry, no pipeline: what the report must show is known in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np

from amrepair.report import (
    BeadPath,
    Counter,
    Figures,
    Outcome,
    RegionRow,
    ReportData,
    ReportDecision,
    ReportLook,
    SolidMesh,
    TemperatureSeries,
)
from gcode.moves import Extrude, LayerChange, Role, Toolpath, Travel
from gcode.surfaces import HeightField

ORIGIN_MM = np.array([100.0, 90.0, 0.0])
SIZE_MM = np.array([60.0, 40.0, 8.0])
BOSS_RADIUS_MM, BOSS_TOP_MM = 9.0, 24.0
POCKET_LOW_MM = np.array([12.0, 10.0, 5.0])
POCKET_HIGH_MM = np.array([24.0, 20.0, 8.0])
BLOB_MM, BLOB_RADIUS_MM = np.array([14.0, 30.0, 8.0]), 2.2
THRESHOLD_MM = 0.15
POCKET_MM3 = float(np.prod(POCKET_HIGH_MM - POCKET_LOW_MM))
HOSTILE = '<img src="https://evil.example/x.png" onerror="alert(1)"> & \'quotes\' </script>'


def part() -> manifold3d.Manifold:
    plate = manifold3d.Manifold.cube(SIZE_MM)
    boss = manifold3d.Manifold.cylinder(BOSS_TOP_MM, BOSS_RADIUS_MM, circular_segments=96)
    hole = manifold3d.Manifold.cylinder(BOSS_TOP_MM + 1, 4.0, circular_segments=64)
    at = (44.0, 20.0, 0.0)
    return (plate + boss.translate(at) - hole.translate(at)).translate(ORIGIN_MM)


def pocket() -> manifold3d.Manifold:
    return manifold3d.Manifold.cube(POCKET_HIGH_MM - POCKET_LOW_MM).translate(
        POCKET_LOW_MM + ORIGIN_MM
    )


def blob() -> manifold3d.Manifold:
    ball = manifold3d.Manifold.sphere(BLOB_RADIUS_MM, circular_segments=48)
    return ball.translate(BLOB_MM + ORIGIN_MM) - part()


def mesh_of(solid: manifold3d.Manifold) -> SolidMesh:
    out = solid.to_mesh()
    return SolidMesh(
        np.asarray(out.vert_properties[:, :3], dtype=np.float64),
        np.asarray(out.tri_verts, dtype=np.int64),
    )


def sampled(mesh: SolidMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    corners = mesh.vertices_mm[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    picked = corners[face]
    points = picked[:, 0] + u[:, None] * (picked[:, 1] - picked[:, 0])
    points += v[:, None] * (picked[:, 2] - picked[:, 0])
    return points, cross[face] / area[face][:, None]


@dataclass(frozen=True)
class Scene:
    """A look with its truth."""

    points_mm: np.ndarray
    normals: np.ndarray
    deviation_mm: np.ndarray


def scanned(count: int, *, broken: bool, seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    solid = part() - pocket() + blob() if broken else part()
    points, normals = sampled(mesh_of(solid), count, rng)
    seen = normals[:, 2] > -0.5  # nothing looks from below
    points, normals = points[seen], normals[seen]
    deviation = rng.normal(0.0, 0.04, len(points))
    local = points - ORIGIN_MM
    if broken:
        inside = np.minimum(local - POCKET_LOW_MM, POCKET_HIGH_MM - local).min(axis=1) > -1e-6
        depth = POCKET_HIGH_MM[2] - local[:, 2]
        deviation = np.where(inside, deviation - depth, deviation)
        over = np.linalg.norm(local - BLOB_MM, axis=1) < BLOB_RADIUS_MM + 1e-6
        over &= local[:, 2] > BLOB_MM[2] + 1e-6
        deviation = np.where(over, deviation + local[:, 2] - BLOB_MM[2], deviation)
    return Scene(points, normals, deviation)


def patch(layers: int = 15, height_mm: float = 0.2) -> Toolpath:
    """Zigzags that fill the pocket."""
    moves: list[object] = []
    low, high = POCKET_LOW_MM + ORIGIN_MM, POCKET_HIGH_MM + ORIGIN_MM
    for index in range(layers):
        z_mm = low[2] + (index + 1) * height_mm
        moves.append(LayerChange(index, z_mm, height_mm))
        rows = []
        for row, y_mm in enumerate(np.arange(low[1] + 0.25, high[1], 0.45)):
            ends = (low[0] + 0.3, high[0] - 0.3)
            rows += [(x, y_mm, z_mm) for x in (ends if row % 2 == 0 else ends[::-1])]
        points = np.array(rows)
        if index % 2:
            points[:, :2] = (points[:, :2] - low[:2])[:, ::-1] * (12 / 10, 10 / 12) + low[:2]
        moves.append(Travel(points[:1], 150.0))
        section_mm2 = np.full(len(points) - 1, 0.09)
        moves.append(Extrude(points, section_mm2, 40.0, Role.SOLID_INFILL, 0.45, height_mm))
    return Toolpath(tuple(moves))  # type: ignore[arg-type]


def heights(*, broken: bool) -> HeightField:
    cell_mm = 0.25
    ny, nx = int(44 / cell_mm), int(64 / cell_mm)
    x, y = np.meshgrid((np.arange(nx) + 0.5) * cell_mm - 2, (np.arange(ny) + 0.5) * cell_mm - 2)
    on = (x > 0) & (x < SIZE_MM[0]) & (y > 0) & (y < SIZE_MM[1])
    z_mm = np.where(on, SIZE_MM[2], 0.0)
    away = np.hypot(x - 44, y - 20)
    z_mm = np.where((away < BOSS_RADIUS_MM) & (away > 4), BOSS_TOP_MM, np.where(away <= 4, 0, z_mm))
    if broken:
        hole = (x > POCKET_LOW_MM[0]) & (x < POCKET_HIGH_MM[0])
        hole &= (y > POCKET_LOW_MM[1]) & (y < POCKET_HIGH_MM[1])
        z_mm = np.where(hole, POCKET_LOW_MM[2], z_mm)
    seen = ~((x > 53) & (x < 57) & (abs(y - 20) < 7))
    return HeightField(ORIGIN_MM[:2] - 2.0, cell_mm, z_mm, seen)


def look(label: str, count: int, *, broken: bool, seed: int) -> ReportLook:
    scene = scanned(count, broken=broken, seed=seed)
    flags = np.where(
        scene.deviation_mm < -THRESHOLD_MM, 1, np.where(scene.deviation_mm > THRESHOLD_MM, 2, 0)
    )
    corners = np.array([[12.0, 10], [24, 10], [24, 20], [12, 20]]) + ORIGIN_MM[:2]
    below = sampled(mesh_of(part()), 9000, np.random.default_rng(3))
    return ReportLook(
        label=label,
        points_mm=scene.points_mm,
        deviation_mm=scene.deviation_mm,
        label_of_point=flags,
        threshold_mm=THRESHOLD_MM,
        smallest_mm=((5.0, 0.4), (21.0, 0.3)),
        noise="One point is off by 0.03 mm.",
        normals=scene.normals if seed % 2 else None,
        unseen_mm=below[0][below[1][:, 2] < -0.5],
        missing=mesh_of(pocket()) if broken else None,
        excess=mesh_of(blob()) if broken else None,
        beads=BeadPath.from_toolpath(patch()) if broken else None,
        missing_mm3=POCKET_MM3 if broken else 1.9,
        excess_mm3=float(blob().volume()),
        height_map=heights(broken=broken),
        outlines_mm=(corners,) if broken else (),
    )


def example(count: int = 60_000, *, title: str = "bracket.stl") -> ReportData:
    time_s = np.linspace(0.0, 900.0, 400)
    hotend = 25 + 190 * (1 - np.exp(-time_s / 45))
    bed = 25 + 35 * (1 - np.exp(-time_s / 120))
    missing = POCKET_MM3
    return ReportData(
        title=title,
        outcome=Outcome.WITHIN_TOLERANCE,
        figures=Figures(
            missing_mm3_before=missing,
            missing_mm3_after=1.9,
            excess_mm3_before=float(blob().volume()),
            excess_mm3_after=float(blob().volume()),
            repaired_ratio=0.982,
            unreachable_mm3=0.6,
            unseen_area_mm2=118.0,
            iterations=1,
            filament_mm=151.0,
            print_time_s=412.0,
        ),
        setup={
            "Printer": "Prusa MK3S",
            "Material": "PLA",
            "Process": "0.20 mm repair",
            "Seed": "0",
        },
        expected=mesh_of(part()),
        looks=(
            look("Finished part, before repair", count, broken=True, seed=1),
            look("After repair 1", count, broken=False, seed=2),
        ),
        regions=(
            RegionRow(
                "chip",
                missing,
                np.stack([POCKET_LOW_MM, POCKET_HIGH_MM]) + ORIGIN_MM,
                0.998,
                "Filled now: open from above and in reach.",
            ),
            RegionRow(
                "blob",
                float(blob().volume()),
                np.stack([BLOB_MM - BLOB_RADIUS_MM, BLOB_MM + BLOB_RADIUS_MM]) + ORIGIN_MM,
                None,
                "Left: printing cannot take material away.",
            ),
        ),
        decisions=(
            ReportDecision(
                "Finished part",
                "fill now",
                (
                    "360 mm³ are missing, 2,400 times the smallest bead.",
                    "99.8 % of it is in reach of the nozzle.",
                ),
            ),
            ReportDecision("After repair 1", "done", ("1.9 mm³ are left, below the tolerance.",)),
        ),
        wire=(
            Counter("Lines acknowledged", 48213.0, "each proved to have been received"),
            Counter("Resends", 3.0, "lines that the printer asked for again"),
            Counter("Stalls", 0.0, "times without an answer for longer than allowed"),
        ),
        temperatures=(
            TemperatureSeries("Hotend", time_s, hotend, np.full(400, 215.0)),
            TemperatureSeries("Bed", time_s, bed, np.full(400, 60.0)),
        ),
        seconds={"slice": 3.2, "print": 41.0, "align": 0.9, "detect": 1.4, "deficit": 2.0},
        provenance={"amrepair": "0.1.0", "numpy": "2.2.0", "seed": "0", "prusa_mk3s": "9f0c…"},
    )
