"""The numbers of the policy, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from amrepair.deficit.options import DEFAULT_DEFICIT


@dataclass(frozen=True, slots=True)
class PolicyOptions:
    """What is worth a repair, and when enough has been done.

    Attributes
    ----------
    least_mm3
        The least volume of a defect that is repaired; a smaller one is not worth the heat beside
        it. It is a bead 11 mm long, and half of the least that skipped lines leave. Clean prints
        show less (`bench_clean.py`).
    least_skipped_mm3
        The same where lines of the job are missing, since rays that went through are more certain
        than a shallow hollow. Crumbs of a clean look, 0.9 mm³ together where a layer's lines lie
        rough, are each below it.
    line_mm3
        A missing line shorter than this is not counted together with distant ones: 2 mm of a line
        of 0.4 × 0.2 mm.
    crumb_mm3
        A piece smaller than a short bead is no defect and part of none.
    one_defect_mm
        Pieces no farther apart than this are one defect.
    least_excess_mm3
        Excess below this is a seam or two, and is ignored.
    excess_layers
        Excess lower than this many layers is flattened by the layers after it.
    sure
        From this confidence on a run may be stopped or paused without another look.
    doubtful
        Below this confidence another look is taken first.
    thin_layers
        Missing material thinner than this many layers leaves no room for a bead of its own.
    one_layer
        A region lower than this many layers, noise included, lies within a single layer.
    least_layers
        A deviation below this many layers is how a layer's beads differ anyhow.
    least_hit_mm3
        Excess in the head's way counts from this volume on, a drop 0.6 mm across; a smaller one
        bends away or melts under the nozzle.
    lost_ratio
        Where more than this share of an object is missing, too little is left to repair it on.
    least_reach_ratio
        Where the nozzle reaches less than this share, it counts as reaching nothing.
    most_passes
        How many repairs one stop may have.
    stuck_ratio
        Where a repair leaves more than this share of what was missing, it is not repeated: two
        scans of one defect differ by so much. Where nothing came out, 0.87 to 0.97 was left.
    little_ratio
        Where less than this share of what was found at a stop is left, no further pass is made.
    buried_mm3
        A smaller void under later layers (5 × 5 × 0.4 mm) is bridged by them, and is accepted.
    left_ratio
        This share of what was found in the job may be left, or stand out, within tolerance.
    """

    least_mm3: float = 1.0
    least_skipped_mm3: float = 0.6
    line_mm3: float = 0.15
    crumb_mm3: float = DEFAULT_DEFICIT.bead_mm3
    one_defect_mm: float = 1.0
    least_excess_mm3: float = 2.0
    excess_layers: float = 2.0
    sure: float = 0.9
    doubtful: float = 0.25
    thin_layers: float = 0.75
    one_layer: float = 1.75
    least_layers: float = 0.2
    least_hit_mm3: float = 0.1
    lost_ratio: float = 0.5
    least_reach_ratio: float = 0.05
    most_passes: int = 3
    stuck_ratio: float = 0.8
    little_ratio: float = 0.03
    buried_mm3: float = 10.0
    left_ratio: float = 0.08


DEFAULT_POLICY = PolicyOptions()
"""The default of the loop and the command line."""
