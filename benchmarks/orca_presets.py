"""OrcaSlicer's presets as jobs: its machines' scripts expanded, its settings as it writes them.

A preset's scripts are in the slicer's macro language (`{if …}`, `{max_layer_z + 2}`, `[name]`; the
grammar of PrusaSlicer's PlaceholderParser); they are expanded for a block of known size. The block
is cut by another slicer from the same bed, speeds and lengths (`prusa_settings`). Nothing is judged
here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gcode.errors import InputError
from gcode.profiles.importers.slicers import read_orca

Box = tuple[float, float, float]
NOZZLE = "0.4"
# Orca's own defaults of what presets leave out, and what slicing tells; no file says them.
_DEFAULTS: dict[str, Any] = {
    "curr_bed_type": "High Temp Plate",
    "layer_height": "0.2",
    "initial_layer_print_height": "0.2",
    "different_settings_to_system": ";;",
    "line_width": "0.42",
    "nozzle_temperature": "210",
    "nozzle_temperature_initial_layer": "215",
    "hot_plate_temp": "60",
    "hot_plate_temp_initial_layer": "60",
    "chamber_temperature": "0",
    "filament_type": "PLA",
    "filament_diameter": "1.75",
    "filament_max_volumetric_speed": "12",
    "filament_multitool_ramming": "0",
    "filament_notes": "",
    "printer_notes": "",
    "printer_model": "",
    "idle_temperature": "0",
    "nozzle_temperature_range_low": "190",
    "nozzle_temperature_range_high": "240",
    "temperature_vitrification": "60",
    "standby_temperature_delta": "-5",
    "during_print_exhaust_fan_speed": "60",
    "additional_cooling_fan_speed": "0",
    "activate_air_filtration": "0",
    "support_air_filtration": "0",
    "complete_print_exhaust_fan_speed": "80",
    "default_acceleration": "500",
    "outer_wall_acceleration": "500",
    "enable_pressure_advance": "0",
    "pressure_advance": "0.02",
    "scan_first_layer": "0",
    "spiral_mode": "0",
    "timelapse_type": "0",
    "print_sequence": "by layer",
    "retraction_length": "0.8",
    "retraction_speed": "30",
    "retract_length_toolchange": "10",
    "travel_speed": "120",
    "fan_max_speed": "100",
    "printable_height": "200",
    "z_offset": "0",
    "machine_max_acceleration_travel": "1500",
    "filament_settings_id": "Somebody's",
    "print_settings_id": "Somebody's",
    "printer_settings_id": "Somebody's",
}
_FLAVOURS = {"klipper": "marlin2", "marlin": "marlin", "reprapfirmware": "reprapfirmware"}
# PrusaSlicer's key for each of Orca's that shapes a block.
_ALIKE = {
    "printable_height": "max_print_height",
    "retraction_length": "retract_length",
    "retraction_speed": "retract_speed",
    "z_hop": "retract_lift",
    "travel_speed": "travel_speed",
    "layer_height": "layer_height",
    "initial_layer_print_height": "first_layer_height",
    "outer_wall_speed": "external_perimeter_speed",
    "inner_wall_speed": "perimeter_speed",
    "sparse_infill_speed": "infill_speed",
    "internal_solid_infill_speed": "solid_infill_speed",
    "initial_layer_speed": "first_layer_speed",
    "wall_loops": "perimeters",
    "nozzle_diameter": "nozzle_diameter",
    "filament_diameter": "filament_diameter",
    "nozzle_temperature": "temperature",
    "nozzle_temperature_initial_layer": "first_layer_temperature",
    "hot_plate_temp": "bed_temperature",
    "hot_plate_temp_initial_layer": "first_layer_bed_temperature",
    "filament_max_volumetric_speed": "filament_max_volumetric_speed",
    "filament_flow_ratio": "extrusion_multiplier",
    "default_acceleration": "default_acceleration",
    **{
        f"machine_max_{orca}_{axis}": f"machine_max_{prusa}_{axis}"
        for orca, prusa in (("speed", "feedrate"), ("acceleration",) * 2, ("jerk",) * 2)
        for axis in "xyze"
    },
}
_ROLES = {
    "External perimeter": "Outer wall",
    "Perimeter": "Inner wall",
    "Internal infill": "Sparse infill",
    "Solid infill": "Internal solid infill",
    "Top solid infill": "Top surface",
    "Skirt/Brim": "Skirt",
}


@dataclass(frozen=True, slots=True)
class OrcaPrinter:
    """A machine of OrcaSlicer's with the process and filament that it is sold with."""

    vendor: str
    name: str
    settings: Mapping[str, str]


