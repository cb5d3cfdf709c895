"""Other programs' profiles, read only: PrusaSlicer `.ini`, OrcaSlicer JSON, Klipper `printer.cfg`,
and the settings that slicers write into their jobs.

What the source does not know (the tool head's envelope, where to park and prime) is inherited from
a shipped profile and said; every key of the source is mapped or listed with the reason. Nothing is
written here but what the schema accepts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from gcode.errors import InputError, ProfileError
from gcode.profiles.importers.jobs import JOB_SUFFIXES, read_settings
from gcode.profiles.importers.klipper import KLIPPER_RULES, bed_note, finish, read_klipper
from gcode.profiles.importers.macros import (
    ends_homing,
    head_used,
    heads_of,
    macros_named,
    of_head,
)
from gcode.profiles.importers.rules import Imported, LeftOut, Rule, Source, apply
from gcode.profiles.importers.slicers import ORCA, PRUSA, read_orca, read_prusa
from gcode.profiles.machines import machine_named
from gcode.profiles.names import Kind, list_profiles
from gcode.profiles.own_limits import own_fault
from gcode.profiles.round_beds import kept_on
from gcode.profiles.schema import PrinterProfile
from gcode.profiles.store import MODELS, content_of

__all__ = ["ImportedFile", "import_job", "import_profiles", "to_toml", "write_profiles"]

_GENERIC = {
    "marlin": "generic_marlin",
    "klipper": "generic_klipper",
    "reprap": "generic_reprap",
    "prusa": "prusa_mk3s",
}
_GENERIC_IDS = frozenset(v for v in _GENERIC.values() if v.startswith("generic"))
ASK_FOR = (
    "bed_size_mm",
    "max_z_mm",
    "max_hotend_c",
    "max_bed_c",
    "envelope",
    "park_mm",
    "prime_mm",
    "start_gcode",
    "end_gcode",
)
"""Keys of a printer that are another machine's until somebody measures or writes them."""
# How far off the bed that a slicer knows its printers' own scripts go to purge, wipe and park:
# 20 mm at most, of 118 presets of PrusaSlicer's and 329 of OrcaSlicer's (Bambu Lab's left out).
OFF_BED_MM = 20.0
# All-metal hotends are sold up to 300 °C, beds up to 120 °C (E3D's V6, Prusa's and Voron's). The
# fastest of them melt 75 mm³/s (Vez3D's Goliath, its maker's figure).
MOST_HOTEND_C, MOST_BED_C, MOST_MELTED_MM3_S = 300.0, 120.0, 75.0
BED_EDGE_MM = 5.0
"""How far from the bed's edge an inherited place is kept."""


@dataclass(frozen=True, slots=True)
class ImportedFile:
    """What was imported from one file.

    Attributes
    ----------
    left
        Keys without a place here, with reasons.
    notes
        What to look at before printing.
    """

    source: str
    profiles: tuple[Imported, ...]
    left: tuple[LeftOut, ...]
    notes: tuple[str, ...]


def import_profiles(
    path: Path,
    *,
    preset: str | None = None,
    inherits: str | None = None,
    text: str | None = None,
) -> ImportedFile:
    """Read another program's profile.

    Parameters
    ----------
    text
        The file's, where it is known: a binary job's (`gcode.reader.binary`).
    preset
        Which preset of a PrusaSlicer bundle, as `print:NAME`.
    inherits
        Shipped profile to take from what the source does not know; chosen by dialect, model or
        filament where left out.

    Raises
    ------
    InputError
        If the file cannot be read or is none of the three kinds.
    ProfileError
        If a value is outside what our profiles allow.
    """
    if text is None:
        try:
            kind = "replace" if path.suffix.lower() in JOB_SUFFIXES else "strict"
            text = path.read_text(encoding="utf-8-sig", errors=kind)
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path} cannot be read as text ({error}).") from error
    if path.suffix.lower() in JOB_SUFFIXES:
        found = import_job(str(path), text, inherits=inherits)
        if found is None:
            raise InputError(
                f"{path}: no slicer has written its settings into this job; PrusaSlicer, "
                "OrcaSlicer, Bambu Studio, Creality Print and Cura do."
            )
        return found
    rules, source = _read(path, text, preset)
    if inherits is not None and len(source.kinds) > 1:
        raise InputError(
            f"{path} holds {', '.join(source.kinds)}; --inherits can only be given for one."
        )
    parents = {kind: inherits or _parent(kind, source, rules) for kind in source.kinds}
    made, left = apply(source, rules, parents)
    notes: list[str] = []
    if rules is KLIPPER_RULES:
        left = finish(made[0], left, source)
        notes += filter(None, [bed_note(made[0])])
    for profile in made:
        notes += _settle(profile)
        _add_named(profile, source)
        _validate(path, profile)
    return ImportedFile(str(path), made, left, tuple(notes))


