"""`gcode profiles list` and `show`."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from gcode.cli import console
from gcode.cli.options import JsonOption
from gcode.errors import InputError
from gcode.profiles import list_profiles


@console.command("list", "gcode profiles list", "gcode profiles list --json")
def profiles_list(as_json: JsonOption = False) -> None:
    """List the shipped profiles."""
    found = {kind: list(list_profiles(kind)) for kind in ("printers", "materials", "processes")}
    if as_json:
        console.show_json(found)
        return
    for kind, names in found.items():
        console.out.print(f"{kind}: {', '.join(names)}")


@console.command("show", "gcode profiles show prusa_mk3s", "gcode profiles show mine.toml")
def profiles_show(
    profile: Annotated[str, typer.Argument(help="ID or TOML file.")],
    kind: Annotated[
        str, typer.Option(help="printers, materials or processes, where the file leaves it open.")
    ] = "",
) -> None:
    """Show a profile with everything it inherits, as JSON."""
    from gcode.profiles import kind_of, load_material, load_printer, load_process

    loaders: dict[str, Any] = {
        "printers": load_printer,
        "materials": load_material,
        "processes": load_process,
    }
    if kind and kind not in loaders:
        raise InputError(f"There is no kind '{kind}' of profiles; there are {', '.join(loaders)}.")
    console.show_json(loaders[kind or kind_of(profile)](profile).model_dump(mode="json"))