def orca_printers(profiles: Path) -> Iterator[OrcaPrinter]:
    """Every machine with a nozzle of 0.4 mm below a folder of Orca's profiles."""
    for vendor in sorted(path for path in profiles.iterdir() if (path / "machine").is_dir()):
        for path in sorted((vendor / "machine").rglob("*.json")):
            try:
                machine = _preset(path)
            except InputError:  # a model, of which each nozzle is a machine
                continue
            nozzle = machine.get("nozzle_diameter", "").split(",")[0]
            if machine.get("instantiation") != "true" or nozzle != NOZZLE:
                continue
            made: dict[str, str] = {}
            for what in ("process", "filament"):
                key = {"process": "default_print_profile"}.get(what, "default_filament_profile")
                found = _named(vendor, what, machine.get(key, "").split(",")[0].split(";")[0])
                made |= {} if found is None else _preset(found)
            named = {"printer_settings_id": path.stem}
            yield OrcaPrinter(vendor.name, path.stem, {**_DEFAULTS, **made, **machine, **named})


def _preset(path: Path) -> dict[str, str]:
    return dict(read_orca(path, path.read_text(encoding="utf-8")).values)


def _named(vendor: Path, what: str, name: str) -> Path | None:
    for folder in (vendor, vendor.parent / "OrcaFilamentLibrary"):
        for path in folder.glob(f"{what}/**/*.json"):
            if path.stem == name.strip():
                return path
    return None


def prusa_settings(printer: OrcaPrinter, block: Box) -> dict[str, str]:
    """A configuration of PrusaSlicer's that cuts the block as Orca's would."""
    told = printer.settings
    flavour = _FLAVOURS.get(told.get("gcode_flavor", "marlin"), "marlin")
    made = {_ALIKE[key]: value.split(",")[0] for key, value in told.items() if key in _ALIKE}
    limits = told.get("gcode_flavor", "marlin").startswith(("marlin", "reprap"))
    limits = limits and told.get("emit_machine_limits_to_gcode", "1") == "1"
    relative = told.get("use_relative_e_distances", "1")
    of_layers = told.get("layer_change_gcode", "") + told.get("before_layer_change_gcode", "")
    if relative == "0" and "G92 E0" in of_layers:
        raise InputError("OrcaSlicer refuses G92 E0 at layers where E is absolute.")
    height = float(told["layer_height"])
    most = max(height, float(told["initial_layer_print_height"]))
    scripts = Scripts(printer, block)
    start = scripts.filled("machine_start_gcode", "filament_start_gcode")
    end = scripts.filled("filament_end_gcode", "machine_end_gcode")
    return made | {
        "bed_shape": told["printable_area"],
        "gcode_flavor": flavour,
        "use_relative_e_distances": relative,
        "gcode_comments": "0",
        "machine_limits_usage": "emit_to_gcode" if limits else "ignore",
        "extrusion_width": str(max(0.42, 1.05 * most)),
        "skirts": "1",
        "fill_density": "15%",
        "start_gcode": start.replace("\n", "\\n"),
        "end_gcode": end.replace("\n", "\\n"),
        "before_layer_gcode": ";ORCA before [layer_num] [layer_z]",
        # It insists on the first where E is relative.
        "layer_gcode": "G92 E0\\n" * int(relative) + ";ORCA layer [layer_num] [layer_z]",
    }


