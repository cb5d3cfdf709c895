"""The states of the link and every legal transition between them, as one table.

Rules
-----
* A signal that a state does not list is illegal there: a defect of ours (`LocalProtocolError`),
  never a reaction to what the printer sends. What the printer sends is turned into signals by
  `link`, which only emits those listed.
* `LOST` and `HALTED` are left by `HELLO` alone: after a reset, a halt or a contradiction nothing
  is sent again on its own; numbering starts afresh and the job must be resumed by proof.
* `REWINDING` holds the line until the answers already under way have arrived; only then is
  anything sent again (no endless off-by-one, OctoPrint#470).
* `ASKING` has sent a line that must bounce, with nothing under way: its refusal tells which line
  the printer took last. It is asked again until an answer makes sense.
* `PROBING` has sent the last line a second time. With a firmware that verifies numbers that is
  idempotent; for Klipper it has sent a question instead; for all others `SILENCE` leads to `LOST`.
"""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """Where the link stands."""

    UNGREETED = "ungreeted"
    GREETING = "greeting"
    IDLE = "idle"
    WAITING = "waiting"
    REWINDING = "rewinding"
    ASKING = "asking"
    PROBING = "probing"
    HALTED = "halted"
    LOST = "lost"


class Signal(StrEnum):
    """What can happen to the link."""

    HELLO = "hello"
    GREETED = "greeted"
    SENT = "sent"
    ACKED = "acked, more under way"
    DRAINED = "acked, nothing under way"
    RESEND = "resend"
    REWOUND = "rewound"
    SILENCE = "silence, the last line sent again"
    ASK = "asked which line it is at"
    GIVE_UP = "give up"
    HALT = "halt"
    RESET = "reset"


_END: dict[Signal, State] = {
    Signal.GIVE_UP: State.LOST,
    Signal.RESET: State.LOST,
    Signal.HALT: State.HALTED,
    Signal.HELLO: State.GREETING,
}

TRANSITIONS: dict[State, dict[Signal, State]] = {
    State.UNGREETED: {
        Signal.HELLO: State.GREETING,
        Signal.HALT: State.HALTED,
    },
    State.GREETING: {
        **_END,
        Signal.RESET: State.GREETING,  # opening the port resets many boards: greet again
        Signal.GREETED: State.IDLE,
    },
    State.IDLE: {
        **_END,
        Signal.SENT: State.WAITING,
        Signal.RESEND: State.REWINDING,  # an earlier ok was no ok
        Signal.ASK: State.ASKING,
    },
    State.WAITING: {
        **_END,
        Signal.SENT: State.WAITING,
        Signal.ACKED: State.WAITING,
        Signal.DRAINED: State.IDLE,
        Signal.RESEND: State.REWINDING,
        Signal.SILENCE: State.PROBING,
    },
    State.REWINDING: {
        **_END,
        Signal.RESEND: State.REWINDING,
        Signal.REWOUND: State.WAITING,
        Signal.DRAINED: State.IDLE,
    },
    State.ASKING: {
        **_END,
        Signal.ASK: State.ASKING,
        Signal.RESEND: State.REWINDING,
    },
    State.PROBING: {
        **_END,
        Signal.ACKED: State.WAITING,
        Signal.DRAINED: State.IDLE,
        Signal.RESEND: State.REWINDING,
        Signal.SILENCE: State.PROBING,
    },
    State.HALTED: {
        Signal.HELLO: State.GREETING,
        Signal.HALT: State.HALTED,
        Signal.RESET: State.LOST,
    },
    State.LOST: {
        Signal.HELLO: State.GREETING,
        Signal.HALT: State.HALTED,
        Signal.RESET: State.LOST,
        Signal.GIVE_UP: State.LOST,
    },
}
