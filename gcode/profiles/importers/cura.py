"""What Cura writes into a job: its header, and the settings that differ from its own definitions.

Cura leaves a JSON object behind the job, cut into comments `;SETTING_3 `: two containers of text,
`global_quality` and `extruder_quality` (one for each extruder), each an .ini. Whatever is as the
machine's definition has it is not there. Keys and meanings: Cura's `fdmprinter.def.json`.
"""

from __future__ import annotations

import configparser
import json
import re
from typing import Any

from gcode.errors import InputError
from gcode.profiles.importers.rules import (
    NotMappedError,
    Rule,
    Source,
    bed,
    choice,
    limit,
    number,
    percent,
    script,
    whole,
)
from gcode.profiles.names import Kind

SETTING_MARK = ";SETTING_3 "
HEADER = re.compile(
    r"^;(FLAVOR|TARGET_MACHINE\.NAME|Layer height|GENERATOR\.NAME|GENERATOR\.VERSION"
    r"|EXTRUDER_TRAIN\.0\.(?:NOZZLE\.DIAMETER|INITIAL_TEMPERATURE|MATERIAL\.GUID)"
    r"|BUILD_PLATE\.INITIAL_TEMPERATURE):(.*)$",
    re.MULTILINE,
)
HEAD_CHARACTERS = 20_000  # the header is before the first layer
_SCRIPT = script(
    {
        "material_print_temperature_layer_0": "first_layer_hotend_c",
        "material_print_temperature": "hotend_c",
        "material_bed_temperature_layer_0": "bed_c",
        "material_bed_temperature": "bed_c",
    }
)


def _dialect(text: str, source: Source) -> str:
    named = choice(
        **{"marlin (volumetric)": "marlin"}, marlin="marlin", reprap="reprap", klipper="klipper"
    )
    return named({"reprapfirmware": "reprap"}.get(text, text), source)


def _bed(text: str, source: Source) -> dict[str, Any]:
    """Both sides at once."""
    keys = ("machine_width", "machine_depth")
    if any(key not in source.values for key in keys):
        raise NotMappedError("only one side of the bed is given")
    x_mm, y_mm = (number(source.values[key], source) for key in keys)
    centred = source.values.get("machine_center_is_zero", "").lower() == "true"
    rounded = source.values.get("machine_shape", "") == "elliptic"
    if centred:
        return bed((-x_mm / 2, x_mm / 2), (-y_mm / 2, y_mm / 2), rounded=rounded)
    return bed((0.0, x_mm), (0.0, y_mm), rounded=rounded)


def _steady(rule: Rule) -> Rule:
    """A setting that Cura reckons from others when it slices is a formula and no value."""

    def convert(text: str, source: Source) -> Any:
        if text.startswith("="):
            raise NotMappedError("it is a formula of Cura's, which only Cura can reckon")
        return rule.convert(text, source)

    return Rule(rule.kind, rule.key, convert)