def as_orca(text: str, printer: OrcaPrinter, block: Box) -> str:
    """A job by `prusa_settings` as OrcaSlicer would have written it."""
    body, _, _ = text.partition("; prusaslicer_config = begin")
    scripts = Scripts(printer, block)

    def of_layer(mark: re.Match[str]) -> str:
        which, number, z_mm = mark.groups()
        key = {"before": "before_layer_change_gcode", "layer": "layer_change_gcode"}[which]
        return scripts.filled(key, layer_num=float(number), layer_z=float(z_mm))

    mark = r"^(?:G92 E0\n)?;ORCA (before|layer) (\d+) ([\d.]+)$"
    body = re.sub(mark, of_layer, body, flags=re.MULTILINE)
    for theirs, orcas in _ROLES.items():
        body = body.replace(f"\n;TYPE:{theirs}\n", f"\n;TYPE:{orcas}\n")
    if printer.settings.get("gcode_flavor") == "klipper":
        body = re.sub(r"^M204 [PS](\d+)$", r"SET_VELOCITY_LIMIT ACCEL=\1", body, flags=re.MULTILINE)
    head = "; HEADER_BLOCK_START\n; generated by OrcaSlicer 2.3.1 on 2026-01-08 at 11:43:17\n"
    told = ((key, v.replace("\n", "\\n")) for key, v in printer.settings.items())
    rows = "".join(f"; {key} = {value}\n" for key, value in told)
    config = f"; CONFIG_BLOCK_START\n{rows}; CONFIG_BLOCK_END\n"
    return f"{head}; HEADER_BLOCK_END\n\n{body.partition(chr(10))[2]}\n{config}"


class Scripts:
    """A machine's scripts, filled in for a block in the middle of its bed."""

    def __init__(self, printer: OrcaPrinter, block: Box) -> None:
        told = printer.settings
        pairs = [pair.split("x") for pair in told["printable_area"].split(",")]
        low, high = (
            [pick(float(p[axis]) for p in pairs) for axis in (0, 1)] for pick in (min, max)
        )
        middle = [0.5 * (a + b) for a, b in zip(low, high, strict=True)]
        print_min = [m - 0.5 * side for m, side in zip(middle, block[:2], strict=True)]
        print_max = [m + 0.5 * side for m, side in zip(middle, block[:2], strict=True)]
        bed_c, bed_first_c = told["hot_plate_temp"], told["hot_plate_temp_initial_layer"]
        layers = round(block[2] / float(told["layer_height"]))
        self._told: dict[str, Any] = {
            **{key: _read(key, value) for key, value in told.items()},
            **dict.fromkeys(("initial_extruder", "initial_tool", "current_extruder"), 0.0),
            **dict.fromkeys(("initial_no_support_extruder", "total_toolchanges"), 0.0),
            **dict.fromkeys(("filament_extruder_id", "output_filename_format"), 0.0),
            "position": [*middle, block[2]],
            **dict.fromkeys(("has_wipe_tower", "in_head_wrap_detect_zone", "e_retracted"), 0.0),
            "first_layer_height": float(told["initial_layer_print_height"]),
            "bed_temperature": _read("", bed_c),
            "first_layer_bed_temperature": _read("", bed_first_c),
            "bed_temperature_initial_layer": _read("", bed_first_c),
            "bed_temperature_initial_layer_single": _read("", bed_first_c),
            "temperature": _read("", told["nozzle_temperature"]),
            "first_layer_temperature": _read("", told["nozzle_temperature_initial_layer"]),
            "retract_length": _read("", told["retraction_length"]),
            "overall_chamber_temperature": float(told["chamber_temperature"].split(",")[0] or 0),
            "max_print_height": float(told["printable_height"]),
            "first_layer_print_min": print_min,
            "first_layer_print_max": print_max,
            "first_layer_print_size": [*block[:2]],
            "first_layer_center_no_wipe_tower": middle,
            "print_bed_size": [b - a for a, b in zip(low, high, strict=True)],
            "print_bed_min": low,
            "print_bed_max": high,
            "adaptive_bed_mesh_min": print_min,
            "adaptive_bed_mesh_max": print_max,
            "bed_mesh_probe_count": [4.0, 4.0],
            "bed_mesh_algo": "bicubic",
            "is_extruder_used": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            "num_extruders": float(len(told["nozzle_diameter"].split(","))),
            "total_layer_count": float(layers),
            "extruded_weight_total": 0.7,
            "outer_wall_volumetric_speed": 8.0,
            "layer_num": float(layers - 1),
            "layer_z": block[2],
            "max_layer_z": block[2],
            "plate_name": "",
            "input_filename_base": "block",
            **dict.fromkeys(("year", "month", "day", "hour", "minute", "second"), 1.0),
            "zhop": 0.2,
            "print_preset": "Somebody's",
            "printer_preset": printer.name,
        }

    def filled(self, *keys: str, **more: float) -> str:
        """Some scripts, one below the other, with all that they name put in."""
        told = {**self._told, **more}
        texts = (str(told.get(key, "")).replace("\\n", "\n") for key in keys)
        return "\n".join(_fill(text, told) for text in texts if text)


