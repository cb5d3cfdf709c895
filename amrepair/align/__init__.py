"""Align: where a scan lies in the template. Returns a `Registration` or raises, never guesses."""

from amrepair.align.align import SoFar, align
from amrepair.align.options import AlignOptions, PamOptions
from amrepair.align.registration import Registration

__all__ = ["AlignOptions", "PamOptions", "Registration", "SoFar", "align"]
