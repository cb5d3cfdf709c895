"""The error tree of `amrepair`; the command line turns a class into an exit code.

A message is one sentence: what happened, the value, the limit and what to try.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import gcode.errors


class AmrepairError(Exception):
    """Root of every error that `amrepair` raises on purpose.

    Examples
    --------
    >>> from pathlib import Path
    >>> from amrepair import AmrepairError, read_scan
    >>> try:
    ...     read_scan(Path("nothing.ply"), frame="build")
    ... except AmrepairError as error:
    ...     print(error, "→ exit code", error.exit_code)
    nothing.ply: there is no such file → exit code 2
    """

    exit_code: int = 2


class InputError(AmrepairError):
    """A scan, mesh, template or option that cannot be used."""


class TemplateError(InputError):
    """A template that cannot be fitted, read or extracted."""


class AlignmentError(AmrepairError):
    """An alignment that does not converge, or that leaves the pose ambiguous."""


class PartMovedError(AlignmentError):
    """A scan that fits its template, but away from where it should be: farther than allowed."""


class DeficitError(AmrepairError):
    """A deficit that cannot be made into a valid solid."""


class ScannerError(AmrepairError):
    """The scanner was silent or its data cannot be trusted."""

    exit_code = 4


class LoopError(AmrepairError):
    """The loop stopped before the job was done."""

    exit_code = 4


class MissingDependencyError(AmrepairError):
    """A library that this command needs cannot be loaded."""


@contextmanager
def refused_as_ours() -> Iterator[None]:
    """What `gcode`'s readers refuse within this is an `InputError` of ours: converted here alone.

    Raises
    ------
    InputError
        In place of `gcode.errors.InputError`, with its sentence.
    """
    try:
        yield
    except gcode.errors.InputError as error:
        raise InputError(str(error).removesuffix(".")) from error