def _read(key: str, value: str) -> Any:
    """A setting as numbers, where it is that; several stay several."""
    if "gcode" in key:
        return value
    parts = [part.strip().strip('"') for part in value.split(",")]
    try:
        numbers = [float(part.removesuffix("%")) for part in parts]
    except ValueError:
        return parts if len(parts) > 1 else parts[0]
    return numbers if len(numbers) > 1 else numbers[0]


# ------------------------------------------------------------------ the macro language

_TOKEN = re.compile(
    r"\s*(?:(?P<number>\d+\.?\d*|\.\d+)|(?P<text>\"(?:[^\"\\]|\\.)*\")|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<sign>&&|\|\||==|!=|<>|<=|>=|=~|!~|[-+*/%<>!?:(),\[\]])|(?P<pattern>\x00))"
)
_FUNCTIONS = {
    "min": min,
    "max": max,
    "int": lambda v: float(math.trunc(v)),
    "round": lambda v: float(round(v)),
    "digits": lambda v, wide, dots=0.0: f"{v:{int(wide)}.{int(dots)}f}",
    "random": lambda low, high: 0.5 * (low + high),
    "is_nil": lambda v: 0.0,
    "interpolate_table": lambda v, *rows: _between(v, [*map(tuple, rows)]),
}


def _between(value: float, rows: list[tuple[float, float]]) -> float:
    return float(np.interp(value, *zip(*rows, strict=True)))


_BINARY = {
    "+": lambda a, b: f"{_shown(a)}{_shown(b)}" if isinstance(a, str) or isinstance(b, str)
    else a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "%": math.fmod,
    "==": lambda a, b: float(a == b),
    "!=": lambda a, b: float(a != b),
    "<>": lambda a, b: float(a != b),
    "<": lambda a, b: float(a < b),
    ">": lambda a, b: float(a > b),
    "<=": lambda a, b: float(a <= b),
    ">=": lambda a, b: float(a >= b),
    "&&": lambda a, b: float(bool(a) and bool(b)),
    "and": lambda a, b: float(bool(a) and bool(b)),
    "||": lambda a, b: float(bool(a) or bool(b)),
    "or": lambda a, b: float(bool(a) or bool(b)),
    "=~": lambda a, b: float(re.fullmatch(b, a) is not None),
    "!~": lambda a, b: float(re.fullmatch(b, a) is None),
}  # fmt: skip
_LEVELS = (
    {"||", "or"},
    {"&&", "and"},
    {"==", "!=", "<>", "=~", "!~"},
    {"<", ">", "<=", ">="},
    {"+", "-"},
    {"*", "/", "%"},
)


