"""PrusaSlicer's `.ini` (one configuration, or a bundle of presets) and OrcaSlicer's JSON presets.

Keys and meanings: PrusaSlicer's and OrcaSlicer's `PrintConfig.cpp`.
"""

from __future__ import annotations

import configparser
import json
from collections.abc import Iterator, Mapping
from glob import escape
from pathlib import Path
from typing import Any

from gcode.errors import InputError
from gcode.profiles.importers.rules import (
    NotMappedError,
    Rule,
    Source,
    choice,
    limit,
    number,
    of_key,
    outline,
    percent,
    script,
    whole,
)
from gcode.profiles.names import Kind

_KNOWN_DIALECT = choice(
    marlin="marlin",
    marlin2="marlin",
    klipper="klipper",
    reprapfirmware="reprap",
)


def _dialect(text: str, source: Source) -> str:
    if text.strip().lower() == "reprap":
        raise NotMappedError(
            "it stands for RepRap/Sprinter and is what nobody chose, so that it tells no firmware; "
            "RepRapFirmware would be 'reprapfirmware'"
        )
    return _KNOWN_DIALECT(text, source)


_PATTERN = choice(
    rectilinear="rectilinear",
    alignedrectilinear="rectilinear",
    zig_zag="rectilinear",
    grid="grid",
    concentric="concentric",
)


def _axes(machine_speed: str) -> dict[str, Rule]:
    return {
        f"machine_max_{theirs}_{axis}": Rule("printers", f"{ours}.{axis}", limit)
        for theirs, ours in (
            (machine_speed, "max_speed_mm_s"),
            ("acceleration", "max_acceleration_mm_s2"),
            ("jerk", "max_jerk_mm_s"),
        )
        for axis in "xyze"
    }


_PRUSA_SCRIPT = script(
    {
        "first_layer_temperature": "first_layer_hotend_c",
        "temperature": "hotend_c",
        "first_layer_bed_temperature": "bed_c",
        "bed_temperature": "bed_c",
    }
)
PRUSA: dict[str, Rule] = {
    **_axes("feedrate"),
    "bed_shape": Rule("printers", "", outline),
    "max_print_height": Rule("printers", "max_z_mm", number),
    "nozzle_diameter": Rule("printers", "nozzle_diameter_mm", number),
    "filament_diameter": Rule("printers", "filament_diameter_mm", number),
    "gcode_flavor": Rule("printers", "dialect", _dialect),
    "retract_length": Rule("printers", "retraction_mm", number),
    "retract_speed": Rule("printers", "retraction_speed_mm_s", number),
    "retract_lift": Rule("printers", "z_hop_mm", number),
    "travel_speed": Rule("printers", "travel_speed_mm_s", number),
    "start_gcode": Rule("printers", "start_gcode", _PRUSA_SCRIPT),
    "end_gcode": Rule("printers", "end_gcode", _PRUSA_SCRIPT),
    "temperature": Rule("materials", "hotend_c", number),
    "first_layer_temperature": Rule("materials", "first_layer_hotend_c", number),
    "bed_temperature": Rule("materials", "bed_c", number),
    "filament_density": Rule("materials", "density_g_cm3", limit),
    "max_fan_speed": Rule("materials", "fan_ratio", percent),
    "bridge_fan_speed": Rule("materials", "bridge_fan_ratio", percent),
    "extrusion_multiplier": Rule("materials", "flow_ratio", number),
    "filament_max_volumetric_speed": Rule("materials", "max_volumetric_mm3_s", limit),
    "layer_height": Rule("processes", "layer_height_mm", number),
    "first_layer_height": Rule("processes", "first_layer_height_mm", of_key("layer_height")),
    "extrusion_width": Rule("processes", "line_width_mm", of_key("layer_height")),
    "perimeters": Rule("processes", "perimeters", whole),
    "fill_density": Rule("processes", "infill_ratio", percent),
    "fill_pattern": Rule("processes", "infill_pattern", _PATTERN),
    "top_solid_layers": Rule("processes", "top_layers", whole),
    "bottom_solid_layers": Rule("processes", "bottom_layers", whole),
    "skirts": Rule("processes", "skirt_loops", whole),
    "skirt_distance": Rule("processes", "skirt_distance_mm", number),
    "perimeter_speed": Rule("processes", "perimeter_speed_mm_s", limit),
    "external_perimeter_speed": Rule(
        "processes", "external_perimeter_speed_mm_s", of_key("perimeter_speed")
    ),
    "infill_speed": Rule("processes", "infill_speed_mm_s", limit),
    "solid_infill_speed": Rule("processes", "solid_infill_speed_mm_s", of_key("infill_speed")),
    "first_layer_speed": Rule("processes", "first_layer_speed_mm_s", of_key("perimeter_speed")),
    "default_acceleration": Rule("processes", "acceleration_mm_s2", limit),
    "bridge_speed": Rule("processes", "bridge_speed_mm_s", limit),
}


