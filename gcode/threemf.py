"""3MF files: triangles of all that a file builds, read with limits.

The 3MF core specification 1.3 and, of the production extension, paths of objects. Sizes are judged
by the zip file's own directory before anything is unpacked, XML is taken without a document type
or entities, and parts that are used many times are counted before they are laid out. Each model
part's lengths are in the unit that it tells, and given in millimetres.
"""

from __future__ import annotations

import zipfile
import zlib
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from jaxtyping import Float, Int

ROOT_MODEL = "3D/3dmodel.model"
RELATIONS = "_rels/.rels"
MODEL_RELATION = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
# Meshes as XML pack to a tenth or less of their size, regular ones to a fiftieth; deflate itself
# goes no further than a thousandth. What is small in any case may pack as it likes.
MOST_PACKED, SMALL_BYTES = 100, 16 * 2**20
MOST_DIRECTORY_BYTES = 4 * 2**20  # some 50,000 files in one
CHUNK_BYTES, PROLOGUE_BYTES = 2**20, 2**16
MOST_LAID_OUT = 5_000_000  # triangles by using parts again and again
MOST_NESTED = 32  # components in components
_GROWS = "{name} has a document type or entities, which no 3MF has"
_END_OF_DIRECTORY = b"PK\x05\x06"
_END_BYTES, _COMMENT_BYTES = 22, 65_535
# Zip64 (PKWARE's APPNOTE 4.3.14 to 4.3.16): what does not fit four bytes, or might not, is told by
# a record before the end, and a locator between them.
_ELSEWHERE = 0xFFFFFFFF
_END_OF_DIRECTORY_64, _END_BYTES_64, _LOCATOR_BYTES = b"PK\x06\x06", 56, 20
# Core specification 1.3, 3.4.1 (ST_Unit), in mm.
UNITS_MM = {
    "micron": 0.001, "millimeter": 1.0, "centimeter": 10.0,
    "inch": 25.4, "foot": 304.8, "meter": 1000.0,
}  # fmt: skip
_IDENTITY = np.hstack([np.eye(3), np.zeros((3, 1))])

Key = tuple[str, str]  # which model part of the file, and the object's number in it
Use = tuple[Key, Float[np.ndarray, "3 4"]]


@dataclass
class _Object:
    """A mesh, or uses of other objects."""

    numbers: array[float] = field(default_factory=lambda: array("d"))
    corners: array[int] = field(default_factory=lambda: array("q"))
    uses: list[Use] = field(default_factory=list)


