"""What a file promises, held against its length before anything is made for it."""

from __future__ import annotations

import logging
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gcode.errors import InputError

if TYPE_CHECKING:
    import tifffile

# What the libraries that read meshes, images and archives are known to raise on damaged files;
# tifffile's own error is a ValueError.
PARSER_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    NameError,
    NotImplementedError,
    OSError,
    RecursionError,
    RuntimeError,
    StopIteration,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)
RAW_TIFF = 1  # TIFF's number for no compression


@dataclass(frozen=True, slots=True)
class UnpackLimit:
    """How much a compressed file may unpack to.

    Attributes
    ----------
    least_bytes
        Always allowed: the raw depths of a 16 megapixel camera, and then some.
    ratio
        Beyond that, so many times the file. Measured depth maps, scans and 3MF meshes shrink two-
        to tenfold; what shrinks a hundredfold says next to nothing.
    """

    least_bytes: int = 48 * 2**20
    ratio: float = 20.0

    def refuse(self, path: Path, unpacked_bytes: int, packed_bytes: int) -> None:
        """Refuse what swells beyond the limit.

        Raises
        ------
        InputError
            With both sizes.
        """
        most = max(self.least_bytes, self.ratio * packed_bytes)
        if unpacked_bytes > most:
            raise InputError(
                f"{path}: {packed_bytes} compressed bytes should unpack to {unpacked_bytes}, the "
                f"limit is {most:.0f}; the file is damaged or a trap, else export it uncompressed."
            )


def refuse_short(path: Path, what: str, need_bytes: int, have_bytes: int) -> None:
    """Refuse a file that cannot hold what it promises; `what` is that in words.

    Raises
    ------
    InputError
        With both sizes.
    """
    if need_bytes > have_bytes:
        raise InputError(
            f"{path}: the file promises {what}, at least {need_bytes} bytes, and has {have_bytes}; "
            "it is cut off or damaged."
        )


def length_of(path: Path) -> int:
    """Bytes of a file.

    Raises
    ------
    InputError
        If it cannot be asked.
    """
    try:
        return path.stat().st_size
    except OSError as e:
        raise InputError(f"{path}: the file cannot be read ({e.strerror}).") from e


def in_words(error: BaseException) -> str:
    """What a foreign error says, on one line; its kind where it says nothing."""
    said = " ".join(str(error).split())
    if isinstance(error, KeyError):  # which says what was asked for, and no more
        said = f"it has no {said}"
    return said[:200] or type(error).__name__


def refuse_swollen_page(path: Path, page: Any, limit: UnpackLimit) -> None:
    """Refuse a page of a TIFF that the file cannot hold.

    Raises
    ------
    InputError
        If it is larger than what is stored of it, or swells beyond the limit.
    """
    size = length_of(path)
    what = "an image of " + " × ".join(str(n) for n in page.shape)
    promised, there = math.prod(page.chunked), len(page.dataoffsets)
    if there < promised:  # what is not there would be read as zeros
        raise InputError(
            f"{path}: {what} is in {promised} pieces, and the file has {there}; it is cut off or "
            "damaged."
        )
    if page.compression == RAW_TIFF:
        refuse_short(path, what, page.nbytes, size)
    else:
        limit.refuse(path, page.nbytes, min(size, sum(page.databytecounts)))


@contextmanager
def quiet_tiff(path: Path) -> Iterator[tifffile.TiffFile]:
    """A TIFF file, opened; what its reader finds odd is told once, by whoever asked."""
    import tifffile  # a tenth of a second, which whoever reads no images need not wait

    said = logging.getLogger("tifffile")
    level = said.level
    said.setLevel(logging.CRITICAL)
    try:
        with tifffile.TiffFile(path) as tiff:
            yield tiff
    finally:
        said.setLevel(level)
