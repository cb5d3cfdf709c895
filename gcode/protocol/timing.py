"""How long the link waits for what, and how often it asks again."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LinkTiming:
    """How long the link waits, s, and how often it asks again before it gives up.

    Attributes
    ----------
    silence_s
        An ordinary line unanswered for this long: send it again (OctoPrint waits 30 s and
        then forces the *next* line, which loses one; a probe loses nothing).
    slow_silence_s
        The same for commands that take long.
    busy_silence_s
        The same, of any command, on a firmware that has said that it is busy: Marlin repeats that
        every 2 s, so an answer is lost (OctoPrint's `communicationBusy`).
    resend_grace_s
        How long after a resend request an `ok` may still belong to it.
    doubt_s
        Silence after something suspicious (a garbled reply, an ignored resend).
    give_up_s
        Unanswered probes for this long: the link is lost.
    slow_give_up_s
        The same while a slow command is under way.
    max_resends
        Requests for one line in a row that are served; ten, as OctoPrint has it.
    max_refused
        Requests in a row that make no sense, each answered by asking again. As many: at one
        damaged byte in 200 one request in twenty is damaged, ten in a row are one in 10^13.
    max_refused_same
        The same senseless number in a row, which is no noise: the printer started anew without
        a word, or somebody else has counted on. Damage that hits the same digit in the same way
        three times in a row is one in 10^9.
    max_questions
        Questions in a row for the line that the printer is at. An answer of 80 bytes is damaged
        every third time, then: ten in a row are one in 10^5.
    """

    silence_s: float = 8.0
    slow_silence_s: float = 60.0
    busy_silence_s: float = 3.0
    resend_grace_s: float = 0.1
    doubt_s: float = 0.4
    give_up_s: float = 60.0
    slow_give_up_s: float = 1800.0
    max_resends: int = 10
    max_refused: int = 10
    max_refused_same: int = 3
    max_questions: int = 10
