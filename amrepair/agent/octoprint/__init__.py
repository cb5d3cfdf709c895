"""OctoPrint's plugin: holds a job at its looks, and prints there what `amrepair agent` hands over.

It runs in OctoPrint's own Python and imports nothing that is not there already; looking, planning
and checking are the agent's.
"""

from __future__ import annotations

__plugin_name__ = "amrepair"
__plugin_pythoncompat__ = ">=3.11,<4"


def __plugin_load__() -> None:  # noqa: N807 - OctoPrint's name
    """Called by OctoPrint alone: only there its modules exist."""
    from amrepair.agent.octoprint import plugin

    made = plugin.AmrepairPlugin()
    globals().update(__plugin_implementation__=made, __plugin_hooks__=made.hooks())
