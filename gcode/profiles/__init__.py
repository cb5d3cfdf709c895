"""Printer, material and process profiles: load, inherit, validate, import.

A profile is a TOML file under `profiles/` or a path of the user's. Unknown keys and values out
of range are refused naming file, key, value and range. Nothing here talks to a printer. What
validates is loaded when a profile is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gcode.lazy import lazy_names
from gcode.profiles.names import (
    DEFAULT_MATERIAL,
    DEFAULT_PRINTER,
    DEFAULT_PROCESS,
    list_profiles,
    profile_dir,
)

if TYPE_CHECKING:
    from gcode.profiles.schema import (
        AxisLimits,
        DialectName,
        EnvelopeSlice,
        MaterialProfile,
        PrinterProfile,
        ProbeProfile,
        ProcessProfile,
    )
    from gcode.profiles.setup import PrintSetup, expand_script, load_setup
    from gcode.profiles.store import kind_of, load_material, load_printer, load_process

__all__ = [
    "DEFAULT_MATERIAL",
    "DEFAULT_PRINTER",
    "DEFAULT_PROCESS",
    "AxisLimits",
    "DialectName",
    "EnvelopeSlice",
    "MaterialProfile",
    "PrintSetup",
    "PrinterProfile",
    "ProbeProfile",
    "ProcessProfile",
    "expand_script",
    "kind_of",
    "list_profiles",
    "load_material",
    "load_printer",
    "load_process",
    "load_setup",
    "profile_dir",
]

_HOMES = {
    "AxisLimits": ("gcode.profiles.schema", "AxisLimits"),
    "DialectName": ("gcode.profiles.schema", "DialectName"),
    "EnvelopeSlice": ("gcode.profiles.schema", "EnvelopeSlice"),
    "MaterialProfile": ("gcode.profiles.schema", "MaterialProfile"),
    "PrintSetup": ("gcode.profiles.setup", "PrintSetup"),
    "PrinterProfile": ("gcode.profiles.schema", "PrinterProfile"),
    "ProbeProfile": ("gcode.profiles.schema", "ProbeProfile"),
    "ProcessProfile": ("gcode.profiles.schema", "ProcessProfile"),
    "expand_script": ("gcode.profiles.setup", "expand_script"),
    "kind_of": ("gcode.profiles.store", "kind_of"),
    "load_material": ("gcode.profiles.store", "load_material"),
    "load_printer": ("gcode.profiles.store", "load_printer"),
    "load_process": ("gcode.profiles.store", "load_process"),
    "load_setup": ("gcode.profiles.setup", "load_setup"),
}

__getattr__, __dir__ = lazy_names(globals(), _HOMES)
