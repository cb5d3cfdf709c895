"""Machines with several heads: each has its own heater, and its own filament pulled back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amrepair.loop import travel
from amrepair.loop.filaments import materials_of
from gcode.check import Policy, check, find_refusals
from gcode.errors import InputError, ReadError
from gcode.firmware import FirmwareCore
from gcode.hosts.modes import Modes, follow
from gcode.moves import Program
from gcode.profiles import PrintSetup, load_setup
from gcode.profiles.own_settings import own_settings, setup_for_head
from gcode.reader import Job, job_for
from gcode.resumption.head import filament_back_mm, state_at_rest
from gcode.resumption.leaving_out import require_same_head
from gcode.resumption.resume_at import resume_at

PROFILES = {"marlin": "prusa_xl_2t", "klipper": "generic_klipper", "reprap": "generic_reprap"}


def setup_of(dialect: str = "marlin", heads: int = 2) -> PrintSetup:
    setup = load_setup(PROFILES[dialect])
    return replace(setup, printer=setup.printer.model_copy(update={"heads": heads}))


def layer(head: int, z_mm: float, hot: str = "") -> str:
    """A square by one head, taken as PrusaSlicer's jobs for the XL take it."""
    x, e = 100 + 30 * head, 20 * 0.08 / 2.405
    sides = "\n".join(
        f"G1 X{x + dx} Y{100 + dy} E{e:.5f} F1200"
        for dx, dy in ((20, 0), (20, 20), (0, 20), (0, 0))
    )
    return (
        f"G1 E-1.2 F2100\n{hot}T{head}\nG1 X{x} Y100 F9000\nG1 Z{z_mm:.1f} F600\n"
        f"G1 E1.2 F2100\n{sides}"
    )


HEATED = "M140 S60\nM104 T1 S215\nM109 T0 S215\nM109 T1 S215\nM190 S60"
BEGIN = f"G21\nG90\nM83\n{HEATED}\nG28\nT0\nG1 X20 Y20 Z5 F6000\nG1 E1.2 F2100"
ALL_OFF = "G1 E-1.2 F2100\nG1 Z50 F600\nM104 T0 S0\nM104 T1 S0\nM140 S0"


def job_text(begin: str = BEGIN, end: str = ALL_OFF, layers: int = 20) -> str:
    marked = [
        f";LAYER_CHANGE\n;Z:{0.2 * (k + 1):.1f}\n;HEIGHT:0.2\n{layer(0, 0.2 * (k + 1))}\n"
        f"{layer(1, 0.2 * (k + 1))}"
        for k in range(layers)
    ]
    return "\n".join([begin, *marked, end, ""])


def refused(text: str, dialect: str = "marlin") -> list[str]:
    return [str(one) for one in find_refusals(Program(text, dialect), setup_of(dialect))]


def test_a_job_may_change_between_heads() -> None:
    """regression: refused as soon as it changed the tool after it had printed."""
    assert refused(job_text()) == []


@pytest.mark.parametrize(
    ("begin", "end", "said"),
    [
        (BEGIN.replace("M109 T1 S215\n", ""), ALL_OFF, "cold extrusion: hotend waited for at 0"),
        (f"{BEGIN}\nM104 T1 S70\nM104 T1 S215", ALL_OFF, "waited for at 70"),
        (BEGIN, ALL_OFF.replace("M104 T1 S0\n", ""), "left on at the end, M104 T1 S0 is lacking"),
        (BEGIN, ALL_OFF.replace("M104 T0 S0\n", ""), "hotend of T0 left on at the end"),
        (BEGIN, ALL_OFF.replace("M104 T1 S0\nM140 S0", "M104 S0\nM140 S0\nT0\nM104 S0"), ""),
        (f"{BEGIN}\nM104 T1 S999", ALL_OFF, "hotend temperature: 999 °C"),
        (f"{BEGIN}\nT2", ALL_OFF, "another tool: T2, limit those of 2 heads"),
    ],
)
def test_each_head_is_judged_by_its_own_heater(begin: str, end: str, said: str) -> None:
    found = refused(job_text(begin, end))
    assert any(said in one for one in found) if said else found == []


def test_what_one_head_has_pulled_back_another_does_not_push() -> None:
    """A head pushes fresh plastic as soon as its own filament is at the tip again."""
    own = f"{BEGIN}\nG1 E-20 F2100\nT1\nT0\nG1 X20 Y21 Z5\nG1 X20 Y25 E20 F1200"
    others = f"{BEGIN}\nG1 E-20 F2100\nT1\nG1 X20 Y21 Z5\nG1 X20 Y25 E20 F1200"
    assert refused(f"{own}\n{ALL_OFF}") == []
    assert any("too thick" in one for one in refused(f"{others}\n{ALL_OFF}"))


