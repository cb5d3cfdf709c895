"""Firmware: a byte-level emulated printer on a pseudo-terminal.

It stands in for a real machine, faults included. What it extrudes is reported as motion; what
becomes of the plastic is not its business.
"""
