"""Walls in mid-job: as sharp as the job's lines, where what is missing begins."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest

from amrepair.deficit import lines_beside, with_others
from amrepair.deficit.line_heights import standing_lines
from gcode.slicing.job_lines import JobLines
from gcode.surfaces import HeightField

LAYER_MM, WIDE_MM, TOP_MM = 0.2, 0.5, 2.0
HOLE_MM = (10.1, 12.15)  # in X: on no edge of a coarse cell


def job() -> JobLines:
    """Ten layers of twenty lines along Y, 10 × 20 mm, from X 5 to 15."""
    x = 5.0 + WIDE_MM * (np.arange(20) + 0.5)
    tops = LAYER_MM * (np.arange(10) + 1)
    xy = np.stack(np.meshgrid(x, tops), axis=-1).reshape(-1, 2)
    start, end = (np.stack([xy[:, 0], np.full(len(xy), y), xy[:, 1]], axis=1) for y in (5.0, 25.0))
    n = len(xy)
    section = np.full(n, WIDE_MM * LAYER_MM)
    return JobLines(start, end, section, np.full(n, LAYER_MM), np.zeros(n, bool))


def missing() -> manifold3d.Manifold:
    """A hole from the top, six layers deep; it reaches above the top, as solids do."""
    size = (HOLE_MM[1] - HOLE_MM[0], 4.0, 1.2)
    return manifold3d.Manifold.cube(size).translate((HOLE_MM[0], 12.0, TOP_MM - 1.2))


def seen(cell_mm: float = 0.25) -> HeightField:
    """As a scan has it: a cell is as high as the highest thing in it."""
    n = int(30 / cell_mm)
    edges = cell_mm * np.arange(n)
    stands = (edges + cell_mm > 5.0) & (edges < 15.0)
    inside_x = (edges >= HOLE_MM[0]) & (edges + cell_mm <= HOLE_MM[1])
    inside_y = (edges >= 12.0) & (edges + cell_mm <= 16.0)
    z = np.where(stands[None, :] & ((edges + cell_mm > 5.0) & (edges < 25.0))[:, None], TOP_MM, 0.0)
    z[np.ix_(inside_y, inside_x)] = TOP_MM - 1.2
    return HeightField(np.zeros(2), cell_mm, z, np.ones((n, n), bool))


def at(field: HeightField, x_mm: float, y_mm: float = 14.0) -> float:
    return float(field.sample(np.array([[x_mm, y_mm]]))[0])


def test_a_void_is_as_wide_as_it_is() -> None:
    coarse = seen()
    sharp = standing_lines(coarse, job(), missing())
    assert sharp.cell_mm < coarse.cell_mm
    just_in = (HOLE_MM[0] + 0.06, HOLE_MM[1] - 0.06)
    assert [at(coarse, x) for x in just_in] == [TOP_MM, TOP_MM]  # as far as a cell goes
    for x_mm in just_in:
        assert at(sharp, x_mm) == pytest.approx(TOP_MM - 1.2, abs=1e-6)
    for x_mm in (HOLE_MM[0] - 0.15, HOLE_MM[1] + 0.15, 7.0):
        assert at(sharp, x_mm) == pytest.approx(TOP_MM)
    assert at(sharp, 4.8) == pytest.approx(0.0)  # the part's own wall, near by


def test_what_was_seen_lower_is_no_line_that_stands() -> None:
    coarse = seen()
    also_gone = coarse.z_mm.copy()
    also_gone[56, 52:56] = 0.8  # X 13 to 14, Y 14: in none of the solids
    sharp = standing_lines(
        HeightField(coarse.origin_mm, coarse.cell_mm, also_gone, coarse.seen), job(), missing()
    )
    assert at(sharp, 13.5, 14.1) == pytest.approx(0.8)


def test_what_stands_out_stays() -> None:
    coarse = seen()
    crumb = coarse.z_mm.copy()
    crumb[55:57, 44] = TOP_MM + 1.0  # on the floor of the hole, X 11
    sharp = standing_lines(
        HeightField(coarse.origin_mm, coarse.cell_mm, crumb, coarse.seen), job(), missing()
    )
    assert at(sharp, 11.1) == pytest.approx(TOP_MM + 1.0)


def test_what_the_job_laid_higher_beside_the_part_is_in_the_heads_way() -> None:
    # regression: of another object of the job, which went on after this one had ended, the head
    # knew no more than what lies within a nozzle's cone of the part
    around = HeightField(np.array([-8.0, 0.0]), 0.25, np.zeros((40, 40)), np.ones((40, 40), bool))
    lines = job()
    assert lines_beside(around, lines, over_mm=TOP_MM + 0.1) is None
    beside = lines_beside(around, lines, over_mm=0.9)
    assert beside is not None
    joined = with_others(around, beside)
    assert at(joined, 10.0) == pytest.approx(TOP_MM)
    assert at(joined, 3.0) == at(joined, -4.0, 5.0) == 0.0
    assert at(joined, 4.0) == at(joined, 16.0) == 0.0
    # of what lies in the field itself it is the scan that tells
    assert lines_beside(seen(), lines, over_mm=0.9) is None