def read_3mf(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and faces of all that a file builds, in its build's frame.

    Raises
    ------
    ValueError
        With a sentence, where the file is no 3MF, damaged, or unpacks beyond all measure.
    """
    with _opened(path) as model:
        return model.triangles()


def refuse_trap(path: Path) -> None:
    """Refuse at once what reading would refuse as no 3MF, or as one that grows beyond measure.

    The first lines of its model are looked at and nothing is laid out, so that whoever has much to
    load before it reads need not.

    Raises
    ------
    ValueError
        As `read_3mf`.
    """
    with _opened(path) as model:
        model.refuse_trap()


@contextmanager
def _opened(path: Path) -> Iterator[_Model]:
    """A file's model, nothing of it read; damage that shows later is told in a sentence."""
    length = path.stat().st_size
    _refuse_directory(path, length)
    try:
        with zipfile.ZipFile(path) as archive:
            yield _Model(archive, length)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        raise ValueError(f"the zip file in it is damaged: {error}") from error
    except expat.ExpatError as error:
        raise ValueError(f"its XML is damaged: {error}") from error


def _refuse_directory(path: Path, length: int) -> None:
    """The directory's size, before all of it is read."""
    with path.open("rb") as file:
        file.seek(max(0, length - _END_BYTES - _COMMENT_BYTES))
        tail = file.read()
    at = tail.rfind(_END_OF_DIRECTORY)
    if at < 0 or len(tail) - at < _END_BYTES:
        raise ValueError("it is no 3MF file: a zip file has a directory at its end, this has none")
    size = int.from_bytes(tail[at + 12 : at + 16], "little")
    record = tail[max(0, at - _LOCATOR_BYTES - _END_BYTES_64) : at]
    if size == _ELSEWHERE and record.startswith(_END_OF_DIRECTORY_64):
        size = int.from_bytes(record[40:48], "little")
    if size > min(length, MOST_DIRECTORY_BYTES):
        raise ValueError(
            f"its directory takes {size} bytes, the limit is {min(length, MOST_DIRECTORY_BYTES)}"
        )


class _Model:
    """The objects of a file, part by part as they are asked for."""

    def __init__(self, archive: zipfile.ZipFile, length: int) -> None:
        self._archive, self._length = archive, length
        self._unpacked = 0
        self._objects: dict[Key, _Object] = {}
        self._read: set[str] = set()
        self._builds: list[Use] = []

    def triangles(self) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        """Everything that is built; all meshes where nothing says what is."""
        root = self._root()
        self._part(root)
        builds = self._builds or [(key, _IDENTITY) for key in self._unused()]
        for key, _ in builds:
            self._part(key[0])
        laid_out = sum(self._count(key, {}, 0) for key, _ in builds)
        own = sum(len(one.corners) // 3 for one in self._objects.values())
        if laid_out > max(MOST_LAID_OUT, own):
            raise ValueError(
                f"it uses its parts again and again, {laid_out} times and triangles in all; the "
                f"limit is {MOST_LAID_OUT}"
            )
        points, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
        for mesh, pose in self._meshes(builds):
            vertices = np.frombuffer(mesh.numbers, np.float64).reshape(-1, 3)
            corners = np.frombuffer(mesh.corners, np.int64).reshape(-1, 3)
            if corners.max() >= len(vertices):
                raise ValueError(
                    f"a triangle has corner {int(corners.max())} of {len(vertices)} vertices"
                )
            with np.errstate(all="ignore"):  # what is no place is refused by whoever asked
                points.append(vertices @ pose[:, :3].T + pose[:, 3])
            mirrored = np.linalg.det(pose[:, :3]) < 0
            faces.append((corners[:, ::-1] if mirrored else corners) + count)
            count += len(vertices)
        return np.concatenate(points), np.concatenate(faces)

    def _root(self) -> str:
        names = {name.lower(): name for name in self._archive.namelist()}
        if RELATIONS in names:
            found: list[str] = []

            def start(tag: str, values: dict[str, str]) -> None:
                if _local(tag) == "Relationship" and values.get("Type") == MODEL_RELATION:
                    found.append(values.get("Target", "").lstrip("/"))

            self._parse(names[RELATIONS], start)
            if found and found[0] in self._archive.namelist():
                return found[0]
        if ROOT_MODEL.lower() in names:
            return names[ROOT_MODEL.lower()]
        raise ValueError(
            f"it holds no model: there is no {ROOT_MODEL} among its {len(names)} files"
        )

    def _part(self, name: str) -> None:
        """Read the objects of one model part."""
        if name in self._read:
            return
        self._read.add(name)
        if name not in self._archive.namelist():
            raise ValueError(f"an object is in {name!r}, which is not in the file")
        self._parse(name, _Reader(self, name).start)

    def refuse_trap(self) -> None:
        """Raise for what the root model's size or its first lines already tell."""
        name = self._root()
        with self._parser_of(name)[1] as stream:
            head = stream.read(PROLOGUE_BYTES)
        if b"<!DOCTYPE" in head or b"<!ENTITY" in head:
            raise ValueError(_GROWS.format(name=name))

    def _parse(self, name: str, start: object) -> None:
        """XML without a document type or entities, no larger than its file makes likely."""
        parser, packed = self._parser_of(name)
        parser.StartElementHandler = start  # type: ignore[assignment]
        with packed as stream:
            while chunk := stream.read(CHUNK_BYTES):
                parser.Parse(chunk, False)
        parser.Parse(b"", True)

    def _parser_of(self, name: str) -> tuple[expat.XMLParserType, Any]:
        """A parser for one file, and the file, once its size is known to be likely."""
        size = self._archive.getinfo(name).file_size
        self._unpacked += size
        limit = max(MOST_PACKED * self._length, SMALL_BYTES)
        if self._unpacked > limit:
            raise ValueError(
                f"{name} would unpack to {self._unpacked} bytes from a file of {self._length}; the "
                f"limit is {limit}"
            )
        parser = expat.ParserCreate()
        parser.buffer_text = True

        def no_entities(*_: object) -> None:
            raise ValueError(_GROWS.format(name=name))

        parser.StartDoctypeDeclHandler = no_entities
        parser.EntityDeclHandler = no_entities
        return parser, self._archive.open(name)

    def _unused(self) -> list[Key]:
        used = {key for one in self._objects.values() for key, _ in one.uses}
        return [key for key in self._objects if key not in used]

    def _at(self, key: Key, depth: int) -> _Object:
        self._part(key[0])
        if key not in self._objects:
            raise ValueError(f"it builds object {key[1]}, which is not in the file")
        if depth > MOST_NESTED:
            raise ValueError(f"its objects are nested more than {MOST_NESTED} deep, or in a circle")
        return self._objects[key]

    def _count(self, key: Key, known: dict[Key, int], depth: int) -> int:
        """Triangles of an object with all that it uses, and one for each time that it does."""
        if key not in known:
            one = self._at(key, depth)
            parts = [1 + self._count(used, known, depth + 1) for used, _ in one.uses]
            known[key] = len(one.corners) // 3 + sum(parts)
        return known[key]

    def _meshes(
        self, uses: list[Use], depth: int = 0
    ) -> Iterator[tuple[_Object, Float[np.ndarray, "3 4"]]]:
        for key, pose in uses:
            one = self._at(key, depth)
            if len(one.corners):
                yield one, pose
            inner = [(used, _after(pose, by)) for used, by in one.uses]
            yield from self._meshes(inner, depth + 1)

    def add(self, key: Key) -> _Object:
        """A new object of a part."""
        self._objects[key] = _Object()
        return self._objects[key]

    def build(self, use: Use) -> None:
        """One more object is built."""
        self._builds.append(use)


class _Reader:
    """What one model part's elements say."""

    def __init__(self, model: _Model, name: str) -> None:
        self._model, self._name = model, name
        self._object: _Object | None = None
        self._unit_mm = 1.0

    def start(self, tag: str, values: dict[str, str]) -> None:
        """One element begins."""
        tag = _local(tag)
        if tag == "vertex" and self._object is not None:
            unit_mm = self._unit_mm
            self._object.numbers.extend(unit_mm * _real(values, axis) for axis in "xyz")
        elif tag == "triangle" and self._object is not None:
            self._object.corners.extend(_whole(values, k) for k in ("v1", "v2", "v3"))
        elif tag == "model":
            self._unit_mm = _unit(values.get("unit", "millimeter"))
        elif tag == "object":
            self._object = self._model.add((self._name, values.get("id", "")))
        elif tag == "component" and self._object is not None:
            self._object.uses.append(self._use(values))
        elif tag == "item":
            self._model.build(self._use(values))

    def _use(self, values: dict[str, str]) -> Use:
        elsewhere = next((v for k, v in values.items() if _local(k) == "path"), None)
        part = self._name if elsewhere is None else elsewhere.lstrip("/")
        pose = _pose(values.get("transform"))
        turn, shift_mm = pose[:, :3], self._unit_mm * pose[:, 3:]
        return (part, values.get("objectid", "")), np.hstack([turn, shift_mm])


def _local(name: str) -> str:
    return name.rpartition(":")[2]


def _unit(name: str) -> float:
    if name not in UNITS_MM:
        raise ValueError(f"its unit is {name!r:.40}; 3MF knows {', '.join(UNITS_MM)}")
    return UNITS_MM[name]


def _real(values: dict[str, str], key: str) -> float:
    try:
        return float(values[key])
    except KeyError:
        raise ValueError(f"a vertex has no {key}") from None
    except ValueError:
        raise ValueError(f"a vertex has {key}={values[key]!r:.40}, which is no number") from None


def _whole(values: dict[str, str], key: str) -> int:
    text = values.get(key, "")
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise ValueError(f"a triangle has {key}={text!r:.40}, which is no vertex's number")
    return int(text)


def _pose(text: str | None) -> Float[np.ndarray, "3 4"]:
    """Twelve numbers, a row of which multiplies from the left (core specification, 3.3)."""
    if text is None:
        return _IDENTITY
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 12 or not np.isfinite(numbers).all():
        raise ValueError(f"a transform is {text!r:.60}; it is twelve numbers")
    return np.ascontiguousarray(numbers.reshape(4, 3).T)


def _after(
    outer: Float[np.ndarray, "3 4"], inner: Float[np.ndarray, "3 4"]
) -> Float[np.ndarray, "3 4"]:
    turn = outer[:, :3] @ inner[:, :3]
    return np.hstack([turn, (outer[:, :3] @ inner[:, 3] + outer[:, 3])[:, None]])
