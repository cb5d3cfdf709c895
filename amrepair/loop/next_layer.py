"""The job's next layer, its flow changed where a table of decisions says so."""

from __future__ import annotations

from collections.abc import Sequence

import manifold3d
import numpy as np

from amrepair.loop.findings import matching
from amrepair.policy.table import Action, Verdict
from amrepair.repair import RepairPlan
from gcode.errors import GcodeError
from gcode.profiles import PrintSetup
from gcode.reader import Job
from gcode.resumption.flow import ChangedLayer, change_flow, gap_field

NEXT_LAYER_CELL_MM = 0.2


def rewritten_layer(
    job: Job, setup: PrintSetup, layer: int, plan: RepairPlan, verdicts: Sequence[Verdict]
) -> ChangedLayer | None:
    """The layer as it is to be printed; None where nothing of it changes or may be printed.

    Parameters
    ----------
    layer
        Index of the layer to be rewritten.
    plan
        Whose solids the verdicts are about.
    """
    floor_mm = job.layers[layer - 1].z_mm if layer > 0 else 0.0
    deficit = plan.deficit
    solids = gap_solids(deficit.missing, deficit.excess, verdicts, floor_mm=floor_mm)
    if not solids:
        return None
    gap = gap_field(solids, NEXT_LAYER_CELL_MM)
    try:
        return change_flow(job, setup, job.layers[layer].index, gap)
    except GcodeError:
        return None  # the layer is then printed as it is


def gap_solids(
    missing: manifold3d.Manifold,
    excess: manifold3d.Manifold,
    verdicts: Sequence[Verdict],
    *,
    floor_mm: float,
) -> list[tuple[manifold3d.Manifold, float]]:
    """What the next layer's beads have more room (+1) or less (−1) by.

    Parameters
    ----------
    floor_mm
        The top of the layer below: what hangs beside the layers under it is in nobody's way.
    """
    solids = []
    for solid, action, sign in (
        (missing, Action.FILL_WITH_NEXT, 1.0),
        (excess, Action.LOWER_NEXT, -1.0),
    ):
        pieces = solid.decompose()
        for verdict in verdicts:
            if verdict.action is action:
                piece = matching(pieces, np.array(verdict.finding.box_mm))
                if piece is not None and sign < 0:
                    piece = piece.trim_by_plane((0.0, 0.0, 1.0), floor_mm)
                if piece is not None and not piece.is_empty():
                    solids.append((piece, sign))
    return solids