def test_heads_that_a_users_job_leaves_on_are_switched_off() -> None:
    text = job_text(end="G1 E-1.2 F2100\nG1 Z50 F600\nM104 S0\nM140 S0")
    made = check(Program(text, "marlin"), setup_of(), policy=Policy.DANGER)
    assert made.report.added == ("M104 T0 S0",)
    assert heater_targets(made.program.text) == [0.0, 0.0]
    left = check(
        Program(text, "marlin"), setup_of(), policy=Policy.DANGER, leave_heaters=True
    ).report
    assert left.added == ()
    assert any("hotend of T0 left on" in str(one) for one in left.warnings)


def emulated(text: str, dialect: str = "marlin", heads: int = 2) -> FirmwareCore:
    core = FirmwareCore(setup_of(dialect, heads).printer, dialect)
    for line in text.splitlines():
        core.feed(line.encode() + b"\n")
        core.run()
    return core


def heater_targets(text: str, dialect: str = "marlin", heads: int = 2) -> list[float]:
    return [one.target_c for one in emulated(text, dialect, heads).machine.heads.heaters]


WORDS = {
    "marlin": (
        "M104 S{c}", "M109 S{c}", "M104 T{k} S{c}", "M109 T{k} S{c}", "T{k}",
        "M104.1 T{k} P30 Q32 S{c}",
    ),
    "klipper": (
        "M104 S{c}", "M104 T{k} S{c}", "T{k}", "SET_HEATER_TEMPERATURE HEATER={n} TARGET={c}",
        "ACTIVATE_EXTRUDER EXTRUDER={n}", "SET_HEATER_TEMPERATURE HEATER={n}", "TURN_OFF_HEATERS",
    ),
    "reprap": ("M104 S{c}", "M104 T{k} S{c}", "G10 P{k} S{c} R{c}", "M568 P{k} S{c} R{c}", "T{k}"),
}  # fmt: skip
LINES = st.lists(
    st.tuples(st.integers(0, 9), st.integers(0, 2), st.sampled_from([0, 70, 180, 215])), max_size=12
)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(WORDS)), LINES)
def test_all_know_the_same_of_each_head(dialect: str, told: list[tuple[int, int, int]]) -> None:
    """What a program tells heads: reader, hosts' modes, checker and firmware read it alike."""
    words = WORDS[dialect]
    said = [
        words[which % len(words)].format(k=k, c=c, n=f"extruder{k or ''}") for which, k, c in told
    ]
    core = emulated("\n".join([*said, ""]), dialect, heads=3)
    there = [one.target_c for one in core.machine.heads.heaters]
    lines = ["G90", "M83", "G28", "G1 X20 Y20 Z0.2 F600", "G1 X30 E1", *said]
    setup = setup_of(dialect, heads=3)
    program = Program("\n".join([*lines, ""]), dialect)
    state = job_for(program, setup.printer).state_after(len(lines))
    assert list(state.hotends_c) == there
    assert state.heater == core.machine.heads.chosen
    modes = Modes()
    for line in lines:
        modes = follow(modes, line, dialect)
    assert list(modes.targets_c(3)) == there
    assert modes.tool == state.tool
    left_on = [
        one
        for one in find_refusals(program, setup)
        if "hotend" in one.what and "left on" in one.what
    ]
    assert len(left_on) == sum(c > 0 for c in there)


def job() -> Job:
    return job_for(Program(job_text(), "marlin"), setup_of().printer)


def test_the_state_after_a_line_has_each_head() -> None:
    read = job()
    after = read.state_after(read.layers[3].first_line)
    assert (after.hotends_c, after.tool, after.hotend_c, after.bed_c) == ((215, 215), 1, 215, 60)
    parked = after.with_hotend(0.0)
    assert (parked.hotends_c, parked.hotend_c) == ((215, 0), 0)


def test_one_nozzle_has_one_heater_whatever_its_filaments_are_called() -> None:
    one = setup_of().printer.model_copy(update={"heads": 5, "one_nozzle": True})
    text = job_text(BEGIN.replace("M104 T1 S215\n", "").replace("M109 T1 S215\n", ""))
    read = job_for(Program(text, "marlin"), one)
    state = read.state_after(read.layers[3].first_line)
    assert (state.hotends_c, state.tool, state.hotend_c) == ((215.0,), 1, 215.0)


