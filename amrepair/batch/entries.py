"""What a batch is asked to do: a folder of scans, or a manifest (CSV or JSON lines)."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from amrepair.batch.places import is_remote, listed, suffix_of
from amrepair.errors import InputError

MANIFEST_SUFFIXES = (".csv", ".jsonl", ".ndjson")
_KNOWN = ("path", "time", "label")


@dataclass(frozen=True, slots=True)
class Entry:
    """One scan of the batch.

    Attributes
    ----------
    name
        Under the folder, or as the manifest has it; rows are sorted by it.
    uri
        Where it is.
    time
        When it was taken, ISO 8601; empty where nobody said.
    label
        Whatever the manifest says, such as the printer.
    """

    name: str
    uri: str
    time: str = ""
    label: str = ""


def read_entries(source: str) -> list[Entry]:
    """The scans of a folder, a store's folder, or a manifest, sorted by name.

    Raises
    ------
    InputError
        If there is none, or the manifest cannot be read; a file that a manifest names and that is
        not there is no error of the manifest.
    """
    if suffix_of(source) in MANIFEST_SUFFIXES and (is_remote(source) or not Path(source).is_dir()):
        return _of_manifest(source)
    if not is_remote(source) and not Path(source).is_dir():
        raise InputError(
            f"{source}: there is no such folder, and a manifest is named "
            f"{', '.join('*' + s for s in MANIFEST_SUFFIXES)}"
        )
    from amrepair.scans.files import SCAN_SUFFIXES

    found = [Entry(name, uri) for name, uri in listed(source) if suffix_of(uri) in SCAN_SUFFIXES]
    if not found:
        raise InputError(f"{source} holds no scan ({', '.join(sorted(SCAN_SUFFIXES))})")
    return found


def _of_manifest(source: str) -> list[Entry]:
    try:
        if is_remote(source):
            from amrepair.batch.places import at_hand

            with at_hand(source) as path:
                text = path.read_text(encoding="utf-8-sig")
        else:
            text = Path(source).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the manifest {source} cannot be read ({error})") from error
    rows = _csv_rows(text, source) if suffix_of(source) == ".csv" else _json_rows(text, source)
    base = "" if is_remote(source) else str(Path(source).parent)
    entries = [_entry(number, row, source, base) for number, row in rows]
    if not entries:
        raise InputError(f"the manifest {source} names no scan")
    seen: dict[str, int] = {}
    for (number, _), entry in zip(rows, entries, strict=True):
        if entry.name in seen:
            raise InputError(
                f"{source}, line {number}: {entry.name} is named in line {seen[entry.name]} already"
            )
        seen[entry.name] = number
    return sorted(entries, key=lambda one: one.name)


def _csv_rows(text: str, source: str) -> list[tuple[int, Mapping[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text))
    if reader.fieldnames is None or "path" not in reader.fieldnames:
        raise InputError(
            f"the manifest {source} has no column 'path' in its first line; it may have time and "
            "label, too"
        )
    return [(reader.line_num, row) for row in reader]


def _json_rows(text: str, source: str) -> list[tuple[int, Mapping[str, Any]]]:
    rows: list[tuple[int, Mapping[str, Any]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except ValueError as error:
            raise InputError(f"{source}, line {number} is no JSON ({error})") from error
        if not isinstance(row, dict):
            raise InputError(f"{source}, line {number} is no JSON object")
        rows.append((number, row))
    return rows


def _entry(number: int, row: Mapping[str, Any], source: str, base: str) -> Entry:
    values = {name: str(row.get(name) or "").strip() for name in _KNOWN}
    if not values["path"]:
        raise InputError(f"{source}, line {number} names no path")
    if values["time"]:
        try:
            datetime.fromisoformat(values["time"])
        except ValueError as error:
            raise InputError(
                f"{source}, line {number}: the time is {values['time']!r}; write it as "
                "2026-11-24 or 2026-11-24T14:30:00"
            ) from error
    path = values["path"]
    uri = path if is_remote(path) or not base else str(Path(base) / path)
    return Entry(path, uri, values["time"], values["label"])
