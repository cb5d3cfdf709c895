"""Hosts: the `Printer` port and the adapters behind it.

A host carries a checked program to a machine and says truthfully what arrived. It does not
make, judge or alter G-code.
"""

from gcode.hosts.connect import connect
from gcode.hosts.port import (
    Capabilities,
    LinkLostError,
    PrintableProgram,
    Printer,
    PrintReport,
    ResumeRefusedError,
    Temperatures,
)

__all__ = [
    "Capabilities",
    "LinkLostError",
    "PrintReport",
    "PrintableProgram",
    "Printer",
    "ResumeRefusedError",
    "Temperatures",
    "connect",
]