def test_each_head_keeps_what_it_has_pulled_back() -> None:
    read = job()
    back_mm, tools = filament_back_mm(read), read.tools
    changes = np.flatnonzero(np.diff(tools)) + 1
    assert np.allclose(back_mm[changes[1:]], 1.2), "as the head was left"
    assert np.allclose(back_mm[read.layers[3].first_line], 0.0)


def test_what_is_resumed_heats_every_head_and_takes_the_one_that_printed() -> None:
    """regression: one head was heated, and the next one extruded cold."""
    made = resume_at(Program(job_text(), "marlin"), setup_of(), layer=10)
    lines = made.checked.program.text.split("\n")
    first = lines.index(";LAYER_CHANGE")
    core = emulated("\n".join(lines[:first]))
    now_s = core.machine.clock_s
    hot = [one.temperature_c(now_s) for one in core.machine.heads.heaters]
    assert core.machine.heads.chosen == 1
    assert all(c >= 214 for c in hot)
    rest = emulated(made.checked.program.text)
    assert b"cold extrusion" not in rest.take_output()
    assert [one.target_c for one in rest.machine.heads.heaters] == [0.0, 0.0]


def test_a_head_that_was_off_stays_off() -> None:
    text = job_text(BEGIN.replace("M104 T1 S215\n", "").replace("M109 T1 S215\n", ""))
    text = text.replace("T1\n", "T0\n")
    made = resume_at(Program(text, "marlin"), setup_of(), layer=10)
    before = made.checked.program.text.split(";LAYER_CHANGE")[0]
    assert heater_targets(before) == [215.0, 0.0]


def test_objects_are_not_left_out_where_another_head_is_taken_among_them() -> None:
    read = job()
    changes = np.flatnonzero(np.diff(read.tools)) + 1
    require_same_head(read, int(changes[1]), int(changes[2]) - 1)
    with pytest.raises(InputError, match="takes another head"):
        require_same_head(read, int(changes[1]), int(changes[2]))


@pytest.mark.parametrize(
    ("dialect", "lines", "said"),
    [
        ("marlin", ["M105"], "ok T:22.00 /0.00 B:22.00 /0.00 "
         "T0:22.00 /0.00 T1:22.00 /0.00 @:0 B@:0"),
        ("marlin", ["M104 T1 S50", "M104 S40", "T1", "M105"], "ok T:22.00 /50.00 B:22.00 /0.00 "
         "T0:22.00 /40.00 T1:22.00 /50.00 @:0 B@:0"),
        ("klipper", ["M104 T1 S50", "M105"], "ok B:22.0 /0.0 T0:22.0 /0.0 T1:22.0 /50.0"),
        ("marlin", ["M104 T2 S50"], "echo:M104 T2 Invalid extruder"),
        ("marlin", ["M109 T0 S215", "T1", "G1 E5"], "echo: cold extrusion prevented"),
    ],
)  # fmt: skip
def test_the_emulated_firmware_tells_of_each_head(
    dialect: str, lines: list[str], said: str
) -> None:
    core = emulated("\n".join(lines[:-1]), dialect)
    core.take_output()
    core.feed(lines[-1].encode() + b"\n")
    core.run()
    assert said in core.take_output().decode().splitlines()


def test_a_head_of_reprapfirmwares_waits_at_its_own_temperature() -> None:
    lines = ["G10 P0 S200 R150", "G10 P1 S220 R160", "T1"]
    assert heater_targets("\n".join(lines[:2]), "reprap") == [200.0, 160.0]
    assert heater_targets("\n".join(lines), "reprap") == [150.0, 220.0]
    found = refused("\n".join(["G28", *lines, "G10 P1 S0", "G10 P0 S0", ""]), "reprap")
    assert any("hotend of T0 left on at the end, G10 P0 S0 R0 is lacking: 150" in o for o in found)


@pytest.mark.parametrize(("heads", "tool"), [(1, 0), (1, 1), (2, 0), (2, 1)])
def test_modes_heat_the_heads_that_are_on_the_chosen_one_last(heads: int, tool: int) -> None:
    modes = Modes()
    for line in ("M104 T0 S200", "M104 T1 S210", f"T{tool}"):
        modes = follow(modes, line, "marlin")
    waited = [line for line in modes.heating(heads, "marlin") if line.startswith("M109")]
    own, other = (f"M109 S{200 + 10 * tool}", f"M109 T{1 - tool} S{210 - 10 * tool}")
    assert waited == ([other, own] if heads == 2 else ["M109 S200"])


