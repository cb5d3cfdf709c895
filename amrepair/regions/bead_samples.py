"""Bead samples: places along planned beads, moved to where the beads truly lie."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field.as_built import Evidence
from amrepair.regions.bead_paths import LEVEL, BeadPaths
from amrepair.regions.beads_as_laid import UP, HangingBeads, sunk_below_layer_mm, wall_shift_mm
from amrepair.regions.options import SkippedOptions
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.template.port import Template


@dataclass(frozen=True, slots=True)
class BeadSamples:
    """Places along beads, with what is known of the bead at each.

    Attributes
    ----------
    middle_mm
        (k, 3) places in the middle of the bead.
    half_mm, width_mm, along
        (k,) half the bead's height, its width, and (k, 2) its direction as seen from above.
    sunk_mm
        (k,) how much lower than planned it was laid.
    rays_mm
        (k,) how far rays passed clear of the middle: positive where they went through.
    strays
        (k,) whether the bead may lie off its planned place.
    """

    middle_mm: Points
    half_mm: Values
    width_mm: Values
    along: Float[np.ndarray, "k 2"]
    sunk_mm: Values
    rays_mm: Values
    strays: Mask

    @classmethod
    def planned(cls, paths: BeadPaths) -> BeadSamples:
        """Samples where the job has them; rays and sinking are not known yet."""
        lines, line = paths.lines, paths.line
        half_mm, width_mm = 0.5 * lines.height_mm[line], lines.width_mm[line]
        over_mm = (lines.end_mm - lines.start_mm)[line, :2]
        along = over_mm / np.maximum(np.linalg.norm(over_mm, axis=1), LEVEL)[:, None]
        sunk_mm, rays_mm = np.zeros((2, len(line)))
        strays = np.zeros(len(line), bool) if lines.strays is None else lines.strays[line]
        return cls(paths.middles_mm, half_mm, width_mm, along, sunk_mm, rays_mm, strays)

    def as_laid(
        self, beads: PlannedBeads, evidence: Evidence, template: Template, options: SkippedOptions
    ) -> BeadSamples:
        """The same samples moved to where the beads truly lie, with what rays say there.

        A part that shrank has its lines farther in, and lines laid on hanging strands lie lower.
        """
        middle_mm, sunk_mm = self.middle_mm, self.sunk_mm
        if len(middle_mm):
            middle_mm = middle_mm + wall_shift_mm(middle_mm, evidence, template, options)
            top_mm = middle_mm + self.half_mm[:, None] * UP
            hanging = HangingBeads.of(beads, top_mm, template, options)
            high_mm = 2.0 * self.half_mm
            sunk_mm = sunk_below_layer_mm(
                top_mm, self.width_mm, high_mm, hanging, evidence, options
            )
            middle_mm[:, 2] -= sunk_mm
        rays_mm = evidence.rays_say(middle_mm)
        return replace(self, middle_mm=middle_mm, sunk_mm=sunk_mm, rays_mm=rays_mm)

    def some(self, which: Mask | Int[np.ndarray, " q"]) -> BeadSamples:
        """The chosen ones."""
        return BeadSamples(*(getattr(self, each.name)[which] for each in fields(self)))

    def held(self, template: Template, options: SkippedOptions) -> Numbers:
        """(k,) how many of `held_places` places across each bead rest on the layer below.

        0 where nothing is below its middle: the bead hangs.
        """
        below_mm = self.middle_mm - 2.0 * self.half_mm[:, None] * UP
        aside_mm = self.width_mm[:, None] * self.along[:, ::-1] * np.array([-1.0, 1.0])
        rest = np.zeros((len(below_mm), options.held_places), bool)
        middles = (np.arange(options.held_places) + 0.5) / options.held_places - 0.5
        for place, share in enumerate(middles):
            under_mm = below_mm.copy()
            under_mm[:, :2] += share * aside_mm
            rest[:, place] = template.distance(under_mm) <= 0
        return np.where(rest[:, options.held_places // 2], rest.sum(axis=1), 0)
