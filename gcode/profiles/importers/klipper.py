"""Klipper's `printer.cfg`: limits of the machine, read without carrying out anything.

Keys and meanings: Klipper's Config_Reference.md.
"""

from __future__ import annotations

import configparser
import re
from pathlib import Path

from gcode.errors import InputError
from gcode.profiles.importers.rules import (
    Imported,
    LeftOut,
    Mapped,
    NotMappedError,
    Rule,
    Source,
    number,
)

_MACRO_SECTION = "gcode_macro "
_INCLUDE = "include "
_SAVED = "#*# <"
"""Where what SAVE_CONFIG appends begins: it is no limit of the machine."""


def _size(axis: str) -> Rule:
    """The bed reaches from 0 to where the carriage can go."""

    def convert(text: str, source: Source) -> float:
        low = source.values.get(f"stepper_{axis}.position_min", "0")
        if number(low, source) > 0.0:
            raise NotMappedError(f"position_min is {low}: the bed's corner is not at the origin")
        return number(text, source)

    return Rule("printers", f"bed_size_mm.{axis}", convert)


KLIPPER_RULES: dict[str, Rule] = {
    "stepper_x.position_max": _size("x"),
    "stepper_y.position_max": _size("y"),
    "stepper_z.position_max": Rule("printers", "max_z_mm", number),
    "stepper_x.position_min": Rule("printers", "reach_min_mm.x", number),
    "stepper_y.position_min": Rule("printers", "reach_min_mm.y", number),
    "printer.max_velocity": Rule("printers", "max_speed_mm_s.xy", number),
    "printer.max_accel": Rule("printers", "max_acceleration_mm_s2.xy", number),
    "printer.square_corner_velocity": Rule("printers", "max_jerk_mm_s.xy", number),
    "printer.max_z_velocity": Rule("printers", "max_speed_mm_s.z", number),
    "printer.max_z_accel": Rule("printers", "max_acceleration_mm_s2.z", number),
    "extruder.max_extrude_only_velocity": Rule("printers", "max_speed_mm_s.e", number),
    "extruder.max_extrude_only_accel": Rule("printers", "max_acceleration_mm_s2.e", number),
    "extruder.nozzle_diameter": Rule("printers", "nozzle_diameter_mm", number),
    "extruder.filament_diameter": Rule("printers", "filament_diameter_mm", number),
    "extruder.max_temp": Rule("printers", "max_hotend_c", number),
    "extruder.min_extrude_temp": Rule("printers", "min_extrude_c", number),
    "extruder.max_extrude_cross_section": Rule("printers", "max_bead_section_mm2", number),
    "extruder.max_extrude_only_distance": Rule("printers", "max_extrude_only_mm", number),
    "heater_bed.max_temp": Rule("printers", "max_bed_c", number),
    "firmware_retraction.retract_length": Rule("printers", "retraction_mm", number),
    "firmware_retraction.retract_speed": Rule("printers", "retraction_speed_mm_s", number),
}


def read_klipper(path: Path, text: str) -> Source:
    """Read a configuration as `section.key`; macros as one key each, their code left alone.

    Files that it includes are read where they lie beside it, as Klipper reads them: in the place
    of their line, so that of a key given twice the later one holds.

    Raises
    ------
    InputError
        If it is none, or names no printer.
    """
    values: dict[str, str] = {}
    missing: dict[str, str] = {}
    _read_into(values, missing, path, text, ())
    if not any(key.startswith("printer.") for key in values):
        raise InputError(f"{path} has no [printer] section; give Klipper's main printer.cfg.")
    return Source(path.stem, ("printers",), values, missing=missing)


def _read_into(
    values: dict[str, str], missing: dict[str, str], path: Path, text: str, chain: tuple[Path, ...]
) -> None:
    """Add a file's keys to `values`, and includes that are not read, with why, to both."""
    own, _, _ = text.partition(_SAVED)
    pieces = re.split(r"^\[include[ \t]+([^\]\n]+)\][^\n]*$", own, flags=re.MULTILINE)
    for k, piece in enumerate(pieces):
        if k % 2 == 0:
            _add_sections(values, path, piece)
            continue
        where = piece.strip()
        key = f"{_INCLUDE}{where}"
        below = not Path(where).is_absolute() and ".." not in Path(where).parts
        why = "no such file lies beside it" if below else "it does not lie in this file's folder"
        for other in sorted(path.parent.glob(where)) if below else ():
            if other.resolve() in (path.resolve(), *chain):
                raise InputError(f"{path}: [include {where}] runs in a circle; remove one link.")
            try:
                inner = other.read_text(encoding="utf-8-sig")
            except (OSError, UnicodeDecodeError) as error:
                why = f"it cannot be read ({error})"
                break
            _read_into(values, missing, other, inner, (*chain, path.resolve()))
            why = ""
        if why:
            values[key], missing[key] = "", why


def _add_sections(values: dict[str, str], path: Path, text: str) -> None:
    parser = configparser.RawConfigParser(
        delimiters=(":", "="),
        comment_prefixes=("#", ";"),
        inline_comment_prefixes=("#", ";"),
        strict=False,
        empty_lines_in_values=True,
    )
    try:
        parser.read_string(text)
    except configparser.Error as error:
        what = str(error).splitlines()[0]
        raise InputError(f"{path} cannot be read as a Klipper printer.cfg ({what}).") from error
    for section in parser.sections():
        if section.startswith(_MACRO_SECTION):
            values[section] = ""
            continue
        for key, value in parser[section].items():
            values[f"{section}.{key}"] = value


def bed_note(made: Imported) -> str | None:
    """Say that Klipper knows how far the axes go, not how large the plate is."""
    if "bed_size_mm" not in made.values:
        return None
    x_mm, y_mm = made.values["bed_size_mm"]
    return (
        f"bed_size_mm is how far the axes go, {x_mm:g} x {y_mm:g} mm, which printer.cfg knows; "
        f"where the plate is smaller, write its size there"
    )


def finish(made: Imported, left: tuple[LeftOut, ...], source: Source) -> tuple[LeftOut, ...]:
    """Put together what Klipper gives by axis, and what is true of every Klipper machine.

    Returns
    -------
    What is left now: half a bed is no bed.
    """
    values = made.values
    values["dialect"] = "klipper"
    for name in ("max_speed_mm_s", "max_acceleration_mm_s2", "max_jerk_mm_s"):
        table = values.get(name, {})
        if "xy" in table:
            both = table.pop("xy")
            values[name] = {"x": both, "y": both, **table}
    halves = []
    for name in ("bed_size_mm", "reach_min_mm"):
        pair = values.pop(name, {})
        if set(pair) == {"x", "y"}:
            values[name] = [pair["x"], pair["y"]]
        elif pair:
            lost = [m for m in made.mapped if m.key.startswith(name)]
            made.mapped[:] = [m for m in made.mapped if m not in lost]
            halves += [
                LeftOut(m.source_key, m.source_value, "the other axis is missing") for m in lost
            ]
    names = [key for key in source.values if key.startswith(_MACRO_SECTION)]
    if names:
        values["macros"] = sorted(
            name.removeprefix(_MACRO_SECTION).strip().upper() for name in names
        )
        for name in names:
            made.mapped.append(
                Mapped(name, "", "macros", name.removeprefix(_MACRO_SECTION).upper())
            )
    return (*(row for row in left if row.source_key not in names), *halves)
