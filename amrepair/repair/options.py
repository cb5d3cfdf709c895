"""The numbers of a repair that come from no profile and no measurement."""

from __future__ import annotations

from dataclasses import dataclass, field

from amrepair.align import AlignOptions
from amrepair.deficit.options import DeficitOptions
from amrepair.regions.options import RegionOptions
from gcode.slicing.options import PatchOptions


@dataclass(frozen=True, slots=True)
class RepairOptions:
    """Which points of a scan are judged, when two repairs are the same, and each stage's options.

    Attributes
    ----------
    planned_edge_mm
        A planned template of the last layers ends below in mid-air. Up to this far from that end
        its distances are not trusted.
    off_the_part_mm, over_beside_mm, on_bed_mm
        A point lies on skirt, brim or supports if it is at least `off_the_part_mm` off the part,
        at most `over_beside_mm` above their planned height, and more than `on_bed_mm` above the
        bed.
    stray_mm
        How far strands of supports, skirts and towers may stray from their planned place.
    just_printed_margin_mm
        Added to the height just printed, where nobody saw what stands: no sensor looks into a deep
        cell of infill or behind a wall. 0, since the head has just been there.
    upright
        A part is upright if its Z axis leaves the bed's by no more than this, as 1 − cosine:
        0.05 mm over 100 mm.
    same_repair_ratio
        Two poses lead to the same repair if their missing volumes overlap by at least this ratio.
    damage_told_within_mm
        How exactly a person shows where on the bed a damage is.
    align, regions, deficit, patch
        Options of the stages. The site itself has the allowances of the process.
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


DEFAULT_REPAIR = RepairOptions()
"""The default of the loop and the command line."""
