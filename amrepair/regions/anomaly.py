"""The result of detection: labels of scan points and of the template's surface, and regions."""

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
from amrepair.regions.error_calibration import Calibration
from amrepair.regions.inspected import Inspected
from amrepair.regions.noise import Noise
from amrepair.regions.options import RegionOptions
from amrepair.template.port import Template


class Label(IntEnum):
    """Labels, numbered as in `anomaly.npz`."""

    OK = 0  # for template points: present
    MISSING = 1
    EXCESS = 2
    UNSEEN = 3


class DefectType(StrEnum):
    """Types of defects, in the words of the command line."""

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
        (2, 3) lowest and highest corner of its box.
    depth_mm
        The largest |deviation| in it.
    below_bead
        Whether it is too small for a single bead.
    confidence
        How sure it is, from 0 to 1, that the defect is there and of this type; 1 where this was
        not judged.
    skipped
        Whether lines of the job are missing in it (`regions.skipped`).
    p_value
        How many regions at least as significant a scan of a sound part is expected to show; NaN
        where no test was made.
    told
        What is known of it beyond its type, for people: of shifted layers how far, and which.
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
    told: str = ""

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
    """What was found on a scan and on the template's surface, template frame.

    Attributes
    ----------
    points_mm
        (n, 3) scan points in the template frame, in the scan's own order.
    deviation_mm
        (n,) f at each point: negative inside the template.
    score
        (n,) A(x) = |f(x)| (PASDF, the anomaly score).
    label
        (n,) `Label` of each scan point; background (the bed, clutter) is OK.
    template_points_mm
        (m, 3) points spread over the template's surface.
    each_mm2
        The area that each of them stands for.
    template_label
        (m,) `Label` of each of them: OK (present), MISSING or UNSEEN.
    threshold_mm, threshold_source
        The deviation that counts as a defect, and how it came about, in a sentence.
    object_score
        The mean of the K highest scores (PASDF).
    top_z_mm, top_threshold_mm
        The plane of the layer just printed and the smaller threshold that holds under it; None and
        infinite where there is no such plane.
    evidence, surfel_label, surfel_higher_mm
        For the deficit: what the labels rest on, (s,) the label of each surfel, and (s,) how far
        outside the template each surfel may lie without being excess. None for a map that was read
        back from a file.
    inspected
        The places that were tested; None for a map read back from a file.
    noise, nuisance, contradicting
        The scan's errors as it tells them itself; what was subtracted as belonging to the whole
        part (None where the pose was told); and the views that were left out.
    calibration, options
        The calibration that was used in place of the scan's own errors, if any, and the options.
    chance_mm
        Pairs of a window's width and a depth, by rising width: how far beyond the tolerance a
        sound place may seem to lie too low by chance.
    """

    points_mm: Points
    deviation_mm: Values
    score: Values
    label: Numbers
    template_points_mm: Float[np.ndarray, "m 3"]
    each_mm2: float
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
    inspected: Inspected | None = None
    noise: Noise | None = None
    nuisance: Nuisance | None = None
    contradicting: tuple[Contradiction, ...] = ()
    calibration: Calibration | None = None
    options: RegionOptions | None = None
    chance_mm: tuple[tuple[float, float], ...] = ()

    def expected(self, template: Template) -> Template:
        """The template as the whole part was made, to which labels and evidence refer."""
        return as_made(template, self.nuisance)

    def told_over_mm(self, deep_mm: float) -> float:
        """Over which length something so deep is told from errors; 0 if the least will do."""
        far_off = [k for k, (_, off_mm) in enumerate(self.chance_mm) if off_mm > deep_mm]
        if not far_off:
            return 0.0
        return [*(width_mm for width_mm, _ in self.chance_mm), np.inf][far_off[-1] + 1]

    def told(self) -> tuple[str, ...]:
        """Sentences on what belongs to the whole part or a whole view, or was not judged."""
        whole = () if self.nuisance is None else self.nuisance.told()
        by = self.calibration
        judged = () if by is None or by.is_normal else (by.told(),)
        noise = self.noise
        unjudged = () if noise is None or not noise.too_sparse else (noise.told_sparse(),)
        return (*judged, *unjudged, *(one.told() for one in self.contradicting), *whole)
