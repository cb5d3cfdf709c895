"""Options of slicing: how parts and patches are planned, each number once.

Bores come from the printer's profile and layers from the job. How far the head must keep clear of
what stands there is not among these options: those limits are the checker's.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class ColumnOptions:
    """The columns over a deficit on which a patch is planned.

    Attributes
    ----------
    fine_mm, coarse_mm, fine_cells
        Edge of a column. Columns are coarse where there would be more than `fine_cells` fine ones.
    margin_mm
        Margin around the deficit.
    tip_cells
        How many places of the tip are asked about in a column of the as-built field, each way.
    most_thick_nozzles
        The thickest bead, in bores: a thicker one no longer presses onto its floor.
    drop_nozzles
        How far, in bores, an unsupported strand may fall onto a floor and still lie where it was
        laid, as one purged in the air does. From higher up nobody knows where it comes to lie.
    spread_nozzles
        How far, in bores, plastic is pressed sideways from a bead's centre under the nozzle's flat.
        That is 2.5 bores across (E3D V6), and plastic does not reach its very rim.
    seam_mm
        How far around a loop's seam old material hides it.
    job_layer_mm
        How far above the deficit a layer of the job may end that still belongs to it.
    no_lift_mm
        A travel no longer than this needs no lift.
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
    """The heights at which passes are laid.

    Attributes
    ----------
    deep_ratio
        A gap deeper than this many times the thickest bead is not filled from above. Up to there a
        round strand of one line width (π/4 d² = width × gap) still reaches its floor. On a steep
        slope the head keeps the tip this far off.
    opening_mm2, opens_below_mm
        An extra pass is laid at a height where the head first gets into this area of hollows.
        Columns count only from `opens_below_mm` below their top on, half a layer: the last pass
        goes over the others anyway.
    apart_layers
        The least distance of passes above hanging strands, in layers: a strand spreads, and one
        that is drawn just above it finds no room.
    flat_mm2, flat_wide_mm, flat_mm, on_flat_mm
        A top is flat if it has this area and this width within `flat_mm` of height; columns within
        `on_flat_mm` of it belong to it.
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
    """Where beads are due in a pass.

    Attributes
    ----------
    agree_mm
        The measured floor and the deficit that was computed from it agree within this.
    rounded_off_mm
        Along the job's lines, gaps from this thickness on are due where something is missing: it is
        more than the mean of a scan's noise, and the shallow rim that a scan rounds off counts.
    hold_mm
        How far a bead may hang over a hole beside what holds it: a line's width.
    hem_mm, rim_mm2
        How far from a tip over air its bead still covers a rim, and the least area of a rim that is
        worth such a line.
    most_hem
        The largest share of plastic that may be laid over air beside rims; about twice that share
        then lies outside the deficit.
    filled_enough
        A plan that fills this share of what the head can reach is good enough: no other is tried.
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
    """Bridges: strands over air, held at both ends. The material says how long they may be.

    Attributes
    ----------
    hold_mm
        How far a strand goes on over what holds its end (PrusaSlicer's anchors): a line's width.
    loose_mm
        Over how much of a span nothing needs to be missing, since a scan rounds off the rims of
        what holds.
    least_layers
        A strand thinner than this many layers would be drawn out; it is left to the next pass.
    least_mm2
        A smaller hollow gets no strand: beads that hang beside its rim close it.
    beside_mm
        A line of the job is held from beside by what is as high and no farther away than this.
    beside_layers
        What ends no more than this many layers below the tip counts as being as high.
    pressed_mm
        As `beside_mm`, for newly drawn lines, which are pressed against those beside them.
    alike
        Directions that span the same area to this share count as equal; of those the one with the
        shorter strands is chosen.
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
    """The beads of a pass.

    Attributes
    ----------
    bond_ratio
        Factor on all plastic of a patch: it presses into pores that no scan resolves, and printers
        push a per cent less than they are asked to. Too little would stay a void, while too much is
        flattened by the nozzle.
    least_thick_mm, least_section_mm2
        No thinner bead, and none of less plastic, holds together. What would need one is filled
        with the next pass, or is within tolerance.
    to_wall_mm
        Plastic that is pressed out beside a wall reaches the wall where the gap is no wider than
        this.
    drawn_mm
        How far centre lines keep off the rim of where the tip may go, since outlines round off the
        corners of its cells by about so much.
    on_line_mm
        How far from a job's line a column may lie that the line covers.
    """

    bond_ratio: float = 1.015
    least_thick_mm: float = 0.06
    least_section_mm2: float = 0.004
    to_wall_mm: float = 0.2
    drawn_mm: float = 0.035
    on_line_mm: float = 0.02


@dataclass(frozen=True, slots=True)
class JobLineOptions:
    """How a patch follows the job's own lines.

    Attributes
    ----------
    rim_mm
        How far around the deficit lines are followed: its rim is as uncertain as the scan's noise
        and spacing make it.
    lot, little, nothing
        A scan blurs, so what a piece of a line lacks a little of belongs to a piece near by that
        lacks a lot. A piece lacks a lot from `lot` of its plastic on, a little below `little`, and
        nothing below `nothing`.
    nearly_all, stands_out
        A missing line lacks at least `nearly_all` of its plastic, or `stands_out` more than what is
        around it.
    beside_widths
        How far, in line widths, a neighbouring line may be.
    least_of_gap
        Where the gap under a line is larger than the deficit, both count as right to this share.
    served
        The job's lines are followed if they fill this share of what is due; if they fill less,
        newly drawn lines are tried, and may be better.
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
        About how thick the pass is at most, and how much planar passes leave to it everywhere.
    most_rise_mm
        How far above the surface the tip may be kept by what is uphill: farther up it would no
        longer press the bead down. With a flat of 1 mm this is a slope of 14 degrees.
    least_slope, least_climb_mm
        A surface flatter than this (rise over run), or that climbs less in all, is flat.
    mm2, wide_mm
        Least area and width of such a surface.
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
    """What a patch leaves open, which is told with its cause.

    Attributes
    ----------
    least_share, least_worth_mm3, least_closed
        Beads in a hollow are dropped if they fill less than this share of it, less than this
        volume, and close less than this share of its opening.
    staircase_mm
        Columns that end within this below the deficit's top are only the steps of the job's slopes:
        half a layer, and the scan's error.
    least_cause
        A cause of less than this share of what is left of a piece is told with the greatest cause.
    least_listed_mm3
        A smaller volume is not told.
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
        Least and greatest width of a bead, in bores: a thinner one is not drawn out evenly, and
        the plastic of a wider one does not reach its edges from under the nozzle's flat (Kuipers et
        al. 2020, Arachne, section 3).
    flow_span
        By which factors the flow of beads may be changed to fill the area exactly; beyond these the
        geometry is wrong.
    connect_spacings
        Ends of lines no farther apart than this many spacings are joined.
    facing_ratio
        Two walls face each other, with an axis between them, if their feet are farther apart than
        this many radii: the walls then meet at less than 97 degrees.
    end_inset_ratio
        How far an open bead ends short of its wall, in radii; its round cap fills the rest.
    dot_inside_ratio
        At least this share of a stroke that fills a dot lies in the dot.
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
        How areas are filled with beads.
    overlap_ratio
        How far fills reach into walls, in spacings; PrusaSlicer's default.
    dense_ratio
        From this density on infill counts as solid.
    flow_correction
        The flow of a layer is corrected by its volume over section times height; outside of this
        range that would be wrong.
    least_left_mm3
        A smaller volume that no bead can fill is not told.
    highest_nozzles
        The highest layer, in bores: a higher one no longer presses onto the last.
    snap_share
        Layer heights are adapted to horizontal faces larger than this share of the largest section.
    short_travel_mm
        On shorter travels oozing costs less than a retraction.
    corner_rad
        A turn sharper than this hides a seam.
    inward_mm, other_mm
        How far away a seam may be put for the sake of a corner: an inward one hides the seam
        wherever on the loop it is.
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


DEFAULT_PART = PartOptions()
"""The default for parts."""


@dataclass(frozen=True, slots=True)
class PatchOptions:
    """Settings of a patch; its plan records those that were used."""

    columns: ColumnOptions = field(default_factory=ColumnOptions)
    heights: PassHeightOptions = field(default_factory=PassHeightOptions)
    due: DueOptions = field(default_factory=DueOptions)
    bridges: BridgeOptions = field(default_factory=BridgeOptions)
    beads: BeadOptions = field(default_factory=BeadOptions)
    lines: JobLineOptions = field(default_factory=JobLineOptions)
    skin: SkinOptions = field(default_factory=SkinOptions)
    left: LeftOptions = field(default_factory=LeftOptions)
    fill: FillOptions = field(default_factory=FillOptions)


DEFAULT_PATCH = PatchOptions()
"""The default for repairs."""
