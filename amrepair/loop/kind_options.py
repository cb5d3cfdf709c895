"""What tells one type of defect from another: each number once."""

from __future__ import annotations

from dataclasses import dataclass

from amrepair.loop.layer_shift import DEFAULT_SHIFT, ShiftOptions
from amrepair.loop.thin_layers import DEFAULT_THIN, ThinLayersOptions


@dataclass(frozen=True, slots=True)
class KindOptions:
    """Lengths in layers are in heights of the layer just printed.

    Attributes
    ----------
    moved_mm, moved_deg
        A calibration is good to a tenth or two; a part that moved farther has come off.
    shift_layers
        A shift of so many layers' heights is as sure as not to spoil the print.
    least_points, most_points
        Of a surface that tells something, and that are looked at.
    low_wall_mm, high_wall_mm, beside_layer_mm, top_rim_mm
        Walls are looked at off the bed and off the top's rim; the bed, off the part.
    below_layer_mm, layer_rim_mm
        So far under its floor, and within so much of the outline, a region lies at the rim.
    over_bead
        Of its width, to either side of its path: what is seen there is a bead's top, and no flank.
    faced_by
        Of a cloud without normals, so many points tell which way one faces.
    short_layers
        Less than this is what a layer's beads differ by themselves.
    warp_layers, lifted_layers, warp_share
        A surface that bends: range of its parabola, height of its rim; share of the deviation that
        the parabola explains.
    moved_share
        Of how far a curl moves surface: so far it stands off, in the median.
    warp_bands
        Of the farthest, where each band of surface begins that is looked at. A curl rises slowly,
        a blob has a rim.
    most_strain
        A plastic contracts by no more from its melt: 1e-4 for a kelvin (ABS), over 200 K. Where the
        top of a part of height h contracts by ε and its foot does not, it bends by κ = ε / h; by
        twice as much at most, and its rim, at L from the middle, rises by κ L² / 2.
    layer_share
        Of a layer's beads: too little or too much flow over at least this share is the layer's own.
    clog_least, clog_most, clog_lasts, clog_layers
        Share of the layer's beads that a clog takes; it does not clear itself, but for noise, so
        that it lasts through this share of what follows its beginning; and how deep it is at most:
        beads of one layer, and noise. Layers below are whole, or all of this one would lack.
    around, around_of
        Places around one that tell what is there as a region, and among how many they are looked
        for.
    skipped_aspect
        Longer along the beads than across them by this much: beads were skipped.
    string_aspect, string_width_mm, string_tall
        A string is this much longer than wide, no wider, and no higher than this share of its
        length.
    sag_mm, sag_levels
        Strands over nothing droop by whole millimetres; what is farther below them came from
        elsewhere. So many heights up to there are asked whether the part is over a place.
    along_cosine
        Along the beads.
    whole_layers
        Mean depth: less than whole beads are missing where it is shallower.
    top_cosine, wall_cosine
        Steepness of a top, and of a wall.
    shift
        What it takes to tell that layers lie aside of those below, by what is seen from above.
    thin
        What it takes to tell that layers lack plastic under later ones, by how walls stand in.
    """

    moved_mm: float = 0.8
    moved_deg: float = 1.5
    shift_layers: float = 1.0
    least_points: int = 120
    most_points: int = 6_000
    low_wall_mm: float = 0.8
    high_wall_mm: float = 0.5
    beside_layer_mm: float = 1.5
    top_rim_mm: float = 1.2
    below_layer_mm: float = 0.7
    layer_rim_mm: float = 0.5
    over_bead: float = 0.25
    faced_by: int = 12
    short_layers: float = 0.3
    warp_layers: float = 1.0
    lifted_layers: float = 0.6
    warp_share: float = 0.45
    moved_share: float = 0.5
    warp_bands: tuple[float, ...] = (0.2, 0.47, 0.73)
    most_strain: float = 0.02
    layer_share: float = 0.55
    clog_least: float = 0.12
    clog_most: float = 0.9
    clog_lasts: float = 0.9
    clog_layers: float = 1.5
    around: int = 8
    around_of: int = 128
    skipped_aspect: float = 2.2
    string_aspect: float = 4.0
    string_width_mm: float = 2.2
    string_tall: float = 0.25
    sag_mm: float = 5.0
    sag_levels: int = 12
    along_cosine: float = 0.9
    whole_layers: float = 0.7
    top_cosine: float = 0.8
    wall_cosine: float = 0.4
    shift: ShiftOptions = DEFAULT_SHIFT
    thin: ThinLayersOptions = DEFAULT_THIN


DEFAULT_KINDS = KindOptions()
"""What the loop goes by."""
