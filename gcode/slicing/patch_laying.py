"""From the passes of a patch to moves: how it begins, in which order it is laid, how it ends."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from gcode.dialects import heaters_off
from gcode.errors import SliceError
from gcode.moves import (
    Comment,
    FinishMoves,
    LayerChange,
    Prime,
    Role,
    Script,
    SetBed,
    SetFan,
    SetHotend,
)
from gcode.profiles import PrintSetup
from gcode.slicing.beads import width_of
from gcode.slicing.patch_beads import Chain
from gcode.slicing.patch_free import surely_free
from gcode.slicing.patch_model import PatchModel
from gcode.slicing.patch_passes import Pass
from gcode.slicing.pen import Pen
from gcode.slicing.reach import Reach
from gcode.slicing.room import bare_place, over_bed, room_for_line
from gcode.surfaces import HeightField
from gcode.units import filament_area_mm2

NOT_LOWER_MM = 1e-6
TIP_CLEAR_MM = 0.5  # of the tip over everything on a travel
STANDALONE_LIFT_MM = 5.0
WIPE_MM = 4.0  # more than a drop is wide
PRIME_MM_S = 3.0  # of filament: 7 mm³/s
MELTING_RATIO = 0.9  # of what can be melted, most that a hotend that has just become hot is given


def begin(
    setup: PrintSetup,
    field: HeightField,
    start_mm: tuple[float, float, float] | None,
    hotend_c: float,
) -> Pen:
    """From park (mid-job), or from a machine that stands still (standalone); hot at the end."""
    first_c = _first_bead_c(setup, hotend_c)
    words = Comment(first_pass_words(setup, hotend_c))
    if start_mm is not None:
        pen = Pen(setup, np.array(start_mm))
        pen.add(words)
        pen.retracted = setup.printer.retraction_mm > 0
        pen.add(SetFan(setup.material.fan_ratio))
        if first_c > hotend_c:
            pen.add(SetHotend(first_c, wait=True))
        return pen
    printer, material = setup.printer, setup.material
    safe_mm = min(field.top_mm + STANDALONE_LIFT_MM, printer.max_z_mm)
    pen = Pen(setup, np.array([0.0, 0.0, safe_mm]))
    pen.add(Comment("The part stands on the bed and Z is true: X and Y are homed, Z is not."))
    pen.add(words)
    pen.add(SetBed(material.bed_c))
    if not printer.docks:  # else the head is not the one that is heated yet
        pen.add(SetHotend(hotend_c))
    lift = f"{safe_mm:.3f}".rstrip("0").rstrip(".")
    lines = ("G21", "G91", "G1 Z2 F600", "G90", f"G1 Z{lift} F600", "G28 X Y")
    taken = (f"T{printer.tool}", f"G1 Z{lift} F600") if printer.docks else ()
    pen.add(Script(lines + taken, "approach"))
    pen.position_mm = np.array([0.0, 0.0, safe_mm])
    bed = over_bed(field, printer)
    room = room_for_line(bed, printer, WIPE_MM)
    place = room[:2] if room is not None else bare_place(bed, printer)
    if place is None:
        raise SliceError(
            "There is no bare place on the bed to prime at; take something off the bed and out of "
            "what stands there."
        )
    pen.move_to(np.array([*place, safe_mm]))
    pen.add(SetBed(material.bed_c, wait=True))
    pen.add(SetHotend(first_c, wait=True))
    _prime(pen, setup, None if room is None else np.array(room[2:]))
    pen.move_to(np.array([*pen.position_mm[:2], safe_mm]))
    pen.add(SetFan(material.fan_ratio))
    return pen


def _prime(pen: Pen, setup: PrintSetup, wipe: Float[np.ndarray, " 2"] | None) -> None:
    """On the bed, wiped off in a direction; or from high above, where the head has no room."""
    printer = setup.printer
    x, y, _ = pen.position_mm
    if wipe is not None:
        pen.move_to(np.array([x, y, printer.prime_mm[2]]))
    if printer.prime_length_mm > 0:
        melts_mm_s = setup.max_volumetric_mm3_s / filament_area_mm2(printer.filament_diameter_mm)
        pen.add(Prime(printer.prime_length_mm, min(PRIME_MM_S, MELTING_RATIO * melts_mm_s)))
    pen.retract()
    if wipe is not None:
        pen.move_to(np.array([*(np.array([x, y]) + WIPE_MM * wipe), printer.prime_mm[2]]))


def end(
    pen: Pen,
    setup: PrintSetup,
    field: HeightField,
    start_mm: tuple[float, float, float] | None,
) -> None:
    """Back to park (mid-job), or lifted, away, and off (standalone)."""
    pen.retract()
    here = pen.position_mm
    if start_mm is not None:
        pen.move_to(np.array([*here[:2], max(start_mm[2], here[2])]))
        pen.move_to(np.array([*start_mm[:2], max(start_mm[2], here[2])]))
        pen.move_to(np.array(start_mm))
        pen.add(FinishMoves())
        return
    printer = setup.printer
    # what was laid may be higher than all that stood there
    over_mm = max(field.top_mm, here[2]) + STANDALONE_LIFT_MM
    safe_mm = min(max(over_mm, printer.park_mm[2]), printer.max_z_mm)
    pen.move_to(np.array([*here[:2], safe_mm]))
    pen.move_to(np.array([*printer.park_mm[:2], safe_mm]))
    pen.add(FinishMoves())
    pen.add(SetHotend(0.0))
    pen.add(SetBed(0.0))
    pen.add(SetFan(0.0))
    if printer.docks:
        pen.add(Script(tuple(heaters_off(printer.dialect, printer.nozzles)), "every head"))


def after_first(pen: Pen, setup: PrintSetup, hotend_c: float) -> None:
    """As hot as everything else is printed; nothing waits for it."""
    if _first_bead_c(setup, hotend_c) > hotend_c:
        pen.add(SetHotend(hotend_c))


def first_pass_words(setup: PrintSetup, hotend_c: float) -> str:
    """How the first pass is laid onto what has long been cold, in words."""
    first_c = _first_bead_c(setup, hotend_c)
    more = f" ({first_c - hotend_c:g} C more than the rest)" if first_c > hotend_c else ""
    return (
        f"first pass, onto cold material: {first_c:g} C{more}, at most {_first_mm_s(setup):g} mm/s "
        "(as what else lies on cold material)"
    )


def _first_mm_s(setup: PrintSetup) -> float:
    """No faster than a first layer: it must have time to hold on."""
    return min(setup.process.repair_speed_mm_s, setup.process.first_layer_speed_mm_s)


def _first_bead_c(setup: PrintSetup, hotend_c: float) -> float:
    """It must melt into what has long been cold; a job may be as hot as the hotend gets."""
    hotter_c = hotend_c + setup.material.repair_first_bead_delta_c
    return max(hotend_c, min(hotter_c, setup.printer.max_hotend_c))


def emit(
    pen: Pen, one: Pass, reach: Reach, model: PatchModel, setup: PrintSetup, *, first: bool
) -> float:
    """Lay one pass, no faster than a first layer where it lies on old material; its plastic."""
    pen.add(LayerChange(one.index, one.z_mm, one.height_mm))
    laid_mm3 = 0.0
    planar = isinstance(one.tip_mm, float)
    # along a surface they are in order: the lowest first
    chains = _walls_last(one.chains, pen.position_mm[:2]) if planar else one.chains
    for chain in chains:
        _blow(pen, setup, over_air=chain.role is Role.BRIDGE)
        _go_to(pen, np.array([*chain.xy_mm[0], chain.z_mm[0]]), one, reach, model, setup)
        deep_mm = float(chain.deep_mm.mean())
        points_mm = np.column_stack([chain.xy_mm, chain.z_mm])
        for a, b, slow in _stretches(chain, first=first and chain.role is not Role.BRIDGE):
            pen.extrude(
                points_mm[a : b + 1],
                chain.section_mm2[a:b],
                speed_mm_s=_first_mm_s(setup) if slow else _mm_s(chain.role, setup),
                role=chain.role,
                width_mm=width_of(float(chain.section_mm2.mean()) / deep_mm, deep_mm),
                height_mm=deep_mm,
            )
        laid_mm3 += chain.volume_mm3
    _blow(pen, setup, over_air=False)
    return laid_mm3


def _mm_s(role: Role, setup: PrintSetup) -> float:
    """How fast a bead is laid that does not lie on what has long been cold."""
    process = setup.process
    if role is Role.BRIDGE and process.bridge_speed_mm_s is not None:
        return process.bridge_speed_mm_s
    return process.repair_speed_mm_s


def _blow(pen: Pen, setup: PrintSetup, *, over_air: bool) -> None:
    """Cool as what comes next needs it: strands over air set before they sag."""
    ordinary = setup.material.fan_ratio
    ratio = setup.material.bridge_fan_ratio if over_air else ordinary
    if ratio is not None and ratio != (ordinary if pen.fan_ratio is None else pen.fan_ratio):
        pen.add(SetFan(ratio))


def _stretches(chain: Chain, *, first: bool) -> Iterator[tuple[int, int, bool]]:
    """From which point to which a chain is laid at one speed, and whether it is the slow one."""
    count = len(chain.section_mm2)
    cold = chain.cold if chain.cold is not None else np.zeros(count, dtype=bool)
    slow = cold | first
    ends = [0, *(np.flatnonzero(np.diff(slow)) + 1).tolist(), count]
    for a, b in pairwise(ends):
        yield a, b, bool(slow[a])


def _go_to(
    pen: Pen,
    target_mm: Float[np.ndarray, " 3"],
    one: Pass,
    reach: Reach,
    model: PatchModel,
    setup: PrintSetup,
) -> None:
    """Directly where it is near, or over the patch all along; else pulled back and lifted."""
    across, rise = (target_mm - pen.position_mm)[:2], float(target_mm[2] - pen.position_mm[2])
    far = float(np.hypot(*across))
    samples = 2 + int(np.ceil(3 * far / min(reach.field.cell_mm, model.cell_mm)))
    way = pen.position_mm[:2] + np.linspace(0.0, 1.0, samples)[:, None] * across
    near = abs(rise) < NOT_LOWER_MM and far < model.options.columns.no_lift_mm
    # what oozes there, beads cover; what was laid before stands no higher than this pass
    combed = isinstance(one.tip_mm, float) and rise > -NOT_LOWER_MM and model.is_over(way).all()
    if (near or combed) and surely_free(way, one.reach, reach).all():
        pen.move_to(np.array([*pen.position_mm[:2], target_mm[2]]))
        pen.move_to(target_mm)
    else:
        over_mm = max(reach.least_over(way), one.z_mm) + TIP_CLEAR_MM
        pen.hop_to(target_mm, over_mm=min(over_mm, setup.printer.max_z_mm))


def _walls_last(chains: tuple[Chain, ...], start_mm: Float[np.ndarray, " 2"]) -> list[Chain]:
    """What lies along the rim comes after the rest: its plastic can then go to the wall alone."""
    rim = tuple(chain for chain in chains if chain.role is Role.PERIMETER)
    inside = tuple(chain for chain in chains if chain.role is not Role.PERIMETER)
    out = _ordered(inside, start_mm)
    return out + _ordered(rim, out[-1].xy_mm[-1] if out else start_mm)


def _ordered(chains: tuple[Chain, ...], start_mm: Float[np.ndarray, " 2"]) -> list[Chain]:
    """Greedy: the chain whose end is nearest comes next."""
    if not chains:
        return []
    heads = np.array([chain.xy_mm[0] for chain in chains])
    tails = np.array([chain.xy_mm[-1] for chain in chains])
    alive = np.ones(len(chains), dtype=bool)
    here = np.asarray(start_mm, dtype=np.float64)
    out = []
    for _ in chains:
        to_head = np.where(alive, ((heads - here) ** 2).sum(axis=1), np.inf)
        to_tail = np.where(alive, ((tails - here) ** 2).sum(axis=1), np.inf)
        k = int(np.argmin(np.minimum(to_head, to_tail)))
        alive[k] = False
        chain = chains[k] if to_head[k] <= to_tail[k] else chains[k].reversed()
        out.append(chain)
        here = chain.xy_mm[-1]
    return out
