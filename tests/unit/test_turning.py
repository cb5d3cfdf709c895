"""Ways to lay a part on the bed: a slot under a roof is open from the side."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import pytest

from amrepair.errors import InputError
from amrepair.turning import TURNS, Turn, rank_turns, turns_named
from gcode.profiles import PrintSetup, load_setup
from gcode.slicing.layers import LayerGrid

SETUP = load_setup()


def _ranked(
    whole: m3.Manifold, missing: m3.Manifold, *names: str, setup: PrintSetup = SETUP
) -> tuple[Turn, ...]:
    grid = LayerGrid.from_setup(setup)
    return rank_turns(missing, whole - missing, names, setup=setup, grid=grid)


def test_a_slot_under_a_roof_is_reached_from_its_open_side() -> None:
    whole = m3.Manifold.cube((30.0, 30.0, 30.0)).translate((50.0, 50.0, 0.0))
    slot = m3.Manifold.cube((3.0, 30.0, 20.0)).translate((77.0, 50.0, 5.0))  # open to +X
    ranked = _ranked(whole, slot, "x180", "z90", "y270")
    by_name = {turn.name: turn for turn in ranked}
    assert ranked[0].name == "y270"  # +X looks up
    assert by_name["y270"].reachable_ratio > 0.7
    assert by_name["x180"].reachable_ratio < 0.05
    assert all(turn.stands for turn in ranked)


def test_what_does_not_fit_the_printer_is_not_suggested() -> None:
    whole = m3.Manifold.cube((20.0, 20.0, 60.0)).translate((50.0, 50.0, 0.0))
    notch = m3.Manifold.cube((20.0, 20.0, 2.0)).translate((50.0, 50.0, 58.0))
    low = replace(SETUP, printer=SETUP.printer.model_copy(update={"max_z_mm": 30.0}))
    (standing,) = _ranked(whole, notch, "z180", setup=low)
    assert standing.reachable_ratio == 0.0
    assert not standing.stands


def test_a_wedge_on_its_edge_does_not_stand() -> None:
    wedge = m3.Manifold.cube((20.0, 20.0, 20.0)).rotate((45.0, 0.0, 0.0))
    low = wedge.bounding_box()
    wedge = wedge.translate((60.0, 60.0, -low[2]))
    chip = m3.Manifold.cube((20.0, 60.0, 1.0)).translate((60.0, 40.0, wedge.bounding_box()[5] - 1))
    (turn,) = _ranked(wedge, wedge ^ chip, "z90")
    assert not turn.stands


def test_an_unknown_turn_is_refused() -> None:
    with pytest.raises(InputError, match="--turn is 'w90'"):
        turns_named(["w90"])
    assert turns_named(["x90", "any", "x90"]) == ("x90", *(n for n in TURNS if n != "x90"))
