"""The loop's own moves: aside for a scan, and back to where the job rests.

They are made and checked here, and sent by `run`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amrepair.errors import InputError
from gcode.check import CheckedProgram, check
from gcode.moves import FinishMoves, ModalState, Move, Retract, Toolpath, Travel
from gcode.profiles import PrintSetup
from gcode.resumption.head import LEAST_LIFT_MM
from gcode.surfaces import HeightField
from gcode.writer import write

PARK_LIFT_MM = 10.0
NO_PULL_MM = 1e-4  # programs are written to less


def park(
    setup: PrintSetup, state: ModalState, others: HeightField | None = None
) -> tuple[CheckedProgram, ModalState]:
    """Retract, lift, go aside, rest; the program, and the machine's state after it.

    There the filament is pulled back by the printer's own retraction, however far the job had
    pulled it: programs of ours begin and end so.

    Parameters
    ----------
    others
        What stands on the bed beside what is under way, and may be higher.

    Raises
    ------
    InputError
        If the nozzle does not get over them.
    CheckRefusedError
        If the head would hit one of them on its way.
    """
    machine = setup.printer
    x, y, z = (float(v) for v in state.position_mm)
    top_mm = z if others is None else max(z, others.top_mm)
    park_z = min(max(machine.park_mm[2], top_mm + PARK_LIFT_MM), machine.max_z_mm)
    if others is not None and park_z < top_mm + LEAST_LIFT_MM:
        raise InputError(
            f"what is finished stands {top_mm:.1f} mm high and the nozzle goes up to "
            f"{machine.max_z_mm:g} mm: there is no room to go over it to a look, "
            f"{LEAST_LIFT_MM:g} mm are needed"
        )
    place = (machine.park_mm[0], machine.park_mm[1], park_z)
    moves: list[Move] = []
    if (pull_mm := _still_to_pull_mm(setup, state)) != 0.0:
        moves.append(Retract(pull_mm, machine.retraction_speed_mm_s))
    moves += [
        Travel(np.array([[x, y, park_z]]), machine.z_speed_mm_s),
        Travel(np.array([place]), machine.travel_speed_mm_s),
        FinishMoves(),
    ]
    program = _program(setup, moves, state, "park for a scan", others, restore=False)
    after = replace(
        state, position_mm=place, e_mm=0.0, absolute_xyz=True, absolute_e=False, units_mm=True,
        pulled_mm=machine.retraction_mm,
    )  # fmt: skip
    return program, after


def way_back(
    setup: PrintSetup, state: ModalState, parked: ModalState, others: HeightField | None = None
) -> tuple[CheckedProgram, CheckedProgram]:
    """Back to where the job rests, over what else stands there; then everything as it was."""
    machine = setup.printer
    x, y, z = (float(v) for v in state.position_mm)
    park_z = float(parked.position_mm[2])
    moves: list[Move] = [
        Travel(np.array([[x, y, park_z]]), machine.travel_speed_mm_s),
        Travel(np.array([[x, y, z]]), machine.z_speed_mm_s),
    ]
    if (pull_mm := _still_to_pull_mm(setup, state)) != 0.0:
        moves.append(Retract(-pull_mm, machine.retraction_speed_mm_s))
    # the way back starts from the park; the modes are put back once the nozzle has arrived
    back = _program(setup, moves, parked, "back to the job", others, restore=False)
    arrived = replace(parked, position_mm=state.position_mm, pulled_mm=state.pulled_mm)
    modes = _program(setup, [], state, "go on with the job", None, restore=True, initial=arrived)
    return back, modes


def _still_to_pull_mm(setup: PrintSetup, state: ModalState) -> float:
    """From what the job has pulled to the printer's own retraction; negative: to push."""
    pull_mm = setup.printer.retraction_mm - state.pulled_mm
    return pull_mm if abs(pull_mm) > NO_PULL_MM else 0.0


def _program(
    setup: PrintSetup,
    moves: Sequence[Move],
    state: ModalState,
    title: str,
    others: HeightField | None,
    *,
    restore: bool,
    initial: ModalState | None = None,
) -> CheckedProgram:
    """Write and check a short program of the loop's own."""
    program = write(Toolpath(tuple(moves)), setup, title=title, resume=state, restore=restore)
    return check(program, setup, as_built=others, initial=initial or state)