_ORCA_SCRIPT = script(
    {
        "nozzle_temperature_initial_layer": "first_layer_hotend_c",
        "nozzle_temperature": "hotend_c",
        "bed_temperature_initial_layer_single": "bed_c",
        "bed_temperature_initial_layer": "bed_c",
        "bed_temperature": "bed_c",
    }
)
ORCA: dict[str, Rule] = {
    **_axes("speed"),
    "printable_area": Rule("printers", "", outline),
    "printable_height": Rule("printers", "max_z_mm", number),
    "nozzle_diameter": Rule("printers", "nozzle_diameter_mm", number),
    "filament_diameter": Rule("printers", "filament_diameter_mm", number),
    "gcode_flavor": Rule("printers", "dialect", _dialect),
    "retraction_length": Rule("printers", "retraction_mm", number),
    "retraction_speed": Rule("printers", "retraction_speed_mm_s", number),
    "z_hop": Rule("printers", "z_hop_mm", number),
    "travel_speed": Rule("printers", "travel_speed_mm_s", number),
    "machine_start_gcode": Rule("printers", "start_gcode", _ORCA_SCRIPT),
    "machine_end_gcode": Rule("printers", "end_gcode", _ORCA_SCRIPT),
    "nozzle_temperature": Rule("materials", "hotend_c", number),
    "nozzle_temperature_initial_layer": Rule("materials", "first_layer_hotend_c", number),
    "hot_plate_temp": Rule("materials", "bed_c", number),
    "filament_density": Rule("materials", "density_g_cm3", limit),
    "fan_max_speed": Rule("materials", "fan_ratio", percent),
    "overhang_fan_speed": Rule("materials", "bridge_fan_ratio", percent),
    "filament_flow_ratio": Rule("materials", "flow_ratio", number),
    "filament_max_volumetric_speed": Rule("materials", "max_volumetric_mm3_s", limit),
    "layer_height": Rule("processes", "layer_height_mm", number),
    "initial_layer_print_height": Rule("processes", "first_layer_height_mm", number),
    "line_width": Rule("processes", "line_width_mm", of_key("nozzle_diameter")),
    "wall_loops": Rule("processes", "perimeters", whole),
    "sparse_infill_density": Rule("processes", "infill_ratio", percent),
    "sparse_infill_pattern": Rule("processes", "infill_pattern", _PATTERN),
    "top_shell_layers": Rule("processes", "top_layers", whole),
    "bottom_shell_layers": Rule("processes", "bottom_layers", whole),
    "skirt_loops": Rule("processes", "skirt_loops", whole),
    "skirt_distance": Rule("processes", "skirt_distance_mm", number),
    "inner_wall_speed": Rule("processes", "perimeter_speed_mm_s", limit),
    "outer_wall_speed": Rule("processes", "external_perimeter_speed_mm_s", limit),
    "sparse_infill_speed": Rule("processes", "infill_speed_mm_s", limit),
    "internal_solid_infill_speed": Rule("processes", "solid_infill_speed_mm_s", limit),
    "initial_layer_speed": Rule("processes", "first_layer_speed_mm_s", limit),
    "default_acceleration": Rule("processes", "acceleration_mm_s2", limit),
    "bridge_speed": Rule("processes", "bridge_speed_mm_s", limit),
}
_PRUSA_KINDS: dict[str, Kind] = {
    "printer": "printers",
    "filament": "materials",
    "print": "processes",
}
PROFILE_NAMES: dict[str, Kind] = {
    "printer_settings_id": "printers",
    "filament_settings_id": "materials",
    "print_settings_id": "processes",
}
REASONS = {
    **dict.fromkeys(
        ("filament_type", "printer_model"), "it only chose the profile that is inherited from"
    ),
    **dict.fromkeys(
        (
            "extruder_clearance_height",
            "extruder_clearance_height_to_lid",
            "extruder_clearance_height_to_rod",
            "extruder_clearance_max_radius",
            "extruder_clearance_radius",
        ),
        "a circle around the tool head is not its shape; measure the envelope",
    ),
}
_ORCA_KINDS: dict[str, Kind] = {
    "machine": "printers",
    "filament": "materials",
    "process": "processes",
}
_LIBRARY = "OrcaFilamentLibrary"  # the vendor from whose presets all others may inherit
# Which part of an exported configuration is there, told by keys that each part always has.
_TELLTALES: dict[str, Kind] = {
    "bed_shape": "printers",
    "temperature": "materials",
    "layer_height": "processes",
}