def import_job(
    name: str, text: str, *, inherits: str | None = None, head: int | None = None
) -> ImportedFile | None:
    """The settings that a slicer wrote into a job, as profiles; None where it wrote none.

    A setting that our profiles do not allow is left, with the reason, and inherited: whoever has
    only the job cannot correct it.

    Parameters
    ----------
    inherits
        The printer profile to take from what the job does not know; that of its model where left
        out, or a generic one.
    head
        Whose settings are taken of several heads, or filaments; of those with which the most is
        printed where left out.

    Raises
    ------
    InputError
        If the settings are cut.
    """
    settings = read_settings(Path(name).name, text)
    if settings is None:
        return None
    rules, source = settings
    head = head_used(text) if head is None else head
    of_filament = {key for key, rule in rules.items() if rule.kind == "materials"}
    of_filament |= {key for key, kind in source.name_keys.items() if kind == "materials"}
    values = of_head(source.values, head, of_filament | {"filament_type"})
    every, source = source, replace(source, values=values)
    parents = {kind: _parent(kind, source, rules) for kind in source.kinds}
    parents["printers"] = inherits or parents["printers"]
    made, left = apply(source, rules, parents)
    notes, more = [], list(left)
    for profile in made:
        notes += _settle(profile)
        _add_named(profile, every)
        if profile.values.get("heads", 1) > 1:
            profile.values["tool"] = min(head, profile.values["heads"] - 1)
        more += _within_range(profile)
    _as_able_as_told(*made[:2])
    return ImportedFile(name, made, tuple(more), tuple(notes))


def _read(path: Path, text: str, preset: str | None) -> tuple[dict[str, Rule], Source]:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return ORCA, read_orca(path, text)
    if suffix == ".cfg":
        return KLIPPER_RULES, read_klipper(path, text)
    if suffix == ".ini":
        return PRUSA, read_prusa(path, text, preset)
    raise InputError(
        f"{path}: its ending is {suffix or 'missing'}; give a PrusaSlicer .ini, an OrcaSlicer "
        f".json, a Klipper printer.cfg or a slicer's job (.gcode)."
    )


def _parent(kind: Kind, source: Source, rules: dict[str, Rule]) -> str:
    if kind == "processes":
        return "standard_0.20"
    if kind == "materials":
        named = source.values.get("filament_type", "").split(",")[0].split(";")[0].strip().lower()
        return named if named in list_profiles("materials") else "pla"
    if rules is KLIPPER_RULES:
        return _GENERIC["klipper"]
    known = machine_named(
        source.values.get("printer_model", ""),
        source.values.get("printer_settings_id", ""),
        source.values.get("TARGET_MACHINE.NAME", ""),
        source.values.get("definition", ""),
        source.name,
    )
    if known is not None:
        return known
    flavour = source.values.get("gcode_flavor", source.values.get("FLAVOR", "marlin")).lower()
    # Slicers' "reprap" is the default that nobody changed; it does not mean RepRapFirmware.
    dialect = {"reprapfirmware": "reprap", "reprap": "marlin"}.get(flavour, flavour)
    return _GENERIC.get(dialect, _GENERIC["marlin"])


def _settle(made: Imported) -> list[str]:
    """Complete tables, keep inherited places on the bed; say what is not the machine's own."""
    above = content_of(made.kind, made.inherits)
    for key, value in made.values.items():
        if isinstance(value, dict) and isinstance(above.get(key), dict):
            made.values[key] = {**above[key], **value}
    if made.kind != "printers":
        return []
    if made.inherits not in _GENERIC_IDS and made.values.get("dialect") == "marlin":
        # Slicers call Prusa's firmware Marlin; older ones, and Cura, call Klipper so, too.
        made.values["dialect"] = above["dialect"]
    merged = {"bed_min_mm": (0.0, 0.0), "delta": False, **above, **made.values}
    if not ({"reach_min_mm", "reach_max_mm"} & merged.keys()):
        made.values["off_bed_mm"] = OFF_BED_MM
    notes = []
    for key in ("park_mm", "prime_mm"):
        kept = _on_the_bed(merged[key], merged) if key not in made.values else list(merged[key])
        if kept != list(merged[key]):
            made.values[key] = kept
            notes.append(f"{key} of {made.inherits} was moved onto this bed: {kept}")
    foreign = [key for key in ASK_FOR if key not in made.values]
    notes.append(
        f"{', '.join(foreign)}: taken from {made.inherits}; measure the tool head and correct them "
        f"before printing on a part"
    )
    return notes


def _add_named(made: Imported, source: Source) -> None:
    """What a preset's scripts name is the machine's: its heads, and its macros."""
    if made.kind != "printers":
        return
    if ends_homing(source.values):
        made.values["ends_homing"] = True
    heads, one_nozzle = heads_of(source.values)
    if heads > 1:
        made.values |= {"heads": heads, "one_nozzle": one_nozzle}
    content = {**content_of(made.kind, made.inherits), **made.values}
    named = macros_named(source.values, content["dialect"])
    known = {macro.split(maxsplit=1)[0].upper() for macro in content.get("macros", ())}
    if set(named) - known:
        made.values["macros"] = [*content.get("macros", ()), *sorted(set(named) - known)]


