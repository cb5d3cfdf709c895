"""Files that are there whole or not at all: written beside their place, then put into it."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_DRAFT = re.compile(r"\.\d+-\d+-.")


@contextmanager
def put_in_place(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A file to write; it is put in the place of `path` at the end, or is gone.

    Its name begins with a dot and ends as the other does: some writers choose their format by the
    ending.

    Parameters
    ----------
    durable
        What is written and its name are on the disk when this returns, so that a power cut takes
        neither.

    Raises
    ------
    OSError
        If it cannot be written: what was in its place before is there still.
    """
    # threads of one process may write one file
    draft = path.with_name(f".{os.getpid()}-{threading.get_native_id()}-{path.name}")
    try:
        yield draft
        if durable:
            _to_disk(draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    if durable:
        _to_disk(path.parent)


def write_bytes(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Write a file, as `put_in_place` does; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with put_in_place(path, durable=durable) as draft:
        draft.write_bytes(data)


def why_no_file(path: Path) -> str:
    """What to tell of a path that is no file, where one is to be read."""
    return "is a folder; name a file in it" if path.is_dir() else "there is no such file"


def left_behind(folder: Path) -> Iterator[Path]:
    """What processes that were killed were writing, in a folder and those below it."""
    return (path for path in folder.rglob(".*") if _DRAFT.match(path.name))


def _to_disk(path: Path) -> None:
    on_windows = os.name == "nt"  # there folders are no files, and who only reads cannot ask
    if on_windows and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if on_windows else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
