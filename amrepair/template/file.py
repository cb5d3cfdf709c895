"""The template's file: safetensors with JSON metadata, written whole or not at all; never pickle.

It knows arrays and a head; what they mean is the business of the classes that are kept in it.
"""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amrepair.errors import TemplateError
from gcode.whole import put_in_place

if TYPE_CHECKING:
    import trimesh

FORMAT = "amrepair-template"
FORMAT_VERSION = 3  # templates with a spread are a kind of their own
FILE_HEAD = "amrepair"


def write_template(path: Path, arrays: dict[str, np.ndarray], head: dict[str, Any]) -> None:
    """Write arrays and head.

    Raises
    ------
    TemplateError
        If the file cannot be written.
    """
    from safetensors.numpy import save

    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    said = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "units": "mm",
        "frame": "template",
        "crc32": _crc32(arrays),
        **head,
    }
    data = save(arrays, metadata={FILE_HEAD: json.dumps(said)})
    try:
        with put_in_place(path) as draft:
            draft.write_bytes(data)
    except OSError as error:
        raise TemplateError(f"the template {path} cannot be written ({error.strerror})") from error


def read_template(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and head of a file that is really ours.

    Raises
    ------
    TemplateError
        If it is missing, truncated, damaged, foreign or of another version.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise TemplateError(f"the template {path} does not exist or is not a file")
    try:
        with safe_open(path, framework="np") as file:
            head = json.loads((file.metadata() or {}).get(FILE_HEAD, "null"))
            if not isinstance(head, dict) or head.get("format") != FORMAT:
                raise TemplateError(
                    f"{path} is a safetensors file, but no template of ours; fit one with "
                    "'amrepair template fit'"
                )
            if head.get("format_version") != FORMAT_VERSION:
                raise TemplateError(
                    f"{path} is a template of another version ({head.get('format_version')}, this "
                    f"one reads {FORMAT_VERSION}); fit it again"
                )
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise TemplateError(
            f"the template {path} is truncated or no template ({error}); fit it again"
        ) from error
    if head.get("crc32", said := _crc32(arrays)) != said:
        raise TemplateError(
            f"the template {path} is damaged (its numbers do not add up to the checksum it was "
            "written with); copy it again, or fit it again"
        )
    return arrays, head


def _crc32(arrays: dict[str, np.ndarray]) -> int:
    """Checksum of all arrays, in the order of their names."""
    checksum = 0
    for name in sorted(arrays):
        checksum = zlib.crc32(arrays[name].tobytes(), checksum)
    return checksum


def require_kind(path: Path, found: object, wanted: str) -> None:
    """Refuse a template of another kind.

    Raises
    ------
    TemplateError
        If the kinds differ.
    """
    if found != wanted:
        raise TemplateError(
            f"{path} holds a template of the kind '{found}', not '{wanted}'; open it with "
            "load_template, or fit it again"
        )


# What a template's file says of how it was made.
KNOWN_METADATA = (
    "recipe", "seed", "part_sha256", "version", "notes", "settings", "steps", "scans",
    "learned_from",
)  # fmt: skip


def stored_mesh(path: Path, arrays: dict[str, np.ndarray]) -> trimesh.Trimesh:
    """The closed mesh that a template's file carries."""
    import trimesh

    mesh = trimesh.Trimesh(arrays["vertices_mm"], arrays["faces"], process=False)
    mesh.metadata["notes"] = ()
    mesh.metadata["source"] = str(path)
    return mesh


def stored_metadata(head: dict[str, Any]) -> dict[str, str]:
    """How a template was made, as its file says."""
    return {key: str(head[key]) for key in KNOWN_METADATA if key in head}
