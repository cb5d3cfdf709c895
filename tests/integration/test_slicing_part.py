"""Whole parts: the plastic laid balances the solid, and stays inside it."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest

from gcode.meshes import closed_mesh
from gcode.moves import Extrude, Role
from gcode.profiles.schema import MaterialProfile, ProcessProfile
from gcode.profiles.setup import PrintSetup
from gcode.slicing.infill import solid_fill
from gcode.slicing.job import slice_part
from gcode.slicing.options import DEFAULT_PART
from gcode.writer import write
from tests.unit.link_helpers import profile


@pytest.fixture(scope="module")
def setup() -> PrintSetup:
    material = MaterialProfile(
        id="test",
        name="test",
        density_g_cm3=1.24,
        hotend_c=210.0,
        first_layer_hotend_c=215.0,
        bed_c=60.0,
        bed_release_c=45.0,
        fan_ratio=1.0,
        max_volumetric_mm3_s=12.0,
    )
    process = ProcessProfile(
        id="test",
        name="test",
        layer_height_mm=0.2,
        first_layer_height_mm=0.2,
        line_width_mm=0.45,
        perimeters=2,
        infill_ratio=1.0,
        top_layers=4,
        bottom_layers=4,
        skirt_loops=1,
        skirt_distance_mm=3.0,
        perimeter_speed_mm_s=45.0,
        external_perimeter_speed_mm_s=30.0,
        infill_speed_mm_s=80.0,
        solid_infill_speed_mm_s=60.0,
        first_layer_speed_mm_s=20.0,
        repair_speed_mm_s=20.0,
        acceleration_mm_s2=1000.0,
    )
    return PrintSetup(profile(), material, process)


def _beads(solid: m3.Manifold, setup: PrintSetup) -> list[Extrude]:
    return [b for b in slice_part(solid, setup).extrusions if b.role is not Role.SKIRT]


@pytest.mark.parametrize(
    "solid",
    [
        m3.Manifold.cube((20.0, 14.0, 6.0)),
        m3.Manifold.cylinder(5.0, 8.0, 4.0, 96),
        m3.Manifold.cube((24.0, 24.0, 4.0))
        - m3.Manifold.cylinder(9.0, 5.0, 5.0, 64).translate((12.0, 12.0, -1.0)),
        m3.Manifold.cube((20.0, 0.8, 5.0)),
    ],
    ids=["block", "cone", "plate with a hole", "thin wall"],
)
def test_a_solid_print_holds_the_solids_volume(solid: m3.Manifold, setup: PrintSetup) -> None:
    placed = solid.translate((100.0, 100.0, 0.0))
    laid_mm3 = sum(bead.volume_mm3 for bead in _beads(placed, setup))
    # the promise of the slicer: half a per cent
    assert laid_mm3 == pytest.approx(placed.volume(), rel=0.005)


def test_no_bead_leaves_the_part(setup: PrintSetup) -> None:
    beads = _beads(m3.Manifold.cube((20.0, 14.0, 6.0)).translate((50.0, 60.0, 0.0)), setup)
    points_mm = np.concatenate([bead.points_mm for bead in beads])
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    # a bead's centre keeps a fifth of a millimetre (half a line, less rounding) from the wall
    assert (low[:2] > (50.15, 60.15)).all()
    assert (high[:2] < (69.85, 73.85)).all()
    assert low[2] == pytest.approx(0.2)
    assert high[2] == pytest.approx(6.0)


def test_lines_of_a_solid_fill_carry_their_own_strip_and_no_more() -> None:
    # regression: what lines lack at their ends was added along their whole length; 2 to 5 % too
    # much in the middle of every layer, which piled up to 0.4 mm over sixty layers
    ring = m3.CrossSection.circle(12.0, 128) - m3.CrossSection.circle(3.0, 64)
    beads, _ = solid_fill(
        ring,
        spacing_mm=0.407,
        angle_rad=np.pi / 4,
        role=Role.SOLID_INFILL,
        bore_mm=0.4,
        options=DEFAULT_PART.fill,
        overlap_ratio=DEFAULT_PART.overlap_ratio,
    )
    lines = [bead for bead in beads if bead.role is Role.SOLID_INFILL]
    flow = np.concatenate([bead.share_mm for bead in lines]) / 0.407
    assert np.abs(flow - 1.0).max() < 0.01
    assert sum(bead.area_mm2 for bead in beads) == pytest.approx(ring.area(), rel=0.005)


@pytest.mark.parametrize("infill_ratio", [1.0, 0.2])
def test_layers_are_the_same_whoever_plans_them(setup: PrintSetup, infill_ratio: float) -> None:
    """A solid or its mesh, in this process or in others: one text."""
    setup = replace(setup, process=setup.process.model_copy(update={"infill_ratio": infill_ratio}))
    solid = m3.Manifold.sphere(2.5, 40).translate((100.0, 100.0, 2.5))
    texts = {
        write(slice_part(part, setup, workers=workers), setup, title="ball").text
        for part, workers in ((solid, 1), (closed_mesh(solid), 1), (solid, 2))
    }
    assert len(texts) == 1


@pytest.mark.parametrize("infill_ratio", [1.0, 0.2])
def test_a_concentric_infill_is_rings_about_the_middle(
    setup: PrintSetup, infill_ratio: float
) -> None:
    """regression: where it was sparse, it was straight lines."""
    told = {"infill_ratio": infill_ratio, "infill_pattern": "concentric"}
    setup = replace(setup, process=setup.process.model_copy(update=told))
    disc = m3.Manifold.cylinder(4.0, 12.0, 12.0, 256).translate((100.0, 100.0, 0.0))
    beads = _beads(disc, setup)
    inside = [bead for bead in beads if bead.points_mm[0, 2] == pytest.approx(2.0)]
    role = Role.SOLID_INFILL if infill_ratio == 1.0 else Role.SPARSE_INFILL
    rings = [bead for bead in inside if bead.role is role]
    assert len(rings) >= 5
    for ring in rings:
        assert len(ring.points_mm) > 20  # both ends of a chord are as far from the middle, too
        away_mm = np.linalg.norm(ring.points_mm[:, :2] - 100.0, axis=1)
        assert np.ptp(away_mm) < 0.05  # a chord's sagitta and simplified corners
    walls_mm = 2 * setup.process.line_width_mm
    core_mm3 = np.pi * (12.0 - walls_mm) ** 2 * 0.2
    assert sum(ring.volume_mm3 for ring in rings) == pytest.approx(infill_ratio * core_mm3, rel=0.1)
