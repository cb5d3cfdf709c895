"""Align: where a scan lies in the template. Returns a `Registration` or raises, never guesses."""
