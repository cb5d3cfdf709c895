"""What defects are placed by, and a recorded scanner is replayed by."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PlacementOptions:
    """Where defects that are asked for find a place.

    Attributes
    ----------
    least_room_mm2
        Of a layer's inside that a defect's middle may lie in.
    tries
        Places, or ranges of layers, before it is given up.
    least_piece_mm3
        Of a bite: smaller ones are too small to be found, let alone printed.
    even_ratio
        A defect's area in its layers differs by no more.
    least_line_mm, line_mm
        Of skipped lines: shorter ones are pieces of curves. Flow stops on the centre line and
        no wider.
    """

    least_room_mm2: float = 0.02
    tries: int = 60
    least_piece_mm3: float = 0.05
    even_ratio: float = 0.97
    least_line_mm: float = 3.0
    line_mm: float = 0.05


DEFAULT_PLACEMENT = PlacementOptions()


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How pieces of a recording are laid over a view.

    Attributes
    ----------
    block_mm
        No piece is smaller: errors of the first recordings hang together over 6 mm.
    spot_edge_mm
        So near to an edge a surface is measured with part of a spot.
    similar_cosine
        0 to 37°, or 46 to 72°.
    near_mm
        A block meets cells away from edges, or by an edge, if the next is so near, on average
        over it.
    least_share
        Of fewer points of a kind a block does not ask.
    tries
        The piece that covers most, of so many.
    """

    block_mm: float = 12.0
    spot_edge_mm: float = 1.5
    similar_cosine: float = 0.2
    near_mm: tuple[float, float] = (2.0, 4.0)
    least_share: float = 0.25
    tries: int = 24


DEFAULT_REPLAY = ReplayOptions()


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """What of a scanner's residuals is recorded, and how figures of them are told.

    Attributes
    ----------
    farthest_mm
        A residual beyond is another surface's point, or none.
    steepest_deg
        Depth that changes faster than on such a slope is an edge.
    """

    farthest_mm: float = 5.0
    steepest_deg: float = 80.0


DEFAULT_RECORDING = RecordingOptions()


@dataclass(frozen=True, slots=True)
class TruthOptions:
    """What of a simulated world counts as its truth.

    Attributes
    ----------
    margin_mm
        Truth is compared this far around the part, so that ooze beside it counts too.
    spreads_mm
        Beads of a repair spread, and crumble over a rim, no farther than this from the defect.
    least_missing_mm
        A column lacks something where it lacks more than a bead's own roughness.
    solid_ratio
        Below this share of infill a layer's inside is planned to be open: beads, not CAD, are
        expected.
    fit_share
        Of bed and height that a part scaled to fit takes.
    hidden_mm
        A point is the middle of a spot, and may lie this far before the first solid on a ray to
        it.
    """

    margin_mm: float = 3.0
    spreads_mm: float = 3.0
    least_missing_mm: float = 0.02
    solid_ratio: float = 0.999
    fit_share: float = 0.9
    hidden_mm: float = 0.5


DEFAULT_TRUTH = TruthOptions()
