"""The numbers of the policy, each once, with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from amrepair.deficit.options import USUAL_DEFICIT


@dataclass(frozen=True, slots=True)
class PolicyOptions:
    """What is worth a repair, and when enough has been done.

    Attributes
    ----------
    least_mm3
        A defect below is left: heat beside the wound must be worth it. It is a bead 11 mm long,
        half of the least that skipped lines leave; clean prints show less (`bench_clean.py`).
    least_skipped_mm3
        The same where lines of the job are gone: rays that went through are surer than a shallow
        hollow. A clean look's crumbs, 0.9 mm³ together where a layer's lines lie rough, are below.
    line_mm3
        What a gone line lacks at least to be counted with others: 2 mm of one of 0.4 × 0.2 mm.
    crumb_mm3
        Less than a short bead: it joins nothing, and is worth nothing.
    one_defect_mm
        What lies this near to a defect belongs to it.
    least_excess_mm3
        What stands out and is less is a seam or two; nothing takes so little away.
    excess_layers
        Standing out less than this, material is ploughed by the layers after it.
    sure
        Confidence from which a run is ended, or halted, without another look.
    doubtful
        Confidence below which another look is taken.
    thin_layers
        A bead laid into less than this has no room under the nozzle.
    one_layer
        What is lower than this, noise and all, lies within one layer.
    least_layers
        Less than this is within what a layer's beads differ by themselves.
    least_hit_mm3
        A drop 0.6 mm across: less bends away, or melts under the nozzle.
    lost_ratio
        An object of which more is gone has nothing left that a repair could stand on.
    least_reach_ratio
        Where the nozzle reaches less than this share, nothing can be reached.
    most_passes
        Repairs at one stop.
    stuck_ratio
        A repair that leaves more than this share of what it found has met something else.
    little_ratio
        Less than this share of what was found at a stop is not worth another pass.
    buried_mm3
        What stays open inside and is less, 5 × 5 × 0.4 mm, is spanned by the layers over it.
    left_ratio
        Of what was found in the job: so much may be left, or stand out, within tolerance.
    """

    least_mm3: float = 1.0
    least_skipped_mm3: float = 0.6
    line_mm3: float = 0.15
    crumb_mm3: float = USUAL_DEFICIT.bead_mm3
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


USUAL_POLICY = PolicyOptions()
"""What the loop and the command line go by."""
