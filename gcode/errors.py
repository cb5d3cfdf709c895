"""The error tree of `gcode`: every failure a caller may want to tell apart, and nothing else.

A message is one sentence that says what happened, the value, the limit and what to try.
Data rides as attributes. The command line turns a class into an exit code by `exit_code`.
"""

from __future__ import annotations


class GcodeError(Exception):
    """Root of every error that `gcode` raises on purpose.

    Examples
    --------
    >>> import gcode
    >>> try:
    ...     gcode.load_setup("prusa_mk3s", "chocolate")
    ... except gcode.GcodeError as error:
    ...     print(error)
    Unknown material profile 'chocolate'; known are: abs, asa, petg, pla, pla_cf, tpu.
    """

    exit_code: int = 2


class InputError(GcodeError):
    """A file, mesh or option that cannot be used."""


class ProfileError(GcodeError):
    """A profile that is unknown, malformed or out of range."""


class ReadError(GcodeError):
    """G-code text that cannot be understood."""


class SliceError(GcodeError):
    """A solid that cannot be turned into beads."""


class WorkerError(GcodeError):
    """A process that shared a command's work ended before it was done."""


class CheckRefusedError(GcodeError):
    """A program that the checker refuses.

    Attributes
    ----------
    refusals
        The refusals, in program order; each names line, move, value and limit.
    """

    def __init__(self, message: str, refusals: tuple[object, ...] = ()) -> None:
        super().__init__(message)
        self.refusals = refusals


class LocalProtocolError(GcodeError):
    """We asked the protocol machine for something its state does not allow."""


class LinkError(GcodeError):
    """The printer or the link to it failed."""

    exit_code = 4


class PrinterError(LinkError):
    """The printer reported a fault of its own (thermal runaway, kill, halt)."""


class PortBusyError(LinkError):
    """Another sender holds this printer."""


class JournalError(LinkError):
    """The journal of a job cannot be read, or contradicts the printer."""


class JournalFileError(JournalError):
    """What was named is no journal, or cannot be made one: bad input, no fault of the link."""

    exit_code = InputError.exit_code
