"""Simulate: a world that beads are laid in, that breaks as asked, that a scanner looks at."""
