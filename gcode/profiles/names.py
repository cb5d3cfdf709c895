"""Which profiles are shipped, and where they lie; nothing of what they say.

Apart from `store`, so that help and completion need not load what validates a profile.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

Kind = Literal["printers", "materials", "processes"]
DEFAULT_PRINTER = "prusa_mk3s"
DEFAULT_MATERIAL = "pla"
DEFAULT_PROCESS = "repair_0.20"


def profile_dir() -> Path:
    """The shipped profiles: package data when installed, the checkout's folder otherwise."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "profile_data"
    return installed if installed.is_dir() else package.parent / "profiles"


def list_profiles(kind: Kind) -> tuple[str, ...]:
    """IDs of the shipped profiles of one kind, sorted."""
    return tuple(sorted(id_of(path) for path in (profile_dir() / kind).glob("*.toml")))


def is_path(name: str) -> bool:
    """Whether a profile is named by its file, and not by its ID."""
    return name.endswith(".toml") or "/" in name


def id_of(path: Path) -> str:
    """A profile's ID: its file's name without the ending."""
    return path.name.removesuffix(".toml")
