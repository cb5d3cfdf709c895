"""API keys: from the environment or from a file that only its owner can read; nowhere else.

A key is never taken from a command line, where every process of the machine reads it, and never
given back in a message, a log or a `repr`.
"""

from __future__ import annotations

import os
import stat
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gcode.errors import InputError

VARIABLES = {"octoprint": "OCTOPRINT_API_KEY", "moonraker": "MOONRAKER_API_KEY"}
"""Environment variable of each kind of server."""


@dataclass(frozen=True, slots=True, repr=False)
class ApiKey:
    """A key that does not show itself; `value` is for the wire alone."""

    value: str

    def __repr__(self) -> str:
        return "ApiKey(…)" if self.value else "ApiKey()"

    __str__ = __repr__

    @property
    def headers(self) -> dict[str, str]:
        """The header that carries it, none without a key."""
        return {"X-Api-Key": self.value} if self.value else {}


def keys_file(environment: Mapping[str, str] = os.environ) -> Path:
    """Return where the keys are kept: `gcode/keys.toml` in the user's configuration folder."""
    folder = environment.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(folder) / "gcode" / "keys.toml"


def find_key(kind: str, spec: str, environment: Mapping[str, str] = os.environ) -> ApiKey:
    """Return the key for a port: the environment's, else the file's, else none.

    Parameters
    ----------
    kind
        octoprint or moonraker.
    spec
        The port as written on the command line; the file names keys by it.

    Raises
    ------
    InputError
        If the file can be read by others, or is not what it should be.
    """
    if value := environment.get(VARIABLES[kind], "").strip():
        return ApiKey(_plain(value, VARIABLES[kind]))
    path = keys_file(environment)
    if not path.is_file():
        return ApiKey("")
    _refuse_open(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # the cause quotes the text, and with it perhaps a key
        raise InputError(
            f'{path} cannot be read as TOML; write one line for each port: "{spec}" = "KEY".'
        ) from None
    found = table.get(spec, "")
    if not isinstance(found, str):
        raise InputError(f'{path}: the key of {spec} is not a text; write "{spec}" = "KEY".')
    return ApiKey(_plain(found.strip(), str(path)))


def key_in(path: Path) -> ApiKey:
    """The key that a file of its own holds.

    Raises
    ------
    InputError
        If there is none, or others can read it.
    """
    try:
        _refuse_open(path)
        text = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise InputError(f"{path} cannot be read for the API key ({why}).") from None
    if not text:
        raise InputError(f"{path} is empty; write the API key into it.")
    return ApiKey(_plain(text, str(path)))


def _refuse_open(path: Path) -> None:
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o077:
        raise InputError(
            f"{path} holds API keys and others may read it (mode {mode:03o}); run: chmod 600 {path}"
        )


def _plain(value: str, where: str) -> str:
    """Refuse what no header can carry, without showing it."""
    if not value.isascii() or not value.isprintable():
        raise InputError(f"The API key in {where} has characters that no key has; copy it anew.")
    return value
