"""What Moonraker's news say of Klipper and of the one print that is followed; no I/O."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from gcode.hosts.unknown import UnknownCommands
from gcode.hosts.web import part_of

MOONRAKER_ENDS = ("complete", "cancelled", "error")
STOPPED = ("shutdown", "error")
MOONRAKER_SUBSCRIPTION: dict[str, list[str] | None] = {
    "webhooks": ["state", "state_message"],
    "print_stats": ["state", "filename", "message"],
    "virtual_sdcard": ["file_position"],
}
_KLIPPY_NEWS = {
    "notify_klippy_ready": "ready",
    "notify_klippy_shutdown": "shutdown",
    "notify_klippy_disconnected": "disconnected",
}


@dataclass(slots=True)
class KlippyState:
    """State as told by subscription.

    Attributes
    ----------
    klippy
        ready, startup, shutdown, error or disconnected.
    stale
        Klipper came back: what we knew of its objects is void until asked anew.
    outcome
        How the followed print ended: one of `MOONRAKER_ENDS`.
    file_position
        Bytes of the followed file that Klipper has taken into its queue.
    unknown
        Commands that Klipper has not known since the print is followed.
    methods, called
        What macros of the printer may call, and what they have called, oldest first.
    """

    klippy: str = ""
    klippy_message: str = ""
    print_state: str = ""
    print_file: str = ""
    message: str = ""
    file: str = ""
    file_position: int = 0
    moved: bool = False
    stale: bool = False
    outcome: str = ""
    unknown: UnknownCommands = field(default_factory=UnknownCommands)
    answers: dict[int, dict[str, Any]] = field(default_factory=dict)
    methods: tuple[str, ...] = ()
    called: deque[tuple[str, dict[str, Any]]] = field(default_factory=deque)

    @property
    def stopped(self) -> bool:
        """Whether Klipper has stopped with a fault."""
        return self.klippy in STOPPED

    @property
    def ended(self) -> bool:
        """Whether the followed print is over, or Klipper with it."""
        return bool(self.outcome) or self.stopped

    @property
    def busy(self) -> bool:
        """Whether Klipper prints a file."""
        return self.print_state in {"printing", "paused"}

    def follow(self, file: str) -> None:
        """Follow the print of a file from now on."""
        self.file, self.file_position, self.outcome, self.moved = file, 0, "", False
        self.unknown = UnknownCommands()

    def take(self, message: object) -> None:
        """Take one message; what is not understood is left alone."""
        if not isinstance(message, dict):
            return
        method = message.get("method")
        if isinstance(number := message.get("id"), int):
            self.answers[number] = message
        elif isinstance(method, str) and method in self.methods:
            params = message.get("params")
            self.called.append((method, params if isinstance(params, dict) else {}))
        elif isinstance(method, str) and method in _KLIPPY_NEWS:
            self.klippy = _KLIPPY_NEWS[method]
            self.stale = True
        elif isinstance(params := message.get("params"), list) and params:
            if method == "notify_status_update" and isinstance(params[0], dict):
                self.take_status(params[0])
            elif method == "notify_gcode_response":
                self.unknown.hear(str(params[0]))

    def take_status(self, status: dict[str, Any]) -> None:
        """Take objects of Klipper, whole or what changed of them."""
        hooks, stats = part_of(status, "webhooks"), part_of(status, "print_stats")
        self.klippy = str(hooks.get("state", self.klippy))
        self.klippy_message = str(hooks.get("state_message", self.klippy_message))
        self.print_file = str(stats.get("filename", self.print_file))
        self.print_state = str(stats.get("state", self.print_state))
        self.message = str(stats.get("message", self.message))
        if not self.file or self.print_file != self.file:
            return
        if self.print_state in MOONRAKER_ENDS and not self.outcome:
            self.outcome = self.print_state
        position = part_of(status, "virtual_sdcard").get("file_position")
        if isinstance(position, int) and position > self.file_position:  # 0 again once it ended
            self.file_position, self.moved = position, True

    @property
    def printing_ours(self) -> bool:
        """Whether the followed print is under way or known to have ended."""
        return self.ended or (self.print_file == self.file and self.busy)


def cause_of(text: str) -> str:
    """What Klipper says in one line, without what it says of every shutdown."""
    return " ".join(text.partition("Once the underlying issue")[0].split()).rstrip(".")
