"""What is expected where: all that a scan is held against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.registration import Registration
from amrepair.arrays import ColumnMask, Mask
from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.policy import USUAL_POLICY, PolicyOptions
from amrepair.regions import AnomalyMap, detect
from amrepair.regions.calibrating import Sound
from amrepair.regions.calibration import Calibration
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.repair.options import USUAL_REPAIR, RepairOptions
from amrepair.scans import Scan
from amrepair.template.laid import LaidBeads
from amrepair.template.port import Template
from gcode.profiles import PrintSetup
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid
from gcode.surfaces import HeightField

Detector = Callable[..., AnomalyMap]
"""`detect`, or what asks another process for the same."""


@dataclass(frozen=True, slots=True)
class Raft:
    """What a job lays under a part, so that its foot is not on the bed.

    Attributes
    ----------
    height_mm
        How high over the bed the part's foot is.
    reach_mm
        How far out of the part the raft goes.
    """

    height_mm: float
    reach_mm: float


@dataclass(frozen=True, slots=True)
class Finished:
    """Objects of a job that have come to their end, beside the one that is printed now.

    Attributes
    ----------
    standing
        How high they stand, build frame, on the whole reach of the nozzle.
    theirs
        (ny, nx) columns of it that are nearer to them than to the one that is printed now: what a
        scan shows there is none of it.
    """

    standing: HeightField
    theirs: ColumnMask

    def own(self, xy_mm: Float[np.ndarray, "n 2"]) -> Mask:
        """(n,) which places, build frame, are theirs."""
        index = self.standing.cells_of(xy_mm)
        inside = ((index >= 0) & (index < self.standing.shape)).all(axis=1)
        index[~inside] = 0
        return np.asarray(inside & self.theirs[index[:, 0], index[:, 1]])


@dataclass(frozen=True, slots=True)
class Site:
    """What is expected where: all that a scan is held against.

    Attributes
    ----------
    template
        The expected geometry at this moment (a layer's cut, or the finished part); the scan is
        aligned to it.
    planned
        Where the inside is planned to be open: the job's own beads, in the template's frame, by
        which the last millimetres are judged instead.
    setup
        Printer, material, process.
    grid
        Layers of the job: repair layers lie on them.
    build_from_template
        Where the part stands on the bed; None where the scan is in the build frame and the
        alignment itself says so.
    printed_z_mm
        Height printed so far, build frame; None for a finished part.
    allowance_mm
        What the process may leave (half a layer for a CAD template, 0 for planned beads).
    process_sigma_mm
        By how much sound parts of the process depart as a whole: a quarter of a layer.
    calibration
        What sound parts look like to this scanner; None: as the scan itself tells.
    beds
        What the bed beside the part showed of the scanner's errors in earlier looks.
    on_fixture
        Somebody said that a finished part's foot is above the bed.
    part_is_known
        Somebody said that the scan shows this part: less of it has to fit, as of `align`.
    damage_at_mm
        (2,) where on the bed somebody said that the largest damage is; it tells the poses of a
        symmetric part apart.
    beads
        What the job has laid so far, template frame: lines that were skipped are looked for.
    lines
        The same, all of it, build frame: a patch is laid along them.
    surface
        Points of what is expected and their normals, as `detect` asks for them: made beforehand.
    beside
        How high skirt, brim and supports stand beside the part, build frame, where the template
        does not have them; −inf where nothing does. They are none of the part, nor too much.
    strands
        How high supports stand that are planned, too, and strands may stray, build frame: they are
        judged, but by as much as they may stray nothing there is too much or missing.
    raft
        What a job lays under the part; None where it stands on the bed.
    finished
        Objects of the job that have come to their end; None where it prints all at once, or the
        first of them.
    laid
        The job's beads so far, build frame: what its own path puts beyond what is expected
        (heights that are rounded up, plastic that has no room) is not too much.
    detector
        What finds the regions: `detect`, or what asks another process for the same.
    options, policy
        Numbers that are neither a profile's nor a measurement's.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template
    >>> site = Site.of_part(open_template(Path("part.safetensors")), gcode.load_setup())
    >>> site.setup.printer.id, site.grid.layer_height_mm
    ('prusa_mk3s', 0.2)
    """

    template: Template
    setup: PrintSetup
    grid: LayerGrid
    build_from_template: Transform | None = None
    printed_z_mm: float | None = None
    allowance_mm: float = 0.1
    process_sigma_mm: float = 0.05
    calibration: Calibration | None = None
    beds: tuple[Sound, ...] = ()
    planned: Template | None = None
    on_fixture: bool = False
    part_is_known: bool = False
    damage_at_mm: tuple[float, float] | None = None
    beads: PlannedBeads | None = None
    lines: JobLines | None = None
    surface: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]] | None = None
    beside: HeightField | None = None
    strands: HeightField | None = None
    raft: Raft | None = None
    finished: Finished | None = None
    laid: LaidBeads | None = None
    detector: Detector = detect
    options: RepairOptions = USUAL_REPAIR
    policy: PolicyOptions = USUAL_POLICY

    @classmethod
    def of_part(
        cls, template: Template, setup: PrintSetup, *, build_from_template: Transform | None = None
    ) -> Site:
        """A finished part on the layers of the process profile."""
        return cls(template, setup, LayerGrid.from_setup(setup), build_from_template)

    @property
    def others(self) -> HeightField | None:
        """What else of the job stands on the bed, build frame; None where nothing does."""
        return None if self.finished is None else self.finished.standing

    @property
    def expected(self) -> Template:
        """What the scan is judged by: the job's own beads where they are known."""
        return self.planned or self.template

    def stands_at(self, scan: Scan, registration: Registration) -> Transform:
        """Build from template: as told, or as seen by a scan that is in the build frame.

        Raises
        ------
        AlignmentError
            If neither says so.
        """
        if self.build_from_template is not None:
            return self.build_from_template
        if scan.frame != "build":
            raise AlignmentError(
                f"the scan {scan.source} is in frame '{scan.frame}' and nobody said where the "
                "part stands on the bed; give its pose, since an aligned shape does not tell"
            )
        return registration.template_from_scan.inverse()
