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
        EnvelopeSlice,
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
    "EnvelopeSlice",
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
    "gcode.profiles.schema": (
        "AxisLimits, EnvelopeSlice, PrinterProfile, ProbeProfile, ProcessProfile"
    ),
    "gcode.profiles.setup": "PrintSetup, expand_script, load_setup",
    "gcode.profiles.store": "kind_of, load_material, load_printer, load_process",
}

__getattr__, __dir__ = lazy_names(globals(), _HOMES)
