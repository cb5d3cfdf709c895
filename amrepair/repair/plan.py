"""One scan's verdict, and the program that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

from amrepair.align.registration import Registration
from amrepair.deficit import Deficit
from amrepair.frames import Transform
from amrepair.policy import USUAL_POLICY, PolicyOptions, acceptance
from amrepair.regions import AnomalyMap, Region
from amrepair.regions.calibrating import Sound
from amrepair.scans import Scan
from gcode.check import CheckedProgram
from gcode.estimate import Estimate
from gcode.slicing.patch import PatchPlan


@dataclass(frozen=True, slots=True)
class RepairPlan:
    """One scan's verdict, and the program that follows from it.

    Attributes
    ----------
    checked
        The program that fills what is missing; None where there is nothing that a bead can fill.
    build_from_scan
        Where the scan lies on the bed.
    scan
        What was judged, in the template's frame.
    policy
        By what was decided which regions are worth a repair.
    refused
        Why the checker refused the program, where it did and the caller wanted to go on.
    beds
        What the bed beside the part showed of the scanner's errors, in this look and in earlier
        ones of its run.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template, plan_repair, read_scan
    >>> site = Site.of_part(open_template(Path("part.safetensors")), gcode.load_setup())
    >>> plan = plan_repair(read_scan(Path("scan.ply"), frame="build"), site, title="repair")
    >>> plan.within_tolerance, len(plan.to_fill), plan.too_much
    (False, 1, ())
    >>> round(plan.unreachable_mm3 / plan.deficit.missing_mm3, 1)  # a strip beside the cliff
    0.2
    """

    registration: Registration
    anomaly: AnomalyMap
    deficit: Deficit
    build_from_scan: Transform
    layer_height_mm: float
    scan: Scan
    policy: PolicyOptions = USUAL_POLICY
    patch: PatchPlan | None = None
    checked: CheckedProgram | None = None
    estimate: Estimate | None = None
    refused: str = ""
    beds: tuple[Sound, ...] = ()

    @property
    def build_from_template(self) -> Transform:
        """Where the part stands on the bed, as this scan shows it."""
        return self.build_from_scan @ self.registration.template_from_scan.inverse()

    @property
    def to_fill(self) -> tuple[Region, ...]:
        """Missing regions that are worth a repair: alone, or with those beside them."""
        return acceptance.to_fill(self.deficit.regions, self.policy)

    @property
    def too_much(self) -> tuple[Region, ...]:
        """Regions in excess that stand out."""
        return acceptance.too_much(self.deficit.regions, self.layer_height_mm, self.policy)

    @property
    def within_tolerance(self) -> bool:
        """No region is left that is worth a repair, or that stands out."""
        return not self.to_fill and not self.too_much

    @property
    def unreachable_mm3(self) -> float:
        """Missing volume that the nozzle cannot get to."""
        return float(sum(u.volume_mm3 for u in self.patch.unreachable)) if self.patch else 0.0

    @property
    def unprintable_mm3(self) -> float:
        """Missing volume that no bead fits, or that holds none."""
        return float(sum(u.volume_mm3 for u in self.patch.unprintable)) if self.patch else 0.0
