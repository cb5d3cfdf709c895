"""Where the example parts lie: beside this module once installed, in `examples/` in a checkout.

It finds files; it neither models parts nor reads meshes.
"""

from __future__ import annotations

from pathlib import Path

from amrepair.errors import InputError

_FOLDERS = (
    Path(__file__).parent / "parts",  # force-included in the wheel
    Path(__file__).parents[2] / "examples" / "parts",
)


def part_names() -> tuple[str, ...]:
    """Names of the parts that `part_path` knows, sorted."""
    return tuple(sorted({path.stem for folder in _FOLDERS for path in folder.glob("*.stl")}))


def part_path(name: str) -> Path:
    """Path of the STL of an example part.

    Raises
    ------
    InputError
        If there is no such part.
    """
    for folder in _FOLDERS:
        candidate = folder / f"{name}.stl"
        if candidate.is_file():
            return candidate
    raise InputError(
        f"there is no example part named {name!r}; there are {', '.join(part_names()) or 'none'}"
    )
