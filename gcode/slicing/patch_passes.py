"""One pass of a patch: along which lines beads are laid at a height, and with how much plastic."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from gcode.profiles import PrintSetup
from gcode.slicing.infill import SOLID_ANGLES_RAD
from gcode.slicing.job_lines import runs_of
from gcode.slicing.patch_beads import Chain, begun_inside, beside_runs, draw, weighed
from gcode.slicing.patch_bridges import Bridges, Holds
from gcode.slicing.patch_due import Due, due_at, due_of_job, hemmed, strips_along_walls
from gcode.slicing.patch_free import eased, free_between, free_runs
from gcode.slicing.patch_heights import Height
from gcode.slicing.patch_middles import PlanarPoints
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_skin import Skin
from gcode.slicing.patch_state import PatchState

# The most that a strand is taken to sag, of its thickness: part of it must stay in its column.
MOST_SAG = 0.9


@dataclass(frozen=True, slots=True)
class Pass:
    """The beads of one pass, which are laid together.

    Attributes
    ----------
    z_mm
        The height of the tip; where it follows a surface, the greatest.
    height_mm
        The mean thickness of the beads.
    index
        The number of the pass.
    chains
        The beads.
    reach
        Where the tip may go directly, from bead to bead.
    tip_mm
        The height of the tip; where it follows a surface, on the cells of `Reach`.
    """

    z_mm: float
    height_mm: float
    index: int
    chains: tuple[Chain, ...]
    reach: Bool[np.ndarray, "ny nx"]
    tip_mm: float | Float[np.ndarray, "ny nx"]


def plan_pass(
    model: PatchModel, state: PatchState, at: Height, setup: PrintSetup, *, hems: bool
) -> tuple[Pass | None, PatchState]:
    """Plan the pass at a height: find what is due there, and lay beads to fill it.

    Beads follow the job's own lines where those are known and serve, and else newly drawn lines.

    Returns
    -------
    The pass, None where nothing is laid; and the state of the columns after it.
    """
    planned = model.job.at(at.z_mm) if model.job is not None else None
    if not (model.free_at(at.reach) & model.near).any():
        return None, state
    if planned is None:
        due = due_at(model, state, at)
        if hems and model.job is None:
            due = hemmed(model, state, at, due)
    else:
        due = due_of_job(model, state, at, planned)
    if not due.thick_mm.any():
        return None, state
    if planned is None:
        laying = _along_own_held(model, state, at, due, setup)
    else:
        laying, due = _along_either(model, state, at, planned, due, setup)
        if laying is None or not laying.chains:
            due, planned = _fallen(model, state, at, due), None
            laying = _along_own_held(model, state, at, due, setup)
    if laying is None or not laying.chains:
        return None, state
    chains = tuple(_told_cold(chain, model, state, at) for chain in laying.chains)
    one = Pass(at.z_mm, laying.height_mm, at.index, chains, at.reach, at.z_mm)
    return one, _after(state, at, due, laying, planned)


def _fallen(model: PatchModel, state: PatchState, at: Height, due: Due) -> Due:
    """What is due at one of the job's heights where no line finds a hold: beads fall to the floor.

    Where the head first gets into a hollow at such a height, all layers above depend on it.
    """
    own = due_at(model, state, at)
    falls = (due.thick_mm > 0) & own.loose
    return replace(own, thick_mm=np.where(falls, own.thick_mm, 0.0), bridges=Bridges.none(model))


def _along_own_held(
    model: PatchModel, state: PatchState, at: Height, due: Due, setup: PrintSetup
) -> _Laying | None:
    laying = _along_own(model, state, at, due, setup)
    if laying is None:
        return None
    beside_mm = model.options.bridges.pressed_mm
    return _held(laying, Holds(model, state, at, beside_mm), model)


def _told_cold(chain: Chain, model: PatchModel, state: PatchState, at: Height) -> Chain:
    """The chain, marked where it lies on cold plastic; where it hangs it lies on nothing."""
    middles = 0.5 * (chain.xy_mm[1:] + chain.xy_mm[:-1])
    on_it = at.z_mm - model.at(state.surface_mm, middles, -np.inf) <= at.deep_mm
    return replace(chain, cold=np.asarray(on_it & (model.at(state.laid_mm, middles, 0.0) <= 0)))


@dataclass(frozen=True, slots=True)
class _Laying:
    """Beads at one height along one kind of lines.

    Attributes
    ----------
    chains
        The beads.
    laid_mm
        The thickness that each column gets.
    served
        The share of what is due that columns get.
    height_mm
        The mean thickness.
    """

    chains: list[Chain]
    laid_mm: Float[np.ndarray, "ny nx"]
    served: float
    height_mm: float


def _after(
    state: PatchState,
    at: Height,
    due: Due,
    laying: _Laying,
    planned: Bool[np.ndarray, "ny nx"] | None,
) -> PatchState:
    """The state of the columns once these beads are laid."""
    laid = laying.laid_mm
    hangs = (laid > 0) & due.hangs
    # a strand that sags lies partly below what is missing, and leaves as much to fill above it
    sag = np.where(laid > 0, np.minimum(due.bridges.sag_mm, MOST_SAG * laid), 0.0)
    done = state.done_mm
    if planned is not None:
        done = np.where((laid > 0) & planned, at.z_mm, done)
    return replace(
        state,
        surface_mm=np.where(hangs, at.z_mm - sag, state.surface_mm + laid),
        laid_mm=state.laid_mm + laid - sag,
        sunk_mm=state.sunk_mm + np.where(laid > 0, due.sunk_mm, 0.0),
        done_mm=done,
        hem=state.hem | due.hem,
        loose=(state.loose & ~due.bridges.over) | (due.loose & (laid > 0)),
        hung_mm=np.where(hangs, at.z_mm, state.hung_mm),
        too_long_mm=np.maximum(due.bridges.too_long_mm, state.too_long_mm),
    )


def _along_either(
    model: PatchModel,
    state: PatchState,
    at: Height,
    planned: Bool[np.ndarray, "ny nx"],
    due: Due,
    setup: PrintSetup,
) -> tuple[_Laying | None, Due]:
    """Lay along the job's lines if they serve enough, else along those lines that serve more.

    Also returns what is due then: where the job's lines are followed, no bridges of our own are.
    """
    holds = Holds(model, state, at, model.options.bridges.beside_mm)
    along = _along_job(model, state, at, planned, due.thick_mm, setup, holds)
    if along is None or along.served < model.options.lines.served:
        own = _along_own(model, state, at, due, setup, holds)
        if along is None or (own is not None and own.served > along.served):
            return None if own is None else _held(own, holds, model), due
    return _held(along, holds, model), replace(due, bridges=due.bridges.unlaid(model))


def _held(laying: _Laying, holds: Holds, model: PatchModel) -> _Laying:
    """Leave out stretches of beads that would hang from one end only."""
    chains: list[Chain] = []
    for chain in laying.chains:
        chains += [chain.part(a, b) for a, b in holds.stretches(chain.xy_mm)]
    if sum(len(c.section_mm2) for c in chains) == sum(len(c.section_mm2) for c in laying.chains):
        return laying
    near = beside_runs([c.xy_mm for c in chains], model.spread_mm, model)
    return replace(laying, chains=chains, laid_mm=np.where(near, laying.laid_mm, 0.0))


def _along_own(
    model: PatchModel,
    state: PatchState,
    at: Height,
    due: Due,
    setup: PrintSetup,
    holds: Holds | None = None,
) -> _Laying | None:
    """Lay along newly drawn lines: perimeters and infill on ground, straight strands over air."""
    thick, bridges = np.where(due.alone, 0.0, due.thick_mm), due.bridges
    rest = np.where(bridges.over | bridges.ends, 0.0, thick)
    drawn = draw(rest, at.reach, SOLID_ANGLES_RAD[at.index % 2], model, setup)

    def free(start_mm: PlanarPoints, end_mm: PlanarPoints) -> Bool[np.ndarray, " _m"]:
        return free_between(start_mm, end_mm, at.reach, model.reach)

    runs = [
        *bridges.strands,
        *(
            begun_inside(run, model)
            for bead in eased(drawn, at.reach, model.reach)
            for part in free_runs(bead, free)
            for run in (holds.held(part) if holds is not None else (part,))
        ),
    ]
    if not runs:
        return None
    if holds is not None:
        thick = holds.floored(runs, thick)
    tips_mm = [np.full(len(run.xy_mm), at.z_mm) for run in runs]
    strips = strips_along_walls(thick, at.z_mm, model, state)
    chains, laid = weighed(runs, tips_mm, thick, strips, model, setup, free=free)
    return _Laying(chains, laid, _served(laid, due.thick_mm), float(thick[thick > 0].mean()))


def _along_job(
    model: PatchModel,
    state: PatchState,
    at: Height,
    planned: Bool[np.ndarray, "ny nx"],
    thick: Float[np.ndarray, "ny nx"],
    setup: PrintSetup,
    holds: Holds,
) -> _Laying | None:
    """Lay along the lines that the job laid there, with as much of their plastic as is missing.

    Lines that run into a wall have to end where the head would touch it. No line then runs along
    that wall, so that less is served.
    """
    options = model.options.lines
    assert model.job is not None
    runs, job = runs_of(
        model.job.lines_at(at.z_mm),
        planned,
        lambda bead: [
            held
            for run in free_runs(bead, lambda a, b: free_between(a, b, at.reach, model.reach))
            for held in holds.held(run)
        ],
    )
    if not runs:
        return None
    thick = holds.floored(runs, thick)
    tips_mm = [np.full(len(run.xy_mm), at.z_mm) for run in runs]
    strips = strips_along_walls(thick, at.z_mm, model, state)
    height_mm = float(thick[thick > 0].mean())
    wanted = state.left_below(model, at.z_mm)
    share = float(np.clip(wanted[model.job.near].sum() / thick.sum(), options.least_of_gap, 1.0))
    chains, laid = weighed(runs, tips_mm, share * thick, strips, model, setup, job=job)
    return _Laying(chains, laid, _served(laid, share * thick), height_mm)


def _served(laid_mm: Float[np.ndarray, "ny nx"], due_mm: Float[np.ndarray, "ny nx"]) -> float:
    """The share of what is due that columns get; by this, kinds of lines are compared."""
    return float(np.minimum(laid_mm, due_mm).sum()) / float(due_mm.sum())


def plan_skin(
    model: PatchModel,
    state: PatchState,
    skin: Skin,
    most_mm: float,
    index: int,
    setup: PrintSetup,
) -> tuple[Pass | None, PatchState]:
    """Plan the last pass, along the part's own surface, where planar passes left room for it."""
    options = model.options
    wanted = state.left_below(model, np.inf)
    thick = np.minimum(model.top_mm - state.surface_mm, wanted + options.due.agree_mm)
    due = (
        skin.columns
        & (thick >= options.beads.least_thick_mm)
        & (thick <= options.heights.deep_ratio * most_mm)
    )
    thick = np.where(due, thick, 0.0)
    chains, laid = _along_skin(model, state, skin, thick, setup)
    if not chains:
        return None, state
    after = replace(state, surface_mm=state.surface_mm + laid, laid_mm=state.laid_mm + laid)
    nowhere = np.zeros(model.reach.shape, dtype=bool)  # the next bead is begun from above
    top_mm = float(max(chain.z_mm.max() for chain in chains))
    height_mm = float(thick[due].mean())
    return Pass(top_mm, height_mm, index, tuple(chains), nowhere, skin.tip.z_mm), after