def read_prusa(path: Path, text: str, preset: str | None) -> Source:
    """Read an exported configuration, or one preset of a bundle with all it inherits.

    Raises
    ------
    InputError
        If the file is neither, or the preset is not in it.
    """
    parser = configparser.RawConfigParser(
        delimiters=("=",), comment_prefixes=("#", ";"), strict=False
    )
    try:
        parser.read_string("[\0]\n" + text)
    except configparser.Error as error:
        what = str(error).splitlines()[0]
        raise InputError(f"{path} cannot be read as a PrusaSlicer .ini ({what}).") from error
    presets = [s for s in parser.sections() if s.partition(":")[0] in _PRUSA_KINDS and ":" in s]
    if not presets:
        values = dict(parser["\0"])
        kinds = tuple(kind for key, kind in _TELLTALES.items() if key in values)
        if not kinds:
            raise InputError(
                f"{path} has none of {', '.join(_TELLTALES)}; export it by PrusaSlicer's "
                f"File, Export, Export Config."
            )
        return Source(path.stem, kinds, values, PROFILE_NAMES, REASONS)
    if preset not in presets:
        shown = ", ".join(repr(name) for name in presets if "*" not in name)
        raise InputError(
            f"{path} is a bundle of presets; name one of them by --preset: {shown[:600]}."
        )
    kind, _, name = preset.partition(":")
    values = _inherited(parser, path, preset, ())
    return Source(name, (_PRUSA_KINDS[kind],), values, missing=REASONS)


def _inherited(
    parser: configparser.RawConfigParser, path: Path, section: str, chain: tuple[str, ...]
) -> dict[str, str]:
    """A preset's values over those of its parents; several are parted by `;`, the last wins."""
    if section in chain or not parser.has_section(section):
        raise InputError(
            f"{path}: preset {chain[-1] if chain else section!r} inherits {section!r}, which is "
            f"{'itself' if section in chain else 'not in the file'}."
        )
    own = dict(parser[section])
    values: dict[str, str] = {}
    for parent in filter(None, (p.strip() for p in own.pop("inherits", "").split(";"))):
        kind = section.partition(":")[0]
        values |= _inherited(parser, path, f"{kind}:{parent}", (*chain, section))
    return values | own


def read_orca(path: Path, text: str, chain: tuple[Path, ...] = ()) -> Source:
    """Read a preset; what it inherits is looked for beside it.

    Raises
    ------
    InputError
        If the file is no preset of OrcaSlicer.
    """
    try:
        content = json.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is no valid JSON ({error}).") from error
    kind = _orca_kind(path, content) if isinstance(content, dict) else None
    if kind is None:
        raise InputError(
            f"{path} is no OrcaSlicer preset: its 'type' is none of {', '.join(_ORCA_KINDS)}."
        )
    values = {key: _text(value) for key, value in content.items()}
    parent = _parent_file(path, values.get("inherits", ""))
    if parent is not None:
        if parent in chain:
            raise InputError(f"{path}: 'inherits' runs in a circle; remove one link.")
        above = read_orca(parent, parent.read_text(encoding="utf-8"), (*chain, path))
        values = {**above.values, **values}
        del values["inherits"]
    values.pop("type", None)
    missing = {
        "inherits": "its parent is neither beside the file nor among its slicer's presets: what "
        "that sets is not known here"
    }
    return Source(path.stem, (kind,), values, {"name": kind}, {**REASONS, **missing})


def _orca_kind(path: Path, content: Mapping[str, Any]) -> Kind | None:
    """What a preset describes: as it says, by its settings, by the folder that it lies in.

    Those that come with the slicer have a `type`; what a user saves has none.
    """
    if "type" in content:
        return _ORCA_KINDS.get(str(content["type"]))
    named = next((kind for key, kind in PROFILE_NAMES.items() if key in content), None)
    folders = (_ORCA_KINDS[part] for part in reversed(path.parts[:-1]) if part in _ORCA_KINDS)
    return named or next(folders, None)


def _parent_file(path: Path, name: str) -> Path | None:
    """The preset that one inherits: beside it, or among its slicer's own presets.

    A user's preset lies in `user/ACCOUNT/machine/`, and what it inherits in
    `system/VENDOR/machine/` of the same configuration folder.
    """
    if not name:
        return None
    beside = path.parent / f"{name}.json"
    if beside.is_file():
        return beside
    for folder in _kept_in(path):
        found = sorted(folder.rglob(f"{escape(name)}.json"))
        if found:
            return found[0]
    return None


def _kept_in(path: Path) -> Iterator[Path]:
    """Where presets of that kind are: the vendor's own first, then all vendors'."""
    above = path.resolve().parents
    kind = next((folder for folder in above if folder.name in _ORCA_KINDS), None)
    if kind is not None:
        yield kind
    for folder in above:
        if folder.name in {"user", "system", "profiles"}:
            everyones = folder if folder.name == "profiles" else folder.parent / "system"
            found = everyones.glob(f"*/{kind.name if kind else '*'}")
            yield from sorted(found, key=lambda one: (one.parent.name != _LIBRARY, one))
            return


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(_text(item) for item in value)
    if isinstance(value, Mapping):
        return json.dumps(value)
    return str(value)
