"""`gcode profiles import` and `find`: other programs' profiles as ours."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcode.cli import console
from gcode.cli.options import JsonOption, plain_text
from gcode.errors import InputError

if TYPE_CHECKING:
    from gcode.profiles.importers import ImportedFile

SHOWN = 60


@console.command(
    "import",
    "gcode profiles import job.gcode --out mine",
    "gcode profiles import printer.cfg --out mine",
    "gcode profiles import PrusaSlicer_config_bundle.ini --preset printer:NAME",
)
def import_(
    file: Annotated[
        Path,
        typer.Argument(
            help="PrusaSlicer .ini, OrcaSlicer .json, Klipper printer.cfg, or a slicer's job."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the TOML files.")] = Path(),
    preset: Annotated[
        str | None, typer.Option(help="Preset of a PrusaSlicer bundle: printer:NAME, …")
    ] = None,
    inherits: Annotated[
        str | None, typer.Option(help="Shipped profile for what the source does not know.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Import a profile: every key is mapped, or listed with the reason."""
    from gcode.profiles.importers import file_name, import_profiles, to_toml
    from gcode.profiles.importers.jobs import JOB_SUFFIXES

    text = plain_text(file) if file.suffix.lower() in JOB_SUFFIXES else None
    found = import_profiles(file, preset=preset, inherits=inherits, text=text)
    folders = len(found.profiles) > 1
    paths = []
    for made in found.profiles:
        paths.append((out / made.kind if folders else out) / file_name(made))
        if paths[-1].exists():
            raise InputError(f"{paths[-1]} is there already; remove it, or name another --out.")
    for made, path in zip(found.profiles, paths, strict=True):
        text = to_toml(made, found.source)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path.parent} cannot be made ({error.strerror}).") from error
        console.write_text(path, text)
    if as_json:
        console.show_json(_result(found, paths))
    else:
        _show(found, paths)


@console.command("find", "gcode profiles find", "gcode profiles find --all --json")
def find(
    everything: Annotated[
        bool, typer.Option("--all", help="Those that came with the slicers, too.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List the presets of installed slicers, with what imports them."""
    from gcode.profiles.finding import configuration_folders, find_presets

    found = find_presets()
    shown = [preset for preset in found if preset.own or everything]
    if as_json:
        console.show_json(
            {
                "presets": [
                    {
                        "slicer": p.slicer, "kind": p.kind, "name": p.name, "path": str(p.path),
                        "preset": p.preset, "own": p.own,
                    }
                    for p in shown
                ],
                "with_the_slicers": sum(not preset.own for preset in found),
            }
        )  # fmt: skip
        return
    for p in shown:
        option = f" --preset {shlex.quote(p.preset)}" if p.preset else ""
        console.out.print(f"{p.slicer} {p.kind}: {p.name}")
        console.out.print(f"  gcode profiles import {shlex.quote(str(p.path))}{option}")
    others = len(found) - len(shown)
    if not found:
        places = ", ".join(str(path) for _, path in configuration_folders()) or "none"
        console.out.print(
            f"No preset of PrusaSlicer, OrcaSlicer or a relative of theirs is installed here "
            f"(configuration folders found: {places})."
        )
    elif others:
        console.out.print(f"{others} came with the slicers: --all lists them.")


def _result(found: ImportedFile, paths: list[Path]) -> dict[str, Any]:
    return {
        "profiles": [
            {
                "path": str(path),
                "kind": made.kind,
                "inherits": made.inherits,
                "mapped": [
                    {"source_key": m.source_key, "key": m.key, "value": m.value}
                    for m in made.mapped
                ],
            }
            for made, path in zip(found.profiles, paths, strict=True)
        ],
        "not_mapped": [
            {"source_key": row.source_key, "value": row.source_value, "reason": row.reason}
            for row in found.left
        ],
        "notes": list(found.notes),
    }


def _show(found: ImportedFile, paths: list[Path]) -> None:
    from gcode.profiles.importers.rules import NO_COUNTERPART

    for made, path in zip(found.profiles, paths, strict=True):
        console.out.print(f"{path}: {len(made.mapped)} keys, the rest from {made.inherits}.")
    for note in found.notes:
        console.out.print(f"note: {note}.")
    if not found.left:
        console.out.print("Every key of the source is in them.")
        return
    console.out.print(
        f"{len(found.left)} keys are not mapped (--json tells all, with their values):"
    )
    for row in found.left:
        if row.reason != NO_COUNTERPART:
            value = " ".join(row.source_value.split())[:SHOWN]
            console.out.print(f"  {row.source_key} = {value}: {row.reason}")
    unlike = sum(row.reason == NO_COUNTERPART for row in found.left)
    if unlike:
        console.out.print(f"  and {unlike} more: {NO_COUNTERPART}")
