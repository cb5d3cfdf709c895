"""gcode turns a solid into bytes on a wire: slice, check, estimate, send, emulate.

It knows nothing of scans, templates or learning; `amrepair` stands on it, never the reverse.
"""

__version__ = "0.1.0"
