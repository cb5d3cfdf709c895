"""The plan of a repair: what one scan showed, and the program that follows from it."""

from __future__ import annotations

from dataclasses import dataclass

from amrepair.align.registration import Registration
from amrepair.deficit import Deficit
from amrepair.frames import Transform
from amrepair.policy import DEFAULT_POLICY, PolicyOptions, acceptance
from amrepair.regions import AnomalyMap, Region
from amrepair.regions.error_calibration_fit import Sound
from amrepair.scans import Scan
from gcode.check import CheckedProgram
from gcode.estimate import Estimate
from gcode.slicing.patch import PatchPlan, PatchRegion


@dataclass(frozen=True, slots=True)
class CoveredLayers:
    """Layers of a job that lack plastic under later ones, where no look from above sees it.

    Attributes
    ----------
    first, last
        Indices of the layers.
    lacking_ratio
        Share of their plastic that did not come out.
    piece
        What of that stays open, of which the nozzle reaches nothing.
    """

    first: int
    last: int
    lacking_ratio: float
    piece: PatchRegion

    @property
    def told(self) -> str:
        """One sentence for people."""
        which = (
            f"layer {self.first} lacks"
            if self.first == self.last
            else f"layers {self.first} to {self.last} lack"
        )
        return (
            f"{which} about {100.0 * self.lacking_ratio:.0f} % of the plastic, by how far their "
            f"walls stand in: {self.piece.volume_mm3:.0f} mm³ lie open inside, under later layers"
        )


@dataclass(frozen=True, slots=True)
class RepairPlan:
    """What one scan showed, stage by stage, and the program that follows from it.

    Attributes
    ----------
    registration, anomaly, deficit
        The results of alignment, detection, and of making solids.
    build_from_scan
        Where the scan lies on the bed.
    scan
        The points that were judged, in the template's frame.
    policy
        The limits by which it is decided which regions are worth a repair.
    patch, checked, estimate
        The sliced beads, the checked program, its time and material. Each is None where the stage
        was not reached: nothing is worth a repair, no bead fits, or the checker refused.
    refused
        The checker's reason, where it refused the program and the caller did not want an error.
    beds
        The scanner's errors as the bed beside the part showed them, in this look and in earlier
        looks of the same run.
    covered
        Layers that lack plastic under later ones; None where none are told, or nobody asked.
    shifted_from
        The first of the layers that lie aside of those below; None where none are told.

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
    policy: PolicyOptions = DEFAULT_POLICY
    patch: PatchPlan | None = None
    checked: CheckedProgram | None = None
    estimate: Estimate | None = None
    refused: str = ""
    beds: tuple[Sound, ...] = ()
    covered: CoveredLayers | None = None
    shifted_from: int | None = None

    @property
    def build_from_template(self) -> Transform:
        """The part's pose on the bed, as this scan shows it."""
        return self.build_from_scan @ self.registration.template_from_scan.inverse()

    @property
    def to_fill(self) -> tuple[Region, ...]:
        """The missing regions that are worth a repair."""
        return acceptance.to_fill(self.deficit.regions, self.policy)

    @property
    def too_much(self) -> tuple[Region, ...]:
        """The regions of excess that are too much."""
        return acceptance.too_much(self.deficit.regions, self.layer_height_mm, self.policy)

    @property
    def within_tolerance(self) -> bool:
        """Whether nothing is worth a repair and nothing is too much."""
        return not self.to_fill and not self.too_much

    @property
    def unreachable_mm3(self) -> float:
        """The missing volume that the nozzle cannot reach."""
        return float(sum(u.volume_mm3 for u in self.patch.unreachable)) if self.patch else 0.0

    @property
    def unprintable_mm3(self) -> float:
        """The missing volume into which no bead fits, or in which none would hold."""
        return float(sum(u.volume_mm3 for u in self.patch.unprintable)) if self.patch else 0.0
