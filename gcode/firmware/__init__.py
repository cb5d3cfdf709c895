"""Firmware: a byte-level emulated printer on a pseudo-terminal.

It stands in for a real machine, faults included. What it extrudes is reported as motion; what
becomes of the plastic is not its business.
"""

from gcode.firmware.core import FirmwareCore
from gcode.firmware.faults import parse_faults
from gcode.firmware.motion import MotionBatch
from gcode.firmware.process import EmulatedPrinterProcess
from gcode.firmware.serve import serve_forever

__all__ = ["EmulatedPrinterProcess", "FirmwareCore", "MotionBatch", "parse_faults", "serve_forever"]
