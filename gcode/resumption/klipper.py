"""The macro by which Klipper feels no deeper than it is told (`klipper_touch.cfg`)."""

from __future__ import annotations

from importlib.resources import files

TOUCH_MACRO = files("gcode.resumption").joinpath("klipper_touch.cfg").read_text(encoding="utf-8")
