"""How long the link waits for what, and how often it tries."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinkTiming:
    """How long the link waits, s.

    Attributes
    ----------
    silence_s
        An ordinary line unanswered for this long: send it again (OctoPrint waits 30 s and
        then forces the *next* line, which loses one; a probe loses nothing).
    slow_silence_s
        The same for commands that take long.
    resend_grace_s
        How long after a resend request an `ok` may still belong to it.
    doubt_s
        Silence after something suspicious (a garbled reply, an ignored resend).
    give_up_s
        Unanswered probes for this long: the link is lost.
    slow_give_up_s
        The same while a slow command is under way.
    """

    silence_s: float = 8.0
    slow_silence_s: float = 60.0
    resend_grace_s: float = 0.1
    doubt_s: float = 0.4
    give_up_s: float = 60.0
    slow_give_up_s: float = 1800.0
    max_resends: int = 10
    max_refused: int = 3
