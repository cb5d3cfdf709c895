"""The files that come with the agent: the printer's macros, and the unit that starts it."""

from __future__ import annotations

from importlib.resources import files

MACROS, UNIT = "amrepair.cfg", "amrepair-agent.service"


def shipped(name: str) -> str:
    """The text of one of them."""
    return files("amrepair.agent").joinpath(name).read_text(encoding="utf-8")
