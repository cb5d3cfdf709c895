"""`FLEET.toml`: which printers there are, and what each prints."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from amrepair.errors import InputError
from gcode.errors import ProfileError
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS
from gcode.profiles.names import is_path
from gcode.profiles.store import read_toml, validated

_PRINTER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
Whole = Annotated[int, Field(strict=True, ge=0)]
Seconds = Annotated[float, Field(strict=True, gt=0)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PrinterSpec(_Table):
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
    approve: Literal["ask", "auto"] = "ask"
    every: Whole = 0
    at_layer: tuple[Whole, ...] = ()
    scan_timeout_s: Seconds = 120.0
    part: str = ""


class FleetOptions(_Table):
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
    restarts: Whole = 3
    within_s: Seconds = 3600.0
    answer_within_s: Seconds = 1800.0
    judges: Whole = 1
    judged_within_s: Seconds = 20.0


class FleetConfig(_Table):
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
        said = read_toml(path)
        tables = said.pop("printer", [])
        if not isinstance(tables, list) or not tables:
            raise InputError(f"{path} has no printer; write a [[printer]] table for each")
        options = validated(FleetOptions, said, path)
        found = [
            validated(PrinterSpec, table, f"{path}, printer {number}")
            for number, table in enumerate(tables, start=1)
        ]
    except ProfileError as error:
        raise InputError(f"{error}") from error
    for spec in found:
        if not _PRINTER_NAME.fullmatch(spec.name):
            raise InputError(
                f"{path}: the name {spec.name!r} becomes a folder; use letters, digits, - and _"
            )
    printers = tuple(_beside(spec, path.parent) for spec in found)
    _refuse_twice(path, [spec.name for spec in printers], "name")
    ports = [str(Path(s.port).resolve()) if s.port.startswith("/") else s.port for s in printers]
    _refuse_twice(path, ports, "port")
    options = options.model_copy(update={"out": path.parent / options.out})
    return FleetConfig(options=options, printers=printers)


def _beside(spec: PrinterSpec, base: Path) -> PrinterSpec:
    """With its paths from a folder on."""
    kind, _, where = spec.scanner.partition(":")
    files: dict[str, Path | str] = {"job": base / spec.job, "template": base / spec.template}
    files["scanner"] = f"{kind}:{base / where}" if where else spec.scanner
    for key in ("printer", "material", "process"):
        named = getattr(spec, key)
        files[key] = str(base / named) if is_path(named) else named
    return spec.model_copy(update=files)


def _refuse_twice(path: Path, values: list[str], what: str) -> None:
    twice = [one for one in values if values.count(one) > 1]
    if twice:
        raise InputError(f"{path}: two printers have the {what} {twice[0]}; each needs its own")