def _as_able_as_told(printer: Imported, material: Imported) -> None:
    """A limit that is nobody's measurement yields to what the job's own filament is printed at.

    A slicer's limit of a filament's flow is what hotend and filament melt together.
    """
    if printer.inherits not in _GENERIC_IDS:
        return
    above = content_of(printer.kind, printer.inherits)
    for key, asked, most in (
        ("max_hotend_c", ("hotend_c", "first_layer_hotend_c"), MOST_HOTEND_C),
        ("max_bed_c", ("bed_c",), MOST_BED_C),
        ("max_volumetric_mm3_s", ("max_volumetric_mm3_s",), MOST_MELTED_MM3_S),
    ):
        told = max(material.values.get(one, 0.0) for one in asked)
        if key not in printer.values and above[key] < told <= most:
            printer.values[key] = told


def _on_the_bed(place_mm: Sequence[float], bed: Mapping[str, Any]) -> list[float]:
    """A place that was told from the corner of another machine's bed, kept on this one."""
    corner, size = np.array(bed["bed_min_mm"]), np.array(bed["bed_size_mm"])
    at = corner + np.minimum(place_mm[:2], size - BED_EDGE_MM)
    if bed["delta"]:
        at = np.array(kept_on(at.tolist(), corner.tolist(), size.tolist(), BED_EDGE_MM))
    x_mm, y_mm = at.round(3).tolist()
    return [x_mm, y_mm, min(place_mm[2], bed["max_z_mm"])]


def _validate(path: Path, made: Imported) -> None:
    content = {**content_of(made.kind, made.inherits), **made.values, "id": "x", "name": made.name}
    try:
        MODELS[made.kind].model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        origin = next((m for m in made.mapped if key.startswith(m.key.split(".")[0])), None)
        theirs = f" (from {origin.source_key!r} = {origin.source_value!r})" if origin else ""
        raise ProfileError(
            f"{path}: key '{key}' = {first['input']!r}{theirs} is out of range: {first['msg']}; "
            f"correct it in the source."
        ) from error


def _within_range(made: Imported) -> list[LeftOut]:
    """Drop what the schema, or a printer's own limits, do not allow; it is inherited then."""
    dropped: list[LeftOut] = []
    while (fault := _fault(made)) is not None:
        key, why = fault
        if key not in made.values:
            raise ProfileError(f"{made.name}: key '{key}': {why}; report this.")
        del made.values[key]
        gone = [row for row in made.mapped if row.key.partition(".")[0] == key]
        made.mapped = [row for row in made.mapped if row not in gone]
        dropped += [LeftOut(row.source_key, row.source_value, why) for row in gone]
    return dropped


def _fault(made: Imported) -> tuple[str, str] | None:
    """The first key of a profile's own that is not allowed, and why."""
    content = {**content_of(made.kind, made.inherits), **made.values, "id": "x", "name": made.name}
    try:
        profile = MODELS[made.kind].model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        return str(first["loc"][0]), f"{first['input']!r} is out of range ({first['msg']})"
    fault = own_fault(profile) if isinstance(profile, PrinterProfile) else None
    if fault is None:
        return None
    key = next((key for key in made.values if f"'{key}'" in fault), None)
    return (key, f"it breaks the machine's limits: {fault}") if key is not None else None


def write_profiles(found: ImportedFile, folder: Path) -> dict[Kind, Path]:
    """Write an import as TOML files, one folder for each kind; where they lie."""
    paths: dict[Kind, Path] = {}
    for made in found.profiles:
        paths[made.kind] = folder / made.kind / file_name(made)
        paths[made.kind].parent.mkdir(parents=True, exist_ok=True)
        paths[made.kind].write_text(to_toml(made, found.source), encoding="utf-8")
    return paths


def file_name(made: Imported) -> str:
    """Return the file name, and so the ID, of an imported profile."""
    slug = re.sub(r"[^a-z0-9.]+", "_", made.name.lower()).strip("_.")
    return f"{slug or 'imported'}{'_own' if slug == made.inherits else ''}.toml"


def to_toml(made: Imported, source: str) -> str:
    """Return the profile as TOML, every value with the key it came from."""
    came_from: dict[str, str] = {}
    for mapped in made.mapped:
        key = mapped.key.split(".")[0]
        came_from[key] = ", ".join(filter(None, (came_from.get(key), mapped.source_key)))
    plain = [f"# Imported from {Path(source).name}.", f"inherits = {_value(made.inherits)}"]
    plain.append(f"name = {_value(made.name)}")
    came_from.pop("name", None)
    tables = []
    for key, value in made.values.items():
        origin = f" # {came_from[key]}" if key in came_from else ""
        if isinstance(value, dict):
            rows = [f"{inner} = {_value(number)}" for inner, number in value.items()]
            tables += ["", f"[{key}]{origin}", *rows]
        else:
            plain.append(f"{key} = {_value(value)}{origin}")
    return "\n".join([*plain, *tables, ""])


def _value(value: Any) -> str:
    """TOML of text, numbers and lists is JSON's, but for DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
