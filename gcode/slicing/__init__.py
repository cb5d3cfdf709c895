"""Slicing: from a solid, and what already stands there, to beads.

It makes moves, not text; it judges reachability but never safety (that is `check`'s job).
"""
