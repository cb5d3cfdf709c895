"""The numbers of a repair that no profile and no measurement gives."""

from __future__ import annotations

from dataclasses import dataclass, field

from amrepair.align import AlignOptions
from amrepair.deficit.options import DeficitOptions
from amrepair.regions.options import RegionOptions
from gcode.slicing.options import PatchOptions


@dataclass(frozen=True, slots=True)
class RepairOptions:
    """What of a scan is held against the template, and when two repairs are the same.

    Attributes
    ----------
    planned_edge_mm
        A planned template ends below; so near to its end its distances are not to be trusted.
    off_the_part_mm, over_beside_mm, on_bed_mm
        What lies beside the part: so far off it, no higher than it was to be by this much, and
        higher than what is taken for the bed.
    stray_mm
        Strands of supports spread and stray by so much; skirts and towers, too.
    just_printed_margin_mm
        What is added, where nobody saw it, to the height that a job has just printed to: no sensor
        sees into a deep cell of infill, or behind a wall, and the head has just been there.
    upright
        A part stands upright where its Z is the bed's: 1 − cos of 0.05 mm over 100 mm.
    same_repair_ratio
        Two poses whose repairs share less than this are two different repairs.
    damage_told_within_mm
        A hand shows where on the bed a damage is no more exactly than this.
    align, regions, deficit, patch
        Of each stage. What the process may leave, and how far it wanders, is the site's.
    """

    planned_edge_mm: float = 1.0
    off_the_part_mm: float = 0.3
    over_beside_mm: float = 0.3
    on_bed_mm: float = 0.2
    stray_mm: float = 0.4
    just_printed_margin_mm: float = 0.0
    upright: float = 1e-7
    same_repair_ratio: float = 0.8
    damage_told_within_mm: float = 3.0
    align: AlignOptions = field(default_factory=AlignOptions)
    regions: RegionOptions = field(default_factory=RegionOptions)
    deficit: DeficitOptions = field(default_factory=DeficitOptions)
    patch: PatchOptions = field(default_factory=PatchOptions)


USUAL_REPAIR = RepairOptions()
"""What the loop and the command line go by."""
