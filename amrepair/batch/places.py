"""Where a batch reads and writes: folders of this machine, or object stores through fsspec.

A write is whole or not there: on a disk by a temporary file, fsync and rename; object stores show
an object when all of it has come.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, Protocol, runtime_checkable

from amrepair.errors import InputError, MissingDependencyError
from gcode.locks import try_lock
from gcode.whole import write_bytes

_STREAM_BYTES = 1 << 20


def is_remote(uri: str) -> bool:
    """Whether an address is one of an object store (`s3://…`), and not a path."""
    return "://" in uri


def suffix_of(uri: str) -> str:
    """The ending by which a scan is read."""
    return PurePosixPath(uri).suffix.lower()


@runtime_checkable
class ResultFolder(Protocol):
    """A folder, wherever it is."""

    def write(self, name: str, data: bytes) -> None:
        """Write a file whole or not at all."""

    def read(self, name: str) -> bytes:
        """All of a file."""

    def names(self, folder: str) -> set[str]:
        """Names of the files in a folder; none where there is no folder."""

    def alone(self) -> contextlib.AbstractContextManager[None]:
        """Keep other batches out, where that can be done."""


class Folder:
    """A folder on this machine.

    Raises
    ------
    InputError
        If it cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"the output folder {path} cannot be made ({error.strerror}); name another one"
            ) from error

    def write(self, name: str, data: bytes) -> None:
        """Write under another name, onto the disk, then put in place."""
        write_bytes(self.path / name, data, durable=True)

    def read(self, name: str) -> bytes:
        """All of a file."""
        return (self.path / name).read_bytes()

    def names(self, folder: str) -> set[str]:
        """Names of whole files; what a killed batch was writing begins with a dot."""
        try:
            return {p.name for p in os.scandir(self.path / folder) if not p.name.startswith(".")}
        except FileNotFoundError:
            return set()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Hold a lock that ends with this process, however it ends."""
        with (self.path / ".lock").open("w") as stream:
            if not try_lock(stream.fileno()):
                raise InputError(
                    f"another batch works in {self.path}; wait for its end or name another --out"
                )
            yield


class Store:
    """A folder of an object store."""

    def __init__(self, uri: str) -> None:
        self._root = uri.rstrip("/")
        self._system, self._base = _system_of(self._root)

    def write(self, name: str, data: bytes) -> None:
        """Put an object; the store shows it when it is whole."""
        with _as_os_errors():
            self._system.pipe_file(f"{self._base}/{name}", data)

    def read(self, name: str) -> bytes:
        """All of an object."""
        with _as_os_errors():
            return bytes(self._system.cat_file(f"{self._base}/{name}"))

    def names(self, folder: str) -> set[str]:
        """Names of the objects directly below a folder."""
        self._system.invalidate_cache()
        try:
            with _as_os_errors():
                found = self._system.ls(f"{self._base}/{folder}", detail=False)
        except FileNotFoundError:
            return set()
        return {PurePosixPath(one).name for one in found}

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Object stores have no locks: two batches there would only do some scans twice."""
        yield


def open_place(uri: str) -> ResultFolder:
    """A folder or a store, by its address."""
    return Store(uri) if is_remote(uri) else Folder(Path(uri))


def listed(uri: str) -> list[tuple[str, str]]:
    """(name, address) of every file below a folder or store, sorted by name."""
    if not is_remote(uri):
        root = Path(uri)
        found = [p for p in root.rglob("*") if p.is_file()]
        named = [(p.relative_to(root).as_posix(), str(p)) for p in found]
    else:
        system, base = _system_of(uri.rstrip("/"))
        scheme = uri.split("://", 1)[0]
        with _as_os_errors():
            found_names = [str(one) for one in system.find(base)]
        named = [(one[len(base) + 1 :], f"{scheme}://{one}") for one in found_names]
    hidden = [n for n, _ in named if any(part.startswith(".") for part in n.split("/"))]
    return sorted(one for one in named if one[0] not in set(hidden))


def digest_of(uri: str) -> tuple[str, int]:
    """SHA-256 of a file's bytes, and how many they are.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    digest, size = hashlib.sha256(), 0
    with _as_os_errors(), _opened(uri) as stream:
        while chunk := stream.read(_STREAM_BYTES):
            digest.update(chunk)
            size += len(chunk)
    return digest.hexdigest(), size


@contextmanager
def at_hand(uri: str) -> Iterator[Path]:
    """The file on this machine: itself, or a copy that goes when it is done with."""
    if not is_remote(uri):
        yield Path(uri)
        return
    with tempfile.TemporaryDirectory(prefix="amrepair-batch-") as folder:
        path = Path(folder) / f"scan{suffix_of(uri)}"
        with _as_os_errors(), _opened(uri) as stream, path.open("wb") as copy:
            while chunk := stream.read(_STREAM_BYTES):
                copy.write(chunk)
        yield path


def _opened(uri: str) -> Any:
    if not is_remote(uri):
        return Path(uri).open("rb")
    system, path = _system_of(uri)
    return system.open(path, "rb")


@contextmanager
def _as_os_errors() -> Iterator[None]:
    """What a store's own library raises, as what a disk would."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        raise OSError(errno.EIO, " ".join(str(error).split())) from error


def _system_of(uri: str) -> tuple[Any, str]:
    """The file system of an address, and the path in it."""
    try:
        import fsspec

        system, path = fsspec.core.url_to_fs(uri)
    except ImportError as error:
        raise MissingDependencyError(
            f"{uri} needs a library that is not there ({error}); pip install 'amrepair[store]'"
        ) from error
    except ValueError as error:
        raise InputError(f"{uri}: no such kind of store ({error})") from error
    return system, str(path)
