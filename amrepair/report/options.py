"""What a run's page is drawn by."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PageOptions:
    """How much of a run its page holds, and how coarsely it draws that.

    Attributes
    ----------
    points
        Of all looks, 15 bytes each in the page; with the plotting library's 4.8 MB all budgets
        used up stay under 15 MB.
    points_per_look, unseen_per_look
        Of one look; and of what was not seen at it.
    expected_faces, expected_edges
        Of the part as it should be, 12 bytes a face; and of its edges.
    faces
        Of what is missing and too much, at all looks.
    beads
        25 bytes each.
    cells
        Of height maps, 3 bytes each.
    samples
        Of each series of temperatures.
    looks
        That are drawn in 3D.
    histogram_bins
        Of deviations.
    aside_ratio
        Of the part's side: a defect so far off its middle is seen from there.
    simplify_mm, simplify_steps
        Triangles that differ from the original by less look the same at any zoom that shows the
        part whole; a bead is eight times as wide. Doubled so many times at most.
    feature_deg
        Sharper than this is an edge of the part, not the facet of a cylinder.
    shading_neighbours
        Of a point, whose plane shades it where it has no normal.
    stray_limits
        So many limits outside, and no excess: it hangs in the air.
    outline_mm
        Outlines of defects from above: finer than a pixel of the drawing.
    left_boxes
        Of what a repair leaves, for one cause; 12 faces each.
    left_out_ratio
        Of what is missing may stay out of reach of a plan that is enough.
    """

    points: int = 300_000
    points_per_look: int = 80_000
    unseen_per_look: int = 8_000
    expected_faces: int = 40_000
    expected_edges: int = 12_000
    faces: int = 100_000
    beads: int = 40_000
    cells: int = 400_000
    samples: int = 2_000
    looks: int = 12
    histogram_bins: int = 80
    aside_ratio: float = 0.15
    simplify_mm: float = 0.01
    simplify_steps: int = 7
    feature_deg: float = 28.0
    shading_neighbours: int = 10
    stray_limits: float = 3.0
    outline_mm: float = 0.05
    left_boxes: int = 4_000
    left_out_ratio: float = 0.05


DEFAULT_PAGE = PageOptions()


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What a live page shows of a run at most.

    Attributes
    ----------
    points
        Of a cloud.
    segments
        Of a job.
    job_steps
        How many pieces the growing part is shown in.
    point_mm, bead_mm
        Size of a point, and of a bead, as drawn.
    """

    points: int = 300_000
    segments: int = 400_000
    job_steps: int = 60
    point_mm: float = 0.25
    bead_mm: float = 0.35


DEFAULT_LIVE = LiveOptions()
