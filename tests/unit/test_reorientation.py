"""Turns of a broken part: what the nozzle gets to when it lies on another side, and how it lies."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import manifold3d as m3
import pytest

import gcode
from amrepair.cli.repairing import _suggestion
from amrepair.errors import InputError
from amrepair.reorientation import NAMED_TURNS, rank_turns, turns_named
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import slice_patch
from gcode.surfaces import HeightField

SETUP = gcode.load_setup()
GRID = LayerGrid.from_setup(SETUP)
BLOCK = m3.Manifold.cube((24.0, 24.0, 14.0)).translate((60.0, 60.0, 0.0))
# In the block's left face, up to its top: 3 mm wide, 1 mm deep, 9 mm down.
SLOT = m3.Manifold.cube((1.0, 3.0, 9.0)).translate((60.0, 70.5, 5.0))
# A ridge on the right face: on that the block does not lie.
RIDGE = m3.Manifold.hull_points(
    [(84, 60, 0), (84, 84, 0), (84, 60, 14), (84, 84, 14), (94, 72, 0), (94, 72, 14)]
)


def reached_now(missing: m3.Manifold, rest: m3.Manifold) -> float:
    field = HeightField.from_manifold(rest, 0.2, margin_mm=30.0)
    patch = slice_patch(missing, SETUP, as_built=field, grid=GRID, standalone=True)
    return float(patch.reachable_mm3 / missing.volume())


def told(now: float, missing: m3.Manifold, rest: m3.Manifold) -> list[str]:
    """What `amrepair repair --turn any` says."""
    ranked = rank_turns(missing, rest, turns_named(["any"]), setup=SETUP, grid=GRID)
    plan: Any = SimpleNamespace(
        unreachable_mm3=(1.0 - now) * missing.volume(),
        deficit=SimpleNamespace(missing_mm3=missing.volume()),
    )
    return _suggestion(plan, ranked)


def test_a_slot_in_a_side_is_open_from_there() -> None:
    rest = BLOCK - SLOT
    now = reached_now(SLOT, rest)
    assert now < 0.1
    best = rank_turns(SLOT, rest, turns_named(["any"]), setup=SETUP, grid=GRID)[0]
    assert (best.name, best.stands) == ("y90", True)  # the left face comes to lie above
    assert best.reachable_ratio > 0.7
    (sentence,) = told(now, SLOT, rest)
    assert sentence.startswith("Turned by y90 the nozzle would reach 7")
    assert "fixture" not in sentence


def test_where_it_would_not_lie_a_fixture_is_asked_for() -> None:
    rest = BLOCK + RIDGE - SLOT
    (sentence,) = told(reached_now(SLOT, rest), SLOT, rest)
    assert sentence.startswith("Turned by y90")
    assert "it does not lie there by itself and needs a fixture" in sentence


def test_a_turn_that_helps_nobody_is_said_to() -> None:
    cave = m3.Manifold.cube((3.0, 3.0, 3.0)).translate((70.0, 70.0, 5.0))
    (sentence,) = told(0.0, cave, BLOCK - cave)
    assert sentence == "No allowed turn reaches clearly more than the 0% of now."


def test_what_is_too_large_for_the_bed_when_turned_is_no_way() -> None:
    tall = m3.Manifold.cube((20.0, 20.0, 230.0)).translate((60.0, 60.0, 0.0))
    hole = m3.Manifold.cube((2.0, 5.0, 5.0)).translate((60.0, 67.0, 100.0))
    (one,) = rank_turns(hole, tall - hole, ["x90"], setup=SETUP, grid=GRID)
    assert (one.reachable_ratio, one.stands) == (0.0, False)


def test_turns_are_named() -> None:
    assert turns_named(["x90", "any"])[0] == "x90"
    assert set(turns_named(["any"])) == set(NAMED_TURNS)
    with pytest.raises(InputError, match="--turn is 'x45'"):
        turns_named(["x45"])