def skin_served(
    model: PatchModel, state: PatchState, skin: Skin | None, setup: PrintSetup
) -> Skin | None:
    """The skin, restricted to the columns that its beads would reach."""
    if skin is None:
        return None
    thick = np.where(skin.columns, model.options.skin.thick_mm, 0.0)
    _, laid = _along_skin(model, state, skin, thick, setup)
    return replace(skin, columns=laid > 0) if laid.any() else None


def _along_skin(
    model: PatchModel,
    state: PatchState,
    skin: Skin,
    thick: Float[np.ndarray, "ny nx"],
    setup: PrintSetup,
) -> tuple[list[Chain], Float[np.ndarray, "ny nx"]]:
    """Lay beads across the slope from the lowest up: the flat is then over open columns."""
    anywhere = np.ones(model.reach.shape, dtype=bool)  # among the skin's columns
    beads = draw(thick, anywhere, skin.across_rad, model, setup, rings=0)
    runs = [run for bead in beads for run in free_runs(bead, skin.free_between)]
    if not runs:
        return [], np.zeros(model.shape)
    tips_mm = [skin.tip.sample(run.xy_mm, smooth=True) for run in runs]
    strips = strips_along_walls(thick, model.top_mm, model, state)
    chains, laid = weighed(runs, tips_mm, thick, strips, model, setup)
    upward = [c if c.z_mm[-1] >= c.z_mm[0] else c.reversed() for c in chains]
    return sorted(upward, key=lambda c: float(c.z_mm[0])), laid
