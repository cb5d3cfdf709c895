"""What detection says: a label for every scan point and every template surface point, regions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, StrEnum

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Numbers, Points, Values
from amrepair.field.as_built import Evidence
from amrepair.observe.as_made import as_made
from amrepair.observe.nuisance import Nuisance
from amrepair.observe.views import Contradiction
from amrepair.regions.calibration import Calibration
from amrepair.regions.noise import Noise
from amrepair.regions.options import RegionOptions
from amrepair.regions.sites import Sites
from amrepair.template.port import Template


class Label(IntEnum):
    """Labels as they stand in `anomaly.npz`."""

    OK = 0  # for template points: present
    MISSING = 1
    EXCESS = 2
    UNSEEN = 3


class DefectType(StrEnum):
    """Kinds of defects, in the words of the command line."""

    VOID = "void"
    UNDER_EXTRUSION = "under_extrusion"
    CHIP = "chip"
    MISSING_BEADS = "missing_beads"
    OVER_EXTRUSION = "over_extrusion"
    BLOB = "blob"
    STRING = "string"
    SAG = "sag"
    LAYER_SHIFT = "layer_shift"
    WARP = "warp"
    DETACHED = "detached"
    CLOG = "clog"


@dataclass(frozen=True, slots=True)
class Region:
    """A connected defect in the template frame.

    Attributes
    ----------
    label
        MISSING or EXCESS.
    box_mm
        (2, 3) lowest and highest corner.
    depth_mm
        The largest |deviation| in it.
    below_bead
        Too small for one bead to fix.
    confidence
        That it is there and is of that type, 0 to 1; 1 where nobody has judged it.
    skipped
        Lines of the job are gone in it (`regions.skipped`).
    p_value
        Expected number of false regions in a scan that stand out as much; NaN where no test was.
    """

    label: Label
    type: DefectType
    volume_mm3: float
    area_mm2: float
    depth_mm: float
    box_mm: Float[np.ndarray, "2 3"]
    below_bead: bool = False
    confidence: float = 1.0
    skipped: bool = False
    p_value: float = float("nan")

    @property
    def thickness_mm(self) -> float:
        """Mean thickness: the volume over half the surface, which is one side of a flat piece."""
        return float(self.volume_mm3 / max(self.area_mm2, 1e-9))

    @property
    def height_mm(self) -> float:
        """From the lowest to the highest point."""
        return float(np.ptp(self.box_mm[:, 2]))


@dataclass(frozen=True, slots=True)
class AnomalyMap:
    """Scores and labels, template frame.

    Attributes
    ----------
    points_mm
        (n, 3) scan points in the template frame, in the scan's own order.
    deviation_mm
        (n,) f at each point: negative inside the template.
    score
        (n,) A(x) = |f(x)| (PASDF, the anomaly score).
    label
        (n,) `Label` of each scan point; background (bed, far clutter) is OK.
    template_points_mm
        (m, 3) template surface points.
    template_label
        (m,) OK (present), MISSING or UNSEEN.
    threshold_mm, threshold_source
        The limit and how it was set.
    object_score
        Mean of the K highest scores.
    top_z_mm, top_threshold_mm
        The plane of the layer just printed, under which a smaller limit holds; None where there
        is none.
    evidence, surfel_label, surfel_higher_mm
        What the labels rest on, for the deficit, and (s,) how far out of the template each surfel
        may be, by what normal parts differ and the process was told; None for a map read back
        from a file.
    sites
        What the test looked at; None for a map read back from a file.
    noise, nuisance, contradicting
        What the scan told of its errors, what belongs to the whole part (None where the pose is
        told), and views that were left out.
    calibration, options
        What stood in for the scan's own word on its errors, and what the test was set to.
    chance_mm
        By rising width of windows: how far beyond what is allowed sound places may seem to lie too
        low by chance, in the narrowest; in wider ones, those where the scanner errs most.
    """

    points_mm: Points
    deviation_mm: Values
    score: Values
    label: Numbers
    template_points_mm: Float[np.ndarray, "m 3"]
    template_label: Int[np.ndarray, " m"]
    threshold_mm: float
    threshold_source: str
    object_score: float
    regions: tuple[Region, ...]
    evidence: Evidence | None = None
    surfel_label: Int[np.ndarray, " s"] | None = None
    surfel_higher_mm: Float[np.ndarray, " s"] | None = None
    top_z_mm: float | None = None
    top_threshold_mm: float = np.inf
    sites: Sites | None = None
    noise: Noise | None = None
    nuisance: Nuisance | None = None
    contradicting: tuple[Contradiction, ...] = ()
    calibration: Calibration | None = None
    options: RegionOptions | None = None
    chance_mm: tuple[tuple[float, float], ...] = ()

    def expected(self, template: Template) -> Template:
        """The template that labels and evidence are held against: as the whole part was made."""
        return as_made(template, self.nuisance)

    def told_over_mm(self, deep_mm: float) -> float:
        """Over what length something so deep is told from errors; 0: over as little as any is."""
        far_off = [k for k, (_, off_mm) in enumerate(self.chance_mm) if off_mm > deep_mm]
        if not far_off:
            return 0.0
        return [*(width_mm for width_mm, _ in self.chance_mm), np.inf][far_off[-1] + 1]

    def told(self) -> tuple[str, ...]:
        """What belongs to the whole part or to whole views, or was not judged, in sentences."""
        whole = () if self.nuisance is None else self.nuisance.told()
        by = self.calibration
        judged = () if by is None or by.is_normal else (by.told(),)
        noise = self.noise
        unjudged = () if noise is None or not noise.too_sparse else (noise.told_sparse(),)
        return (*judged, *unjudged, *(one.told() for one in self.contradicting), *whole)