_CURA_RULES: dict[str, Rule] = {
    "FLAVOR": Rule("printers", "dialect", _dialect),
    "EXTRUDER_TRAIN.0.NOZZLE.DIAMETER": Rule("printers", "nozzle_diameter_mm", number),
    "machine_width": Rule("printers", "", _bed),
    "machine_depth": Rule("printers", "", _bed),
    "machine_height": Rule("printers", "max_z_mm", number),
    "machine_nozzle_size": Rule("printers", "nozzle_diameter_mm", number),
    "machine_gcode_flavor": Rule("printers", "dialect", _dialect),
    "material_diameter": Rule("printers", "filament_diameter_mm", number),
    **{
        f"machine_max_{theirs}_{axis}": Rule("printers", f"{ours}.{axis}", number)
        for theirs, ours in (
            ("feedrate", "max_speed_mm_s"),
            ("acceleration", "max_acceleration_mm_s2"),
        )
        for axis in "xyze"
    },
    "retraction_amount": Rule("printers", "retraction_mm", number),
    "retraction_speed": Rule("printers", "retraction_speed_mm_s", number),
    "retraction_hop": Rule("printers", "z_hop_mm", number),
    "speed_travel": Rule("printers", "travel_speed_mm_s", number),
    "machine_start_gcode": Rule("printers", "start_gcode", _SCRIPT),
    "machine_end_gcode": Rule("printers", "end_gcode", _SCRIPT),
    "EXTRUDER_TRAIN.0.INITIAL_TEMPERATURE": Rule("materials", "first_layer_hotend_c", number),
    "BUILD_PLATE.INITIAL_TEMPERATURE": Rule("materials", "bed_c", number),
    "material_print_temperature": Rule("materials", "hotend_c", number),
    "material_print_temperature_layer_0": Rule("materials", "first_layer_hotend_c", number),
    "material_bed_temperature": Rule("materials", "bed_c", number),
    "cool_fan_speed": Rule("materials", "fan_ratio", percent),
    "material_flow": Rule("materials", "flow_ratio", percent),
    "Layer height": Rule("processes", "layer_height_mm", limit),
    "layer_height": Rule("processes", "layer_height_mm", number),
    "layer_height_0": Rule("processes", "first_layer_height_mm", number),
    "line_width": Rule("processes", "line_width_mm", number),
    "wall_line_count": Rule("processes", "perimeters", whole),
    "infill_sparse_density": Rule("processes", "infill_ratio", percent),
    "infill_pattern": Rule(
        "processes",
        "infill_pattern",
        choice(lines="rectilinear", zigzag="rectilinear", grid="grid", concentric="concentric"),
    ),
    "top_layers": Rule("processes", "top_layers", whole),
    "bottom_layers": Rule("processes", "bottom_layers", whole),
    "skirt_line_count": Rule("processes", "skirt_loops", whole),
    "skirt_gap": Rule("processes", "skirt_distance_mm", number),
    "speed_wall_x": Rule("processes", "perimeter_speed_mm_s", limit),
    "speed_wall_0": Rule("processes", "external_perimeter_speed_mm_s", limit),
    "speed_infill": Rule("processes", "infill_speed_mm_s", limit),
    "speed_topbottom": Rule("processes", "solid_infill_speed_mm_s", limit),
    "speed_layer_0": Rule("processes", "first_layer_speed_mm_s", limit),
    "acceleration_print": Rule("processes", "acceleration_mm_s2", limit),
}
CURA = {key: _steady(rule) for key, rule in _CURA_RULES.items()}
_NO_MACHINE = frozenset({"fdmprinter", "custom"})  # definitions of anybody's printer


def read_cura(name: str, text: str) -> Source | None:
    """The settings that Cura wrote into a job; None where it is not Cura's.

    Raises
    ------
    InputError
        If the settings behind the job are cut or changed.
    """
    head = dict(HEADER.findall(text[:HEAD_CHARACTERS]))
    values = {key: value.strip() for key, value in head.items()}
    if "FLAVOR" not in values or not ({"TARGET_MACHINE.NAME", "Layer height"} & set(values)):
        return None
    values |= _changed(name, text)
    names: dict[str, Kind] = {"TARGET_MACHINE.NAME": "printers"}
    if "TARGET_MACHINE.NAME" not in values and values.get("definition") not in _NO_MACHINE:
        names = {"definition": "printers"}
    missing = {"definition": "it only chose the profile that is inherited from"}
    missing |= dict.fromkeys(
        ("GENERATOR.NAME", "GENERATOR.VERSION"), "it tells the slicer, and nothing of the machine"
    )
    return Source(name, ("printers", "materials", "processes"), values, names, missing)


def _changed(name: str, text: str) -> dict[str, str]:
    """Settings that the user changed; the first extruder's count over the machine's."""
    lines = [
        line[len(SETTING_MARK) :] for line in text.splitlines() if line.startswith(SETTING_MARK)
    ]
    if not lines:
        return {}
    try:
        found = json.loads("".join(lines))
        containers = [found.get("global_quality", ""), *found.get("extruder_quality", [])[:1]]
        values: dict[str, str] = {}
        for container in containers:
            parser = configparser.RawConfigParser(delimiters=("=",), strict=False)
            parser.optionxform = str  # type: ignore[method-assign, assignment]
            parser.read_string(container.replace("\\n", "\n"))
            values |= dict(parser["values"]) if parser.has_section("values") else {}
            if parser.has_option("general", "definition"):
                values.setdefault("definition", parser.get("general", "definition"))
    except (ValueError, AttributeError, TypeError, configparser.Error) as error:
        raise InputError(
            f"{name}: the settings that Cura wrote behind the job ('{SETTING_MARK.strip()}') "
            f"cannot be read ({str(error).splitlines()[0]}); slice the part again."
        ) from error
    return values
