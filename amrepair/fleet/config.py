"""`FLEET.toml`: which printers there are, and what each prints."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

_PRINTER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class PrinterSpec:
    """One printer and its job, as `amrepair loop` takes them.

    Attributes
    ----------
    name
        Of its folder, on the page and in the history.
    part
        What the history calls the part; the job's name where nobody says.
    every, at_layer
        When it is looked at.
    """

    name: str
    port: str
    scanner: str
    job: Path
    template: Path
    printer: str = DEFAULT_PRINTER
    material: str = DEFAULT_MATERIAL
    process: str = DEFAULT_PROCESS
    approve: str = "ask"
    every: int = 0
    at_layer: tuple[int, ...] = ()
    scan_timeout_s: float = 120.0
    part: str = ""


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """What holds for all printers.

    Attributes
    ----------
    out
        Folder of the runs, the history and the report.
    restarts, within_s
        So many times in so many seconds a printer's process that died is started again.
    answer_within_s
        A question that nobody answers for so long ends its run, heaters off: it can be gone on
        with.
    judges, judged_within_s
        So many processes detect for all printers; what they have not come to in so many seconds a
        printer's own process does. With 0 judges all is done by the printers' own.
    """

    out: Path = Path("out/fleet")
    restarts: int = 3
    within_s: float = 3600.0
    answer_within_s: float = 1800.0
    judges: int = 1
    judged_within_s: float = 20.0


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """The file, read."""

    options: FleetOptions
    printers: tuple[PrinterSpec, ...]


def read_config(path: Path) -> FleetConfig:
    """Read a fleet's file; paths in it are relative to it.

    Raises
    ------
    InputError
        If it cannot be read, a word is unknown, or two printers share a name or a port.
    """
    try:
        said = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is no TOML ({error})") from error
    tables = said.pop("printer", [])
    if not isinstance(tables, list) or not tables:
        raise InputError(f"{path} has no printer; write a [[printer]] table for each")
    base = path.parent
    options = _made(FleetOptions, said, f"{path}", base)
    for name in ("restarts", "judges"):
        if (value := getattr(options, name)) < 0:
            raise InputError(f"{path}: {name} is {value}; it must be 0 or more")
    for name in ("within_s", "answer_within_s", "judged_within_s"):
        if not 0 < (value := getattr(options, name)) < math.inf:
            raise InputError(f"{path}: {name} is {value:g}; it must be more than 0 s, and finite")
    printers = tuple(
        _made(PrinterSpec, table, f"{path}, printer {number}", base)
        for number, table in enumerate(tables, start=1)
    )
    for spec in printers:
        if not _PRINTER_NAME.fullmatch(spec.name):
            raise InputError(
                f"{path}: the name {spec.name!r} becomes a folder; use letters, digits, - and _"
            )
        if spec.approve not in ("ask", "auto"):
            raise InputError(f"{path}: approve of {spec.name} is {spec.approve!r}; ask or auto")
    _refuse_twice(path, [spec.name for spec in printers], "name")
    ports = [str(Path(s.port).resolve()) if s.port.startswith("/") else s.port for s in printers]
    _refuse_twice(path, ports, "port")
    return FleetConfig(options, printers)


def _refuse_twice(path: Path, values: list[str], what: str) -> None:
    twice = [one for one in values if values.count(one) > 1]
    if twice:
        raise InputError(f"{path}: two printers have the {what} {twice[0]}; each needs its own")


def _made(kind: Any, said: Mapping[str, Any], where: str, base: Path) -> Any:
    """A dataclass from a table of its fields."""
    known = {one.name: one for one in fields(kind)}
    for name, value in said.items():
        if name not in known:
            raise InputError(f"{where}: {name!r} is unknown; there are {', '.join(known)}")
        if not _fits(value, str(known[name].type)):
            raise InputError(f"{where}: {name} is {value!r}; it is to be {known[name].type}")
    missing = [
        one.name for one in known.values() if one.default is MISSING and one.name not in said
    ]
    if missing:
        raise InputError(f"{where}: {missing[0]} is missing")
    values: dict[str, Any] = {}
    for name, value in said.items():
        wanted = str(known[name].type)
        if wanted == "Path":
            values[name] = base / value
        elif wanted == "float":
            values[name] = float(value)
        elif name == "scanner" and value.startswith("watch:"):
            values[name] = f"watch:{base / value.removeprefix('watch:')}"
        else:
            values[name] = tuple(value) if isinstance(value, list) else value
    return kind(**values)


def _fits(value: Any, wanted: str) -> bool:
    if isinstance(value, bool):
        return False
    if wanted == "float":
        return isinstance(value, (int, float))
    if wanted == "int":
        return isinstance(value, int)
    if wanted.startswith("tuple"):
        return isinstance(value, list) and all(isinstance(one, int) for one in value)
    return isinstance(value, str)
