"""amrepair turns scans into a solid that is missing; `gcode` turns that solid into G-code."""

__version__ = "0.1.0"
