"""Simulate: a world that beads are laid in, that breaks as asked, and that a scanner can look at.
"""
