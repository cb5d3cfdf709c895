"""gcode turns a solid into bytes on a wire: slice, check, estimate, send, emulate.

It knows nothing of scans, templates or learning; `amrepair` stands on it, never the reverse.

From a mesh to a program that a printer may have:

>>> from pathlib import Path
>>> import gcode
>>> setup = gcode.load_setup("prusa_mk3s", "pla", "standard_0.20")
>>> toolpath = gcode.slice_part(gcode.read_solid(Path("placed.stl")), setup)
>>> checked = gcode.check_program(gcode.write_program(toolpath, setup, title="block"), setup)
>>> printer = gcode.connect("file:block.gcode")  # or /dev/ttyACM0
>>> printer.connect()
>>> printer.print(checked).ok
True
>>> printer.close()

The names below are loaded when first used, so that importing this package costs nothing.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from gcode.lazy import lazy_names

if TYPE_CHECKING:
    from gcode.check import CheckedProgram
    from gcode.check import check as check_program
    from gcode.errors import GcodeError
    from gcode.estimate import estimate as estimate_program
    from gcode.hosts import connect
    from gcode.moves import Program
    from gcode.profiles import load_setup
    from gcode.reader import read_job
    from gcode.slicing.job import slice_part
    from gcode.slicing.patch import slice_patch
    from gcode.solids import read_solid
    from gcode.surfaces import HeightField
    from gcode.writer import write as write_program

__version__ = "0.1.0"

# numba says so once where the system's TBB is old, and takes another way: nothing for a user to do.
warnings.filterwarnings("ignore", message=".*The TBB threading layer")

__all__ = [
    "CheckedProgram",
    "GcodeError",
    "HeightField",
    "Program",
    "check_program",
    "connect",
    "estimate_program",
    "load_setup",
    "read_job",
    "read_solid",
    "slice_part",
    "slice_patch",
    "write_program",
]

# `check` and `estimate` are rooms of this package: their functions go by a longer name up here.
_HOMES = {
    "gcode.check": "CheckedProgram, check as check_program",
    "gcode.errors": "GcodeError",
    "gcode.estimate": "estimate as estimate_program",
    "gcode.hosts": "connect",
    "gcode.moves": "Program",
    "gcode.profiles": "load_setup",
    "gcode.reader": "read_job",
    "gcode.slicing.job": "slice_part",
    "gcode.slicing.patch": "slice_patch",
    "gcode.solids": "read_solid",
    "gcode.surfaces": "HeightField",
    "gcode.writer": "write as write_program",
}

__getattr__, __dir__ = lazy_names(globals(), _HOMES)
