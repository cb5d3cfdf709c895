"""A site: what is expected at one place and moment, and so all that a scan is compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align.registration import Registration
from amrepair.arrays import ColumnMask, Mask
from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.policy import DEFAULT_POLICY, PolicyOptions
from amrepair.regions import AnomalyMap, detect
from amrepair.regions.error_calibration import Calibration
from amrepair.regions.error_calibration_fit import Sound
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.repair.options import DEFAULT_REPAIR, RepairOptions
from amrepair.scans import Scan
from amrepair.template.laid import LaidBeads
from amrepair.template.port import Template
from gcode.profiles import PrintSetup
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid
from gcode.surfaces import HeightField

Detector = Callable[..., AnomalyMap]
"""The function that finds regions: `detect`, or one that asks another process to run it."""


@dataclass(frozen=True, slots=True)
class Raft:
    """A raft that a job lays under a part, so that the part's foot is above the bed.

    Attributes
    ----------
    height_mm
        How high the part's foot is above the bed.
    reach_mm
        How far the raft reaches beyond the part.
    """

    height_mm: float
    reach_mm: float


@dataclass(frozen=True, slots=True)
class Finished:
    """Finished objects of a sequential job, which stand beside the one being printed.

    Attributes
    ----------
    standing
        Their heights, build frame, over all that the nozzle reaches.
    theirs
        (ny, nx) columns of `standing` that are nearer to them than to the object being printed;
        scan points there belong to them.
    """

    standing: HeightField
    theirs: ColumnMask

    def own(self, xy_mm: Float[np.ndarray, "n 2"]) -> Mask:
        """(n,) which places, build frame, belong to the finished objects."""
        index = self.standing.cells_of(xy_mm)
        inside = ((index >= 0) & (index < self.standing.shape)).all(axis=1)
        index[~inside] = 0
        return np.asarray(inside & self.theirs[index[:, 0], index[:, 1]])


@dataclass(frozen=True, slots=True)
class Site:
    """What is expected at one place and moment: all that a scan is compared with.

    Only `template`, `setup` and `grid` are always needed. For a scan in mid-job the loop adds what
    the job has printed so far (`amrepair.loop.sites`).

    Attributes
    ----------
    template
        The expected geometry: the finished part, or the part cut at the layer just printed. The
        scan is aligned to it.
    setup
        The profiles of printer, material and process.
    grid
        The job's layers; the layers of a repair lie on them.
    build_from_template
        Where the part stands on the bed. None where the scan is in the build frame, so that the
        alignment tells.
    printed_z_mm
        The height printed so far, build frame; None for a finished part.
    allowance_mm
        How far off the template the process may leave a surface: half a layer for a CAD template,
        0 for planned beads.
    process_sigma_mm
        By how much the surface of sound parts wanders as a whole; about a quarter of a layer.
    calibration
        The errors of this scanner on sound parts; None takes what the scan itself tells.
    beds
        The scanner's errors as the bed beside the part showed them in earlier looks.
    planned
        For a part with open infill: a template of the job's own beads, by which the last
        millimetres are judged instead of by `template`.
    on_fixture
        Whether somebody said that a finished part's foot is above the bed.
    part_is_known
        Whether somebody said that the scan shows this part, so that `align` accepts a poorer fit.
    damage_at_mm
        (2,) where on the bed, as somebody said, the largest damage is: this tells the poses of a
        symmetric part apart.
    beads
        The topmost beads that the job has laid, template frame; skipped lines are looked for among
        them.
    lines
        All lines that the job has laid, build frame; a patch may follow them.
    surface
        Points and normals of the expected surface, made beforehand for `detect`.
    beside
        Heights of skirt, brim and supports that the template does not have, build frame; −inf
        where there are none. They belong to no part, and are never too much.
    strands
        Heights of supports that the planned template does have, build frame. Their strands may
        stray, so within that distance nothing is missing or too much there.
    raft
        The raft under the part; None where it stands on the bed.
    finished
        Finished objects of a sequential job; None where there are none.
    laid
        The job's beads so far, build frame. Where the job's own path puts plastic beyond the
        template (heights rounded up, no room for a bead), that is not too much.
    detector
        The function that finds the regions.
    options, policy
        The numbers that come from no profile and no measurement.

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
    options: RepairOptions = DEFAULT_REPAIR
    policy: PolicyOptions = DEFAULT_POLICY

    @classmethod
    def of_part(
        cls, template: Template, setup: PrintSetup, *, build_from_template: Transform | None = None
    ) -> Site:
        """A finished part on the layers of the process profile."""
        return cls(template, setup, LayerGrid.from_setup(setup), build_from_template)

    @property
    def others(self) -> HeightField | None:
        """Heights of the job's finished objects, build frame; None where there are none."""
        return None if self.finished is None else self.finished.standing

    @property
    def expected(self) -> Template:
        """What the scan is judged by: the planned template where there is one."""
        return self.planned or self.template

    def stands_at(self, scan: Scan, registration: Registration) -> Transform:
        """The part's pose, build from template: as told, or from a scan in the build frame.

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
