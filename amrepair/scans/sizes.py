"""What a file promises, held against its length before anything is made for it."""

from __future__ import annotations

import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from amrepair.errors import InputError

# What the libraries that read meshes, images and archives are known to raise on damaged files.
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
                f"limit is {most:.0f}; the file is damaged or a trap, else export it uncompressed"
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
            "it is cut off or damaged"
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
        raise InputError(f"{path}: the file cannot be read ({e.strerror})") from e


def in_words(error: BaseException) -> str:
    """What a foreign error says, on one line; its kind where it says nothing."""
    said = " ".join(str(error).split())
    return said[:200] or type(error).__name__