def test_a_printer_with_one_head_says_what_to_do_about_a_second() -> None:
    one = setup_of("klipper", heads=1)
    text = f"G28\nG90\nM83\n{HEATED.replace(' T1', '').replace(' T0', '')}\nG1 X20 Y20 Z0.2 F600"
    found = find_refusals(Program(f"{text}\nG1 X30 E1\nT1\nM104 S0\nM140 S0\n", "klipper"), one)
    assert ["where heads change, the profile's 'heads' says so" in str(o) for o in found] == [True]


OFFSETS = "; extruder_offset = 0x0,{}\n"
SLICED = "; generated by PrusaSlicer 2.7.4\n" + "".join(f"; key_{k} = 0\n" for k in range(20)) + (
    "; layer_height = 0.2\n; nozzle_diameter = 0.4,0.4\n; bed_shape = 0x0,360x0,360x360,0x360\n"
)  # fmt: skip


@pytest.mark.parametrize(
    ("offset", "said"), [("0x0", ""), ("22.5x-0.3", "moved what head T1 lays")]
)
def test_a_slicer_s_own_offsets_of_nozzles_are_not_followed(offset: str, said: str) -> None:
    text = f"{job_text()}{SLICED}{OFFSETS.format(offset)}"
    if not said:
        resume_at(Program(text, "marlin"), setup_of(), layer=10)
        return
    with pytest.raises(ReadError, match=said):
        resume_at(Program(text, "marlin"), setup_of(), layer=10)


def test_a_look_leaves_the_present_head_where_it_was_and_hot() -> None:
    """Aside for a scan and back: no head is changed, heated or cooled, no filament lost."""
    setup, read = setup_of(), job()
    line = read.layers[5].first_line
    state = state_at_rest(read, line)
    aside, parked = travel.park(setup, state)
    back, modes = travel.way_back(setup, state, parked)
    lines = read.program.text.split("\n")
    core = emulated("\n".join(lines[:line]))
    machine = core.machine
    before = (machine.x, machine.y, machine.z, machine.native_e, machine.heads.chosen)
    for program in (aside, back, modes):
        for text in program.program.text.splitlines():
            core.feed(text.encode() + b"\n")
            core.run()
    after = (machine.x, machine.y, machine.z, machine.native_e, machine.heads.chosen)
    assert after == pytest.approx(before, abs=1e-3)
    assert [one.target_c for one in machine.heads.heaters] == [215.0, 215.0]
    assert b"cold extrusion" not in core.take_output()


def test_material_by_another_nozzle_is_another_one() -> None:
    told = f"{SLICED}; filament_type = PLA;PLA\n".replace("= 0.4,0.4", "= 0.4,0.6")
    text = f"; generated by PrusaSlicer 2.7.4\n{job_text()}{told}"
    assert materials_of(text) == ("PLA by 0.4 mm", "PLA by 0.6 mm")
    assert materials_of(text.replace("0.4,0.6", "0.6,0.6")) == ("PLA", "PLA")


def test_a_repair_is_laid_as_the_material_of_the_present_head_asks() -> None:
    """regression: by that of the head which prints most, whichever was there."""
    told = "; filament_type = PLA;PETG\n; max_fan_speed = 100,50\n; min_fan_speed = 100,50\n"
    told += "; filament_max_volumetric_speed = 15,8\n; temperature = 215,240\n"
    told += "; first_layer_temperature = 215,240\n; bed_temperature = 60,60\n"
    text = f"; generated by PrusaSlicer 2.7.4\n{job_text()}{SLICED}{told}"
    own = own_settings(text, "job.gcode")
    assert own is not None
    setup = own.setup()
    each = [setup_for_head(setup, text, head).material for head in (0, 1)]
    assert [one.max_volumetric_mm3_s for one in each] == [15.0, 8.0]
    assert [one.hotend_c for one in each] == [215.0, 240.0]
    chosen = replace(setup, material=load_setup().material)
    assert setup_for_head(chosen, text, 1) == chosen, "who names a material means it"


@pytest.mark.parametrize("dialect", ["marlin", "klipper"])
def test_a_head_that_is_not_there_is_refused_and_changes_nothing(dialect: str) -> None:
    text = f"{BEGIN}\nT5\n{layer(0, 0.2)}\n{ALL_OFF}\n"
    assert [one.split(": ", 1)[1] for one in refused(text, dialect)] == [
        "another tool: T5, limit those of 2 heads, from T0 on"
    ]
    lines = text.split("\n")
    state = job_for(Program(text, dialect), setup_of(dialect).printer).state_after(
        lines.index("T5") + 1
    )
    assert (state.tool, state.hotend_c) == (0, 215.0)