def _shown(value: Any) -> str:
    if isinstance(value, list):
        value = value[0]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class _Expression:
    """A recursive descent over one expression's tokens."""

    def __init__(self, text: str, told: Mapping[str, Any]) -> None:
        patterns = re.findall(r"(?<=~)\s*/((?:[^/\\]|\\.)*)/", text)
        bare = re.sub(r"(?<=~)\s*/(?:[^/\\]|\\.)*/", "\0", text)
        self._tokens, at = [], 0
        while bare[at:].strip():
            match = _TOKEN.match(bare, at)
            if match is None:
                raise InputError(f"{text!r} is beyond what is evaluated here.")
            kind = str(match.lastgroup)
            word = patterns.pop(0) if kind == "pattern" else match[kind]
            self._tokens.append((kind, word))
            at = match.end()
        self._at, self._told, self._text = 0, told, text

    def value(self) -> Any:
        found = self._choice()
        if self._at < len(self._tokens):
            raise InputError(f"{self._text!r} is beyond what is evaluated here.")
        return found

    def _next(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else ""

    def _take(self) -> tuple[str, str]:
        if self._at >= len(self._tokens):
            raise InputError(f"{self._text!r} ends too early.")
        self._at += 1
        return self._tokens[self._at - 1]

    def _choice(self) -> Any:
        found = self._binary(0)
        if self._next() != "?":
            return found
        self._take()
        yes = self._choice()
        self._take()
        no = self._choice()
        return yes if found else no

    def _binary(self, level: int) -> Any:
        if level == len(_LEVELS):
            return self._unary()
        found = self._binary(level + 1)
        while self._next() in _LEVELS[level] and self._tokens[self._at][0] != "text":
            sign = self._take()[1]
            found = _BINARY[sign](_one(found), _one(self._binary(level + 1)))
        return found

    def _unary(self) -> Any:
        kind, word = self._take()
        if kind == "number":
            return float(word)
        if kind in {"text", "pattern"}:
            return word.strip('"') if kind == "text" else word
        if word in {"!", "not"}:
            return float(not _one(self._unary()))
        if word in {"-", "+"}:
            return -_one(self._unary()) if word == "-" else _one(self._unary())
        if word == "(":
            several = [self._choice()]
            while self._take()[1] == ",":
                several.append(_one(self._choice()))
            return several if len(several) > 1 else several[0]
        if word in {"true", "false"}:
            return float(word == "true")
        if word in _FUNCTIONS and self._next() == "(":
            return self._called(word)
        return self._named(word)

    def _called(self, name: str) -> Any:
        given, sign = [], self._take()[1]
        while sign != ")":
            given.append(self._choice())
            sign = self._take()[1]
        table = name == "interpolate_table"
        return _FUNCTIONS[name](*(one if table else _one(one) for one in given))

    def _named(self, name: str) -> Any:
        if name not in self._told:
            raise InputError(f"nobody tells {name!r}.")
        found = self._told[name]
        if self._next() != "[":
            return found
        self._take()
        which = self._choice()
        self._take()
        several = found if isinstance(found, list) else [found]
        return several[int(which)] if which < len(several) else several[0]


def _one(value: Any) -> Any:
    return value[0] if isinstance(value, list) else value


_MACRO = re.compile(r"\{((?:\"[^\"]*\"|[^{}\"])*)\}|\[(\w+(?:\[\w+\])?)\]")
_ASSIGNS = re.compile(r"\s*\w+(?:\[[^\]]*\])?\s*=[^=~].*", re.DOTALL)  # what the slicer keeps
_WORD = re.compile(r"\s*(if|elsif|else|endif)\b(.*)", re.DOTALL)


def _fill(text: str, told: Mapping[str, Any]) -> str:
    made: list[str] = []
    # Of each open `if`: whether its present branch is taken, and whether one was.
    open_ifs: list[tuple[bool, bool]] = []
    at = 0

    def taken() -> bool:
        return all(now for now, _ in open_ifs)

    for match in _MACRO.finditer(text):
        made += [text[at : match.start()]] if taken() else []
        at = match.end()
        inner = match[1] if match[1] is not None else match[2]
        word = _WORD.fullmatch(inner) if match[1] is not None else None
        if word is not None and word[1] == "if":
            yes = taken() and bool(_one(_Expression(word[2], told).value()))
            open_ifs.append((yes, yes))
        elif word is not None and word[1] == "endif":
            open_ifs.pop()
        elif word is not None:
            _, was = open_ifs.pop()
            asked = taken() and not was
            yes = asked and (word[1] == "else" or bool(_one(_Expression(word[2], told).value())))
            open_ifs.append((yes, was or yes))
        elif taken() and inner.strip() and not _ASSIGNS.fullmatch(inner):
            made.append(_shown(_legacy(inner, told) if match[1] is None
                               else _Expression(inner, told).value()))  # fmt: skip
    return "".join([*made, text[at:]])


def _legacy(name: str, told: Mapping[str, Any]) -> Any:
    """`[name]`, or `[name_0]` for the first of several."""
    several = re.fullmatch(r"(\w+)_(\d)", name)
    if name.partition("[")[0] not in told and several is not None:
        name = f"{several[1]}[{several[2]}]"
    return _Expression(name, told).value()
