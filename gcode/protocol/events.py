"""What a printer can tell us: one small class per kind of event, and nothing that acts on it.

Events are plain values; `link` makes them, hosts read them. None of them performs I/O.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Greeted:
    """The printer took our hello: numbering starts afresh."""


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """Every line up to `number` is acknowledged (received, not necessarily executed)."""

    number: int


@dataclass(frozen=True, slots=True)
class SpareOk:
    """An `ok` that answers nothing of ours; `why` says how we know."""

    why: str


@dataclass(frozen=True, slots=True)
class ResendRequested:
    """The printer asks for line `number`; `served` is False where the request is a stale echo."""

    number: int
    served: bool


@dataclass(frozen=True, slots=True)
class ResendRefused:
    """The printer asks for a line that it cannot need or that we cannot have: `why`."""

    number: int
    why: str


@dataclass(frozen=True, slots=True)
class Probed:
    """Nothing was heard for too long; line `number` was sent again, which is idempotent."""

    number: int


@dataclass(frozen=True, slots=True)
class Proved:
    """The printer said, twice in one answer, that it has received every line up to `number`."""

    number: int


@dataclass(frozen=True, slots=True)
class Busy:
    """The printer works on a long command (`processing`, `paused for user`, …)."""

    reason: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """The printer says it has nothing to do (`wait`, Repetier)."""


@dataclass(frozen=True, slots=True)
class Echo:
    """An informative line: `echo:` of Marlin, `//` of Klipper, or anything else readable."""

    text: str


@dataclass(frozen=True, slots=True)
class UnknownCommand:
    """The firmware does not know a command we sent."""

    text: str


@dataclass(frozen=True, slots=True)
class LineError:
    """An `Error:` about the transmission itself. The wording is not to be trusted.

    `last` is the number of the last line that the printer says it took, where it says so.
    """

    text: str
    last: int | None = None


@dataclass(frozen=True, slots=True)
class CommandFailed:
    """The printer could not carry out a command (`Error:`, `!!`); an `ok` may follow all the same.

    `fatal` is True where the firmware says that it has stopped for good. When it was said, every
    line up to `acked` was acknowledged: what failed is none of these.
    """

    text: str
    fatal: bool
    acked: int = 0


@dataclass(frozen=True, slots=True)
class HeaterReading:
    """Current and target temperature of a heater; the target is None where not reported."""

    current_c: float
    target_c: float | None


@dataclass(frozen=True, slots=True)
class TemperatureReport:
    """Temperatures by heater name as the firmware gives it: `T`, `T0`, `B`, `C`, …

    `T` is the head that is chosen, `T0`, `T1`, … are all of several; Klipper tells those alone.
    """

    heaters: dict[str, HeaterReading]

    @property
    def heads(self) -> dict[int, HeaterReading]:
        """By number, of several; empty where the printer tells of one alone."""
        numbered = ((name[1:], heater) for name, heater in self.heaters.items() if name[0] == "T")
        return {int(number): heater for number, heater in numbered if number}

    @property
    def hotend(self) -> HeaterReading | None:
        """That of the head that is chosen, or else of the one that is told to be hottest."""
        each = self.heads.values()
        return self.heaters.get("T") or max(
            each, key=lambda heater: heater.target_c or 0.0, default=None
        )


@dataclass(frozen=True, slots=True)
class PositionReport:
    """Logical position as the firmware gives it (M114, M154), mm."""

    x_mm: float
    y_mm: float
    z_mm: float
    e_mm: float


@dataclass(frozen=True, slots=True)
class FirmwareInfo:
    """The fields of the first line of M115."""

    text: str
    name: str


@dataclass(frozen=True, slots=True)
class Capability:
    """One `Cap:` line of M115."""

    name: str
    enabled: bool


@dataclass(frozen=True, slots=True)
class HostAction:
    """An `//action:` command, its words after the colon."""

    action: str


@dataclass(frozen=True, slots=True)
class PrinterReset:
    """The printer started anew: what it was told is forgotten, its position unknown."""

    banner: str


@dataclass(frozen=True, slots=True)
class ShutDown:
    """Klipper has stopped for good; the cause it tells whoever says something next."""

    text: str


@dataclass(frozen=True, slots=True)
class LinkLost:
    """The link gave up: no line after `last_acked` is known to be executed.

    Attributes
    ----------
    last_acked, last_sent
        The uncertain interval, by line number: what lies in (last_acked, last_sent] may or
        may not have been executed.
    """

    why: str
    last_acked: int
    last_sent: int


@dataclass(frozen=True, slots=True)
class Unrecognised:
    """Bytes that are no reply of any dialect: noise, or a garbled reply."""

    raw: bytes


@dataclass(frozen=True, slots=True)
class Ok:
    """An `ok` as read from the wire; `link` turns it into `Acknowledged` or `SpareOk`."""

    number: int | None = None
    more: tuple[object, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class Resend:
    """A resend request as read from the wire."""

    number: int


Said = (
    Busy
    | Waiting
    | Echo
    | UnknownCommand
    | LineError
    | CommandFailed
    | TemperatureReport
    | PositionReport
    | FirmwareInfo
    | Capability
    | HostAction
    | PrinterReset
    | ShutDown
    | Unrecognised
)
"""What a line of the printer may mean by itself, whatever it was asked."""

Event = (
    Greeted
    | Acknowledged
    | SpareOk
    | ResendRequested
    | ResendRefused
    | Probed
    | Proved
    | LinkLost
    | Said
)
