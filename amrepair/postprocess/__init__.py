"""Marks in a slicer's job where looks belong, as a script that the slicer runs after slicing.

It reads the job and adds lines; every line that was there stays as it is, byte for byte. It looks
at nothing and repairs nothing: that is for whoever is told by the marks (`loop`, a host's macro).
"""

from amrepair.postprocess.mark import LooksAsked, Marked, mark
from amrepair.postprocess.words import TARGETS, target_of

__all__ = ["TARGETS", "LooksAsked", "Marked", "mark", "target_of"]
