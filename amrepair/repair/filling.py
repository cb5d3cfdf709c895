"""Which pieces of a deficit a repair fills, and the job's lines that it may follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import manifold3d
import numpy as np

from amrepair.deficit import Deficit
from amrepair.frames import Transform, nearest_box
from amrepair.policy import PolicyOptions, acceptance
from amrepair.regions import Label, Region
from amrepair.repair.site import Site
from gcode.meshes import box_of_solid
from gcode.slicing.job_lines import JobLines


def fillable(
    deficit: Deficit, wanted: Callable[[Region], bool], policy: PolicyOptions
) -> manifold3d.Manifold:
    """One solid of all missing pieces that are worth a repair and that the caller wants filled."""
    pieces = deficit.missing.decompose()
    boxes = [box_of_solid(piece) for piece in pieces]
    regions = [region for region in deficit.regions if region.label is Label.MISSING]
    known = [region.box_mm for region in regions]
    of_piece = [regions[nearest_box(known, box)] if regions else None for box in boxes]
    weighed = [
        acceptance.Piece(box, piece.volume(), skipped=region is not None and region.skipped)
        for box, piece, region in zip(boxes, pieces, of_piece, strict=True)
    ]
    keep = acceptance.worth_mending(weighed, policy)
    filled = [
        piece
        for piece, region, kept in zip(pieces, of_piece, keep, strict=True)
        if kept and (region is None or wanted(region))
    ]
    if not filled:
        return manifold3d.Manifold()
    return manifold3d.Manifold.batch_boolean(filled, manifold3d.OpType.Add)


def lines_of(site: Site, deficit: Deficit, placed: Transform) -> JobLines | None:
    """The job's lines, build frame, marked with the stretches that the deficit found missing."""
    if site.lines is None or deficit.gone is None:
        return site.lines
    ends = [placed.apply(ends_mm) for ends_mm in (deficit.gone.start_mm, deficit.gone.end_mm)]
    return replace(site.lines, gone_mm=np.stack(ends, axis=1))
