"""Hosts: the `Printer` port and the adapters behind it.

A host carries a checked program to a machine and says truthfully what arrived. It does not
make, judge or alter G-code.
"""

from gcode.hosts.connect import connect
from gcode.hosts.port import LinkLostError, Printer, PrintReport, ResumeRefusedError

__all__ = ["LinkLostError", "PrintReport", "Printer", "ResumeRefusedError", "connect"]
