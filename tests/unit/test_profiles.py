"""Profiles: everything shipped loads; what is wrong is named with file, key and limit."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gcode.check import find_refusals
from gcode.errors import ProfileError
from gcode.moves import Program
from gcode.profiles import (
    expand_script,
    kind_of,
    list_profiles,
    load_material,
    load_printer,
    load_process,
    load_setup,
)
from gcode.profiles.machines import machine_named
from gcode.surfaces import HeightField


@pytest.mark.parametrize("name", list_profiles("printers"))
def test_every_shipped_printer_loads_and_fits_its_own_bed(name: str) -> None:
    printer = load_printer(name)
    x0, y0, x1, y1 = printer.reach_box_mm
    for x, y, z in (printer.park_mm, printer.prime_mm):
        assert x0 <= x <= x1
        assert y0 <= y <= y1
        assert 0 <= z <= printer.max_z_mm
    assert not printer.envelope or printer.envelope[0].z_from_mm == 0
    assert len(printer.sha256) == 64


SHIPPED = sorted((Path(__file__).parents[2] / "profiles").rglob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_figure_says_where_it_is_from(path: Path) -> None:
    """Paragraphs with figures have a comment that tells their source; scripts have none of them."""
    text = re.sub(r'"""\n.*?\n"""', "script", path.read_text(), flags=re.DOTALL)
    for paragraph in text.split("\n\n"):
        if re.search(r"^\w+ = [-\[\d]", paragraph, flags=re.MULTILINE):
            comment = " ".join(re.findall(r"#(.*)", paragraph))
            assert len(comment) > 20, paragraph


MEASURED = [name for name in list_profiles("printers") if load_printer(name).envelope]


def test_heads_that_were_measured_stay_measured() -> None:
    assert len(MEASURED) == 13


@pytest.mark.parametrize("name", MEASURED)
def test_every_shipped_nozzle_is_a_cone(name: str) -> None:
    # regression: up to 0.8 mm over the tip it was no wider than its flat, 1 mm
    flat, cone, hexagon = load_printer(name).envelope[:3]
    assert flat.is_tip
    assert cone.widening_mm > 0
    for step in cone.steps:
        radius_mm = np.abs(step.polygon_mm).max()
        on_cone_mm = cone.z_from_mm + (radius_mm - 0.6) * cone.height_mm / cone.widening_mm
        assert step.z_from_mm == pytest.approx(on_cone_mm, abs=0.06)
    assert cone.reach_mm == pytest.approx(2.5, abs=0.01)
    assert hexagon.z_from_mm == cone.z_to_mm


@pytest.mark.parametrize(
    "slice_text",
    [
        "z_from_mm = 0.1\nradius_mm = 0.6\nradius_to_mm = 2.5",
        "z_from_mm = 0.1\nradius_mm = 0.6\nradius_to_mm = 0.5\nz_to_mm = 2.0",
        "z_from_mm = 0.1\nradius_mm = 0.6\nradius_to_mm = 2.5\nz_to_mm = 0.1",
    ],
)
def test_half_a_cone_is_refused(slice_text: str, tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(f'inherits = "prusa_mk3s"\n[[envelope]]\npart = "nozzle"\n{slice_text}\n')
    with pytest.raises(ProfileError, match=r"mine\.toml.*envelope"):
        load_printer(own)


@pytest.mark.parametrize("name", list_profiles("materials"))
def test_every_shipped_material_suits_the_default_printer(name: str) -> None:
    assert load_setup(material=name).material.id == name


@pytest.mark.parametrize("name", list_profiles("processes"))
def test_every_shipped_process_loads(name: str) -> None:
    assert load_process(name).layer_height_mm <= 0.8 * 0.4


def test_a_user_profile_inherits_and_changes_its_hash(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text('inherits = "prusa_mk3s"\nname = "Mine"\nmax_z_mm = 100.0\n')
    printer = load_printer(own)
    assert (printer.id, printer.max_z_mm) == ("mine", 100.0)
    assert printer.bed_size_mm == load_printer("prusa_mk3s").bed_size_mm
    assert printer.sha256 != load_printer("prusa_mk3s").sha256


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('inherits = "pla"\ncolour = "red"\n', "colour"),
        ('inherits = "pla"\nfan_ratio = 1.5\n', "fan_ratio"),
        ('inherits = "nothing"\n', "Unknown material"),
        ('inherits = "other.toml"\n', "no such profile file"),
        ("name = ", "not valid TOML"),
        ('name = "bare"\n', "missing"),
    ],
)
def test_a_wrong_profile_is_refused_in_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ProfileError, match=said):
        load_material(path)


@pytest.mark.parametrize(
    ("load", "text", "said"),
    [
        (load_material, 'inherits = "pla"\nfan_ratio = 1.5\n', "'fan_ratio' = 1.5 .*0 to 1"),
        (load_material, 'inherits = "pla"\ndensity_g_cm3 = 0\n', "'density_g_cm3' = 0 .*than 0"),
        (load_material, 'inherits = "pla"\nhotend_c = inf\n', "'hotend_c' = inf .*more than 0"),
        (load_material, 'inherits = "pla"\nbed_c = "warm"\n', "'bed_c' = 'warm' .*at least 0"),
        (load_printer, 'inherits = "ender_3"\nnozzle_diameter_mm = 19\n', "= 19 .*0.1 to 10"),
        (load_printer, 'inherits = "ender_3"\nmax_hotend_c = 900\n', "= 900 .*0 to 500, more than"),
        (load_printer, 'inherits = "ender_3"\nbed_size_mm = [-5, 9]\n', "size_mm.0' = -5 .*than 0"),
        (load_printer, 'inherits = "ender_3"\nmax_speed_mm_s = {x = -1}\n', "s.x' = -1 .*than 0"),
        (load_printer, 'inherits = "ender_3"\ndialect = "basic"\n', "'basic' .*'klipper'"),
    ],
)
def test_a_value_out_of_range_is_told_with_file_key_value_and_range(
    tmp_path: Path, load: Callable[[Path], object], text: str, said: str
) -> None:
    # regression: only the bound that was passed was told, and inf was taken
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ProfileError, match=f"wrong.toml: key .*{said}"):
        load(path)


def test_a_file_tells_by_itself_what_kind_of_profile_it_is(tmp_path: Path) -> None:
    own = {
        "printers": 'inherits = "ender_3"\nname = "Mine"\n',
        "materials": 'inherits = "pla"\nhotend_c = 220.0\n',
        "processes": 'name = "Mine"\nlayer_height_mm = 0.2\nperimeters = 3\n',
    }
    for kind, text in own.items():
        (tmp_path / f"{kind}.toml").write_text(text)
        assert kind_of(tmp_path / f"{kind}.toml") == kind
        assert all(kind_of(name) == kind for name in list_profiles(kind))  # type: ignore[arg-type]
    (tmp_path / "none.toml").write_text('name = "Mine"\n')
    with pytest.raises(ProfileError, match=r"none.toml: .*--kind"):
        kind_of(tmp_path / "none.toml")
    with pytest.raises(ProfileError, match="no such profile file"):
        kind_of(tmp_path / "nowhere.toml")
    with pytest.raises(ProfileError, match="'toaster' is no profile"):
        kind_of("toaster")


def test_a_circle_of_inheritance_is_refused(tmp_path: Path) -> None:
    for one, other in (("a", "b"), ("b", "a")):
        (tmp_path / f"{one}.toml").write_text(f'inherits = "{other}"\n')
    with pytest.raises(ProfileError, match="circle"):
        load_material(tmp_path / "a.toml")


def test_an_unknown_printer_names_the_known_ones() -> None:
    with pytest.raises(ProfileError, match="prusa_mk3s"):
        load_printer("toaster")


def test_a_material_too_hot_for_the_printer_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hot.toml"
    path.write_text('inherits = "pla"\nname = "hot"\nhotend_c = 400.0\n')
    with pytest.raises(ProfileError, match="400"):
        load_setup(material=path)


def test_a_script_with_an_unknown_name_is_refused() -> None:
    setup = load_setup()
    assert expand_script(("M104 S{hotend_c}",), setup) == ("M104 S210",)
    with pytest.raises(ProfileError, match="nonsense"):
        expand_script(("M104 S{nonsense}",), setup)


def test_the_prime_line_keeps_the_limits_of_printer_and_material() -> None:
    """regression: 0.752 mm² where 0.64 are allowed, and 6 mm³/s of TPU where 3 are."""
    for name in list_profiles("printers"):
        for material in list_profiles("materials"):
            setup = load_setup(name, material)
            lines = expand_script(("{prime_line}",), setup)
            x_mm, e_mm = setup.printer.prime_mm[0], 0.0
            for line in lines:
                words = {w[0]: float(w[1:]) for w in line.split()[1:]}
                if line.startswith("G1") and "E" in words:
                    volume_mm3 = words["E"] * np.pi / 4 * setup.printer.filament_diameter_mm**2
                    section_mm2 = volume_mm3 / (words["X"] - x_mm)
                    assert section_mm2 <= setup.printer.max_bead_section_mm2
                    assert section_mm2 * words["F"] / 60.0 <= setup.max_volumetric_mm3_s
                    e_mm += words["E"]
                x_mm = words.get("X", x_mm)
            assert e_mm > setup.printer.prime_length_mm


def test_the_prime_line_ends_on_a_small_bed(tmp_path: Path) -> None:
    own = tmp_path / "small.toml"
    own.write_text('inherits = "ender_3"\nbed_size_mm = [80.0, 80.0]\npark_mm = [5, 75, 20]\n')
    setup = load_setup(own)
    text = " ".join(expand_script(("{prime_line}",), setup))
    places = [float(x) for x in re.findall(r"X([\d.]+)", text)]
    assert places == sorted(places)
    assert places[-1] == 75.0


OWN_LIMITS = {
    "bead": ('start_gcode = "G28\\nM83\\nG1 Z0.3 F300\\nG1 X5 Y5\\nG1 X45 E12.5 F600"',
             r"line 5 \('G1 X45 E12.5 F600'\): a bead of 0.752 mm², .* is 0.64"),
    "absolute extruder": (
        'start_gcode = "M82\\nG92 E0\\nG1 X5 Y5\\nG1 X65 E9 F1000\\nG1 X105 E21.5 F600"',
        "line 5 .*0.752 mm²"),
    "flow": ('start_gcode = "M83\\nG1 X5 Y5\\nG1 X65 E9 F6000"', "36.1 mm³/s"),
    "standing": ('start_gcode = "M83\\nG1 X5 Y5\\nG1 E60 F100"', "60 mm of filament standing"),
    "reach": ('start_gcode = "G1 X5 Y-9"', "Y -9 mm is out of reach, 0 to 220 mm"),
    "hotend": ('start_gcode = "M104 S300"', "the hotend at 300 °C, 'max_hotend_c' is 260"),
    "close words": ('start_gcode = "M104S300"', "the hotend at 300 °C, 'max_hotend_c' is 260"),
    "place": ("prime_mm = [5.0, 400.0, 0.3]", "'prime_mm': Y 400 mm is out of reach"),
    "priming": ("prime_length_mm = 60.0", "'prime_length_mm' = 60 .*'max_extrude_only_mm' = 50"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "said"), OWN_LIMITS.values(), ids=OWN_LIMITS.keys())
def test_a_profile_that_breaks_its_own_limits_is_refused(
    tmp_path: Path, text: str, said: str
) -> None:
    """regression: its start script was taken, and every job of it refused."""
    own = tmp_path / "mine.toml"
    own.write_text(f'inherits = "generic_klipper"\n{text}\n')
    with pytest.raises(ProfileError, match=f"mine.toml: the profile breaks its own .*{said}"):
        load_printer(own)


def test_a_head_that_nobody_has_measured_goes_near_nothing() -> None:
    printer = load_printer("ender_3_v3_ke")
    assert printer.envelope == ()
    setup = load_setup("ender_3_v3_ke")
    lines = ["G90", "G1 Z20 F600", "G1 X30 Y105 F6000", ""]
    assert find_refusals(Program("\n".join(["G28", *lines]), "klipper"), setup) == ()
    program = Program("\n".join(["G28 X Y", *lines]), "klipper")
    with pytest.raises(ProfileError, match="shape of Creality Ender-3 V3 KE's tool head"):
        find_refusals(program, setup, as_built=HeightField.flat((50.0, 50.0), 1.0, z_mm=3.0))
    with pytest.raises(ProfileError, match="measure it"):
        _ = printer.head


def test_slicers_names_are_not_inherited() -> None:
    """Else the parent's jobs would be taken for the child's machine."""
    assert load_printer("creality_k1c").slicer_names != load_printer("creality_k1").slicer_names
    known = {name: p for p in list_profiles("printers") for name in load_printer(p).slicer_names}
    assert machine_named("Creality Ender-3 V3 KE 0.4 nozzle") == "ender_3_v3_ke"
    assert machine_named("Creality Ender-3 V3") is None, "another machine"
    for pattern, profile in known.items():
        assert machine_named(pattern.replace("*", "")) == profile
