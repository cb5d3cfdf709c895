"""Printer, material and process profiles: load, inherit, validate, import.

A profile is a TOML file under `profiles/` or a path of the user's. Unknown keys and values out
of range are refused naming file, key, value and range. Nothing here talks to a printer.
"""

from gcode.profiles.schema import (
    AxisLimits,
    DialectName,
    EnvelopeSlice,
    MaterialProfile,
    PrinterProfile,
    ProcessProfile,
)
from gcode.profiles.setup import PrintSetup, expand_script, load_setup
from gcode.profiles.store import (
    DEFAULT_MATERIAL,
    DEFAULT_PRINTER,
    DEFAULT_PROCESS,
    list_profiles,
    load_material,
    load_printer,
    load_process,
    profile_dir,
)

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
    "ProcessProfile",
    "expand_script",
    "list_profiles",
    "load_material",
    "load_printer",
    "load_process",
    "load_setup",
    "profile_dir",
]
