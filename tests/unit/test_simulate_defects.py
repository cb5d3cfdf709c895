"""Defects: their grammar, and places that are really there on any part."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest

from amrepair.errors import InputError
from amrepair.simulate.defects import DefectKind, parse_defect
from amrepair.simulate.part_files import bracket_path, part_path
from amrepair.simulate.placement import place

PARTS = {
    "block": m3.Manifold.cube((30, 30, 10)),
    "thin": m3.Manifold.cube((40, 6, 20)),
    "ball": m3.Manifold.sphere(12, 64).trim_by_plane((0, 0, 1), -8).translate((0, 0, 8)),
    "small": m3.Manifold.cylinder(6, 6, 6, 64),
}


def tops(part: m3.Manifold) -> np.ndarray:
    return np.arange(1, round(part.bounding_box()[5] / 0.2) + 1) * 0.2


def test_grammar_fills_in_defaults_and_keeps_what_was_said() -> None:
    defect = parse_defect("void:diameter=8, layers=3")
    assert defect.kind is DefectKind.VOID
    assert defect.values["diameter"] == 8
    assert defect.values["layers"] == 3
    assert parse_defect(str(defect)) == defect


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("hole", "under_extrusion"),
        ("void:depth=1", "diameter"),
        ("void:diameter=wide", "from 2 to 40"),
        ("void:diameter", "from 2 to 40"),
        ("chip:size=nan", "from 1.5 to 40"),
        ("under_extrusion:flow=1.5", "from 0 to 0.95"),
        ("none:size=1", "none"),
    ],
)
def test_bad_defects_are_refused_with_what_is_allowed(text: str, names: str) -> None:
    with pytest.raises(InputError, match=names):
        parse_defect(text)


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("seed", range(3))
def test_void_lies_inside_the_part_in_every_one_of_its_layers(name: str, seed: int) -> None:
    part = PARTS[name].translate((100, 80, 0))
    placed = place(parse_defect("void"), part, tops(part), np.random.default_rng(seed))
    assert placed.last_layer == placed.layers[-1]
    x, y, cos, sin, a, b, *_ = placed.flow_regions[0]
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    u, v = a * np.cos(angle), b * np.sin(angle)
    ring = m3.CrossSection([np.stack([x + u * cos - v * sin, y + u * sin + v * cos], axis=1)])
    for layer in placed.layers:
        section = part.slice(float(tops(part)[layer]) - 0.1)
        assert (ring - section).area() < 1e-6


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("kind", ["chip", "blob", "under_extrusion"])
def test_other_defects_touch_the_part(name: str, kind: str) -> None:
    part = PARTS[name].translate((100, 80, 0))
    placed = place(parse_defect(kind), part, tops(part), np.random.default_rng(5))
    if kind == "chip":
        assert placed.removed is not None
        taken = part ^ placed.removed
        assert taken.volume() > 3.0
        # open above: nothing of the part is left over what broke off
        rest = part - placed.removed
        for lift_mm in (0.5, 2.0, 5.0):
            assert (rest ^ taken.translate((0, 0, lift_mm))).volume() < 0.02 * taken.volume()
    elif kind == "blob":
        assert placed.added is not None
        assert (placed.added - part).volume() > 1.0
        assert part.min_gap(placed.added, 1.0) == 0.0
    else:
        assert placed.layers


def test_placing_is_seeded() -> None:
    part = PARTS["block"]
    first, second, other = (
        place(parse_defect("void"), part, tops(part), np.random.default_rng(seed))
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.flow_regions, second.flow_regions)
    assert not np.array_equal(first.flow_regions, other.flow_regions)


def test_part_without_room_is_refused() -> None:
    needle = m3.Manifold.cube((1, 1, 20))
    with pytest.raises(InputError, match="no room"):
        place(parse_defect("void"), needle, tops(needle), np.random.default_rng(0))


def test_bracket_is_found_and_other_names_are_refused() -> None:
    assert bracket_path().is_file()
    with pytest.raises(InputError, match="bracket"):
        part_path("teapot")
