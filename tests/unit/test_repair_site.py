"""A layer's look in the first open layers, and what the job's own path puts beyond a drawing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from loop_bench import Small

from amrepair.align import AlignOptions, align
from amrepair.deficit.options import DeficitOptions
from amrepair.frames import Transform
from amrepair.loop import Stop
from amrepair.loop.sites import sites
from amrepair.regions.options import RegionOptions
from amrepair.repair import Site, plan_repair
from amrepair.repair.path_offsets import off_by_job
from amrepair.repair.scan_scope import align_options, planned_so_far
from amrepair.scans import Scan


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made("standard_0.20", 4.0)


def look(small: Small, layer: int) -> tuple[Site, Stop]:
    one = small.job.layers[layer]
    stop = Stop(layer, one.end_line, one.z_mm)
    return sites(small.job, small.template, small.placed, small.setup)(stop), stop


def scan_from_above(site: Site, placed: Transform, low_mm: float) -> Scan:
    """All of the part that lies open upwards and aside, too low as by a calibration's error."""
    assert site.planned is not None
    points, normals = site.planned.surface_points(0.3)
    seen = (normals[:, 2] > -0.1) & (points[:, 2] > 0.1) & (site.template.distance(points) < 0.3)
    rng = np.random.default_rng(2)
    noisy = placed.apply(points[seen]) + rng.normal(scale=0.02, size=(int(seen.sum()), 3))
    return Scan(noisy - [0.0, 0.0, low_mm], 0.02, "scanner", placed.rotate(normals[seen]))


@pytest.mark.parametrize("above_skin", [1, 2, 3])
def test_a_clean_look_into_shallow_open_infill_fits(small: Small, above_skin: int) -> None:
    """Regression: most points lay on the infill's floor, and the run was ended as a misfit."""
    layer = small.setup.process.bottom_layers + above_skin - 1
    site, _ = look(small, layer)
    scan = scan_from_above(site, small.placed, 0.1)
    guess = Transform("template", "scanner", small.placed.inverse().matrix)
    found = align(scan, site.template, guess=guess, so_far=planned_so_far(site))
    moved = found.template_from_scan.apply(scan.points_mm)
    off_mm = moved - small.placed.inverse().apply(scan.points_mm) - [0.0, 0.0, 0.1]
    assert np.abs(off_mm).max() < 0.06


def test_walls_that_are_gone_on_one_side_leave_the_pose_alone(small: Small) -> None:
    """Regression: a clog in half a layer of a hull of OrcaSlicer's put the scan 0.35 mm aside."""
    site, _ = look(small, small.setup.process.bottom_layers + 3)
    scan = scan_from_above(site, small.placed, 0.0)
    there = small.placed.inverse().apply(scan.points_mm)
    low, high = small.template.bounds_mm
    top_mm, layer_mm = there[:, 2].max(), small.job.layers[3].height_mm
    gone = (there[:, 1] < 0.5 * (low[1] + high[1])) & (there[:, 2] > top_mm - 0.7 * layer_mm)
    lower = replace(scan, points_mm=scan.points_mm - gone[:, None] * [0.0, 0.0, layer_mm])
    guess = Transform("template", "scanner", small.placed.inverse().matrix)
    options = align_options(site, lower)
    found = align(lower, site.template, guess=guess, so_far=planned_so_far(site), options=options)
    aside_mm = found.template_from_scan.apply(scan.points_mm) - there
    assert np.abs(aside_mm).max() < 0.05


def test_a_site_tells_in_its_templates_frame_what_its_job_leaves(small: Small) -> None:
    site, _ = look(small, small.setup.process.bottom_layers - 1)
    x = np.linspace(4.0, 12.0, 9)
    wall = np.column_stack([x, np.zeros(9), np.full(9, 0.5)])
    normal = np.tile([0.0, -1.0, 0.0], (9, 1))
    assert site.laid is not None
    there, facing = small.placed.apply(wall), small.placed.rotate(normal)
    offset, tolerance = site.laid.expected_offset_mm(there, facing, np.zeros(9))
    assert (tolerance >= 0).all()
    # our own slicer fills a solid layer to a per cent: 4 mm of it and 2.3 % of filament
    assert (offset + tolerance).max() < 0.25
    assert (offset - tolerance).min() > -0.1
    beyond = off_by_job(site, small.placed)
    assert beyond is not None
    out_mm = beyond(wall, np.full(9, site.allowance_mm))
    assert out_mm.max() > 0
    assert (beyond(wall, np.zeros(9)) == 0).all()  # what is within the allowance is not asked
    assert off_by_job(replace(site, laid=None), small.placed) is None


def test_a_sites_options_reach_every_stage_and_its_results_record_them(small: Small) -> None:
    site, _ = look(small, small.setup.process.bottom_layers + 1)
    options = replace(
        site.options,
        align=AlignOptions(least_points=60),
        regions=RegionOptions(false_regions=0.04),
        deficit=DeficitOptions(early_mm3=0.6),
    )
    guess = Transform("template", "scanner", small.placed.inverse().matrix)
    scan = scan_from_above(site, small.placed, 0.0)
    plan = plan_repair(scan, replace(site, options=options), title="x", guess=guess, strict=False)
    assert plan.registration.options == options.align
    # where a job has just printed, nothing that nobody saw stands higher
    heights = replace(options.deficit.heights, unseen_margin_mm=0.0)
    assert plan.deficit.options == replace(options.deficit, heights=heights)
    assert plan.anomaly.options == replace(
        options.regions,
        allowance_mm=site.allowance_mm,
        process_sigma_mm=site.process_sigma_mm,
    )
