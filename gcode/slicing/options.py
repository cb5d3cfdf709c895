"""How parts and patches are planned: each number once. Bores are the printer's, layers the job's.

What keeps the head clear of what stands there is not among them: those limits are the checker's.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class ColumnOptions:
    """Columns over a deficit.

    Attributes
    ----------
    fine_mm, coarse_mm, fine_cells
        Edge of a column; the second where there were more than so many of the first.
    margin_mm
        Around the deficit.
    tip_cells
        Places of the tip in a column of the as-built field, each way.
    most_thick_nozzles
        A bead thicker than this share of the bore no longer presses onto its floor.
    drop_nozzles
        In bores: a strand that nothing holds falls as far as this onto a floor, as one purged in
        the air does, and lies where it was laid. Deeper down it is anybody's guess.
    spread_nozzles
        From a bead's centre, as far as plastic is pressed sideways under the nozzle's flat, which
        is 2.5 bores across (E3D V6): not to its very rim.
    seam_mm
        Around a loop's seam, as far as old material hides it.
    job_layer_mm
        A job's layer may end so far above the deficit that it belongs to.
    no_lift_mm
        A travel as short as this needs no lift.
    """

    fine_mm: float = 0.1
    coarse_mm: float = 0.2
    fine_cells: int = 250_000
    margin_mm: float = 3.0
    tip_cells: int = 2
    most_thick_nozzles: float = 0.8
    drop_nozzles: float = 6.0
    spread_nozzles: float = 1.125
    seam_mm: float = 1.0
    job_layer_mm: float = 0.5
    no_lift_mm: float = 1.0


@dataclass(frozen=True, slots=True)
class PassHeightOptions:
    """Heights of passes.

    Attributes
    ----------
    deep_ratio
        A gap of more than this share of the thickest bead is not filled from above: up to there a
        strand of one line width, round (π/4 d² = width × gap), still reaches its floor. On a steep
        slope the head keeps the tip this far off.
    opening_mm2, opens_below_mm
        Of columns over a hollow, as many as open to the head at one height are worth a pass there;
        over less of a hollow than half a layer the last pass goes anyway.
    apart_layers
        What hangs spreads to both sides of its line, held there or not, and a strand that is drawn
        just above it finds no room.
    flat_mm2, flat_wide_mm, flat_mm, on_flat_mm
        A flat top: as much area, as wide, within so little height; and what belongs to it.
    """

    deep_ratio: float = 1.6
    opening_mm2: float = 1.0
    opens_below_mm: float = 0.1
    apart_layers: float = 0.5
    flat_mm2: float = 1.0
    flat_wide_mm: float = 0.6
    flat_mm: float = 0.02
    on_flat_mm: float = 0.03


@dataclass(frozen=True, slots=True)
class DueOptions:
    """What is to be laid at one height.

    Attributes
    ----------
    agree_mm
        The floor was measured, the deficit computed from it: they agree within this.
    rounded_off_mm
        More than the mean of a scan's noise.
    hold_mm
        A line's width: how far a bead may hang over a hole beside what holds it.
    hem_mm, rim_mm2
        From a tip in the air, as far as its bead covers a rim; less of one is not worth a line.
    most_hem
        Of the plastic, what may be laid in the air beside rims; about twice as much lies outside
        then.
    filled_enough
        Of what the head allows: a way that fills as much leaves little for others to find.
    """

    agree_mm: float = 0.04
    rounded_off_mm: float = 0.02
    hold_mm: float = 0.45
    hem_mm: float = 0.35
    rim_mm2: float = 1.0
    most_hem: float = 0.025
    filled_enough: float = 0.95


@dataclass(frozen=True, slots=True)
class BridgeOptions:
    """Strands over air, held at both ends; how long they may be is the material's.

    Attributes
    ----------
    hold_mm
        A line's width: as far a strand goes on over what holds its end (as PrusaSlicer's anchors).
    loose_mm
        Over so much of a span nothing may be wanted: a scan rounds off the rims of what holds.
    least_layers
        A strand thinner than this share of a layer is drawn out, not laid: the next pass spans it.
    least_mm2
        Less of a hollow is not worth a strand: what hangs beside its rim closes it.
    beside_mm
        Of the job's own lines: nearer than this to what is as high they are held from beside.
    beside_layers
        What ends no more than so much of a layer below the tip is as high.
    pressed_mm
        The same of lines of our own, which are pressed against those beside them.
    alike
        Angles whose strands span the same but for this share: the shorter ones are laid.
    """

    hold_mm: float = 0.45
    loose_mm: float = 0.3
    least_layers: float = 0.5
    least_mm2: float = 1.0
    beside_mm: float = 0.5
    beside_layers: float = 0.25
    pressed_mm: float = 0.8
    alike: float = 0.02


@dataclass(frozen=True, slots=True)
class BeadOptions:
    """Beads of a pass.

    Attributes
    ----------
    bond_ratio
        A patch presses into pores and roughness that no scan resolves, and printers push a per cent
        less than they are asked to: what is too little stays a void, what is too much is planed.
    least_thick_mm
        Thinner than this no bead holds together; it is filled with the next pass, or is the
        tolerance.
    least_section_mm2
        Nor one with less plastic.
    to_wall_mm
        What is pressed out under the flat beside a wall goes on to the wall, where that is this
        near to what it reaches: nowhere else has it to go.
    drawn_mm
        Centre lines keep off the rim of where the tip may go: outlines round off the corners of its
        cells, by about so much.
    on_line_mm
        From a job's line to what it covers.
    """

    bond_ratio: float = 1.015
    least_thick_mm: float = 0.06
    least_section_mm2: float = 0.004
    to_wall_mm: float = 0.2
    drawn_mm: float = 0.035
    on_line_mm: float = 0.02


@dataclass(frozen=True, slots=True)
class JobLineOptions:
    """Along the job's own lines.

    Attributes
    ----------
    rim_mm
        Beside the deficit's columns: its rim is as uncertain as the scan's noise and spacing make
        it.
    lot, little, nothing
        A scanner's spot rounds off what is gone: a little beside a lot is the lot's own. Shares of
        what the job lays in a piece of a line: from here on it lacks a lot, up to there a little,
        and less is nothing.
    nearly_all, stands_out
        Shares that a line which is gone reads, at least, and more than what is around it.
    beside_widths
        From a line to its neighbour.
    least_of_gap, served
        Where the gap is more than the deficit, both are right to about this share. And the share
        of what is due from which on the job's lines serve; where they serve less, others may serve
        more.
    """

    rim_mm: float = 0.3
    lot: float = 0.4
    little: float = 0.35
    nothing: float = 0.1
    nearly_all: float = 0.75
    stands_out: float = 0.1
    beside_widths: float = 1.4
    least_of_gap: float = 0.9
    served: float = 0.95


@dataclass(frozen=True, slots=True)
class SkinOptions:
    """A last pass that follows a sloping surface.

    Attributes
    ----------
    thick_mm, least_mm
        About as thick as it gets; and what is left to it everywhere.
    most_rise_mm
        The tip may stay this far over the surface for the sake of what is uphill: farther, and it
        no longer presses the bead down. With a flat of 1 mm that is a slope of 14 degrees.
    least_slope, least_climb_mm
        Rise over run, and from its lowest to its highest: flatter is flat, whatever its noise.
    mm2, wide_mm
        As large, and as wide.
    """

    thick_mm: float = 0.2
    least_mm: float = 0.1
    most_rise_mm: float = 0.05
    least_slope: float = 0.02
    least_climb_mm: float = 0.1
    mm2: float = 4.0
    wide_mm: float = 1.2


@dataclass(frozen=True, slots=True)
class LeftOptions:
    """What a patch leaves, and is told with its cause.

    Attributes
    ----------
    least_share, least_worth_mm3, least_closed
        Less of a hollow than this share, so little, and over less of its opening: it closes
        nothing.
    staircase_mm
        Of a job's staircase: half a layer, and what the scan gets wrong.
    least_cause
        Of what is left of a piece: a cause of less is told with the greatest.
    least_listed_mm3
        Less is not told.
    """

    least_share: float = 0.1
    least_worth_mm3: float = 30.0
    least_closed: float = 0.5
    staircase_mm: float = 0.15
    least_cause: float = 0.05
    least_listed_mm3: float = 0.02


@dataclass(frozen=True, slots=True)
class FillOptions:
    """How an area is filled with beads, of a part's layer and of a patch's pass.

    Attributes
    ----------
    least_nozzles, most_nozzles
        Widths of a bead, in bores: a thinner one is not drawn out evenly, a wider one does not
        reach its edges from under the nozzle's flat (Kuipers et al. 2020, Arachne, section 3).
    flow_span
        Weighing may change flow so far; beyond that the geometry is wrong.
    connect_spacings
        Ends of lines that are no farther apart are joined by a stroke.
    facing_ratio
        Feet farther apart than this many radii: walls that meet at less than 97 degrees face each
        other, and an axis runs between them.
    end_inset_ratio
        Of the radius: an open bead ends so far short of its wall, its round cap fills the rest.
    dot_inside_ratio
        A stroke that fills a dot lies in it with at least this share of its area.
    """

    least_nozzles: float = 0.5
    most_nozzles: float = 2.0
    flow_span: tuple[float, float] = (0.75, 1.25)
    connect_spacings: float = 2.5
    facing_ratio: float = 1.5
    end_inset_ratio: float = 0.5
    dot_inside_ratio: float = 0.5

    def widths_mm(self, bore_mm: float) -> tuple[float, float]:
        """Least and greatest width of a bead from a nozzle of such a bore."""
        return self.least_nozzles * bore_mm, self.most_nozzles * bore_mm


@dataclass(frozen=True, slots=True)
class PartOptions:
    """How a whole part is sliced, beside what its profiles say.

    Attributes
    ----------
    fill
        Beads of an area.
    overlap_ratio
        Of a spacing, how far fills reach into walls: PrusaSlicer's default.
    dense_ratio
        Infill is solid from here on.
    flow_correction
        A slab's volume over its section times its height: outside of this, flow would be wrong.
    least_left_mm3
        Less of what no bead can make is not told.
    highest_nozzles
        In bores: higher layers no longer press onto the last.
    snap_share
        Horizontal faces above this share of the largest section bend the layers' heights.
    short_travel_mm
        Oozing costs less than a retraction below this.
    corner_rad
        Turns sharper than this hide a seam.
    inward_mm, other_mm
        What a corner is worth: an inward one hides the seam wherever on the loop it is.
    """

    fill: FillOptions = field(default_factory=FillOptions)
    overlap_ratio: float = 0.25
    dense_ratio: float = 0.999
    flow_correction: tuple[float, float] = (0.85, 1.6)
    least_left_mm3: float = 1e-3
    highest_nozzles: float = 0.8
    snap_share: float = 0.01
    short_travel_mm: float = 1.5
    corner_rad: float = 0.6
    inward_mm: float = 1000.0
    other_mm: float = 1.5


USUAL_PART = PartOptions()
"""What parts are sliced by."""


@dataclass(frozen=True, slots=True)
class PatchOptions:
    """Settings of a patch; its plan records those it was made with."""

    columns: ColumnOptions = field(default_factory=ColumnOptions)
    heights: PassHeightOptions = field(default_factory=PassHeightOptions)
    due: DueOptions = field(default_factory=DueOptions)
    bridges: BridgeOptions = field(default_factory=BridgeOptions)
    beads: BeadOptions = field(default_factory=BeadOptions)
    lines: JobLineOptions = field(default_factory=JobLineOptions)
    skin: SkinOptions = field(default_factory=SkinOptions)
    left: LeftOptions = field(default_factory=LeftOptions)
    fill: FillOptions = field(default_factory=FillOptions)


USUAL_PATCH = PatchOptions()
"""What repairs go by."""
