"""Options and inputs that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.simulate.run import scale_to_fit
from amrepair.template import load_mesh
from gcode.cli import console
from gcode.profiles import PrintSetup

PrinterOption = Annotated[
    str,
    typer.Option(
        help="Printer profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("printers"),
    ),
]
MaterialOption = Annotated[
    str,
    typer.Option(
        help="Material profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("materials"),
    ),
]
ProcessOption = Annotated[
    str,
    typer.Option(
        help="Process profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("processes"),
    ),
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of everything that is drawn.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="One JSON object on standard output, nothing else there.")
]


def scaled_mesh(path: Path, scale: str, setup: PrintSetup) -> Any:
    """A part's mesh, scaled as asked.

    Raises
    ------
    InputError
        If the file is no solid, or the factor is none.
    """
    mesh = load_mesh(path)
    if scale == "fit":
        factor = scale_to_fit(np.asarray(mesh.bounds, dtype=np.float64), setup)
    else:
        try:
            factor = float(scale)
        except ValueError:
            factor = np.nan
        if not 1e-3 <= factor <= 1e3:
            raise InputError(f"--scale is {scale!r}; give a factor from 0.001 to 1000, or 'fit'")
    if factor != 1.0:
        mesh.apply_scale(factor)  # type: ignore[no-untyped-call]
    return mesh


def numbers(text: str, count: int, option: str) -> np.ndarray:
    """Comma-separated numbers of an option.

    Raises
    ------
    InputError
        If they are not `count` finite numbers.
    """
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option} is {text!r}; give {count} numbers with commas between them")
    return values


def part_pose(text: str) -> Transform:
    """`X,Y,Z,RZ`: where the part's origin stands on the bed, and its turn about Z, degrees."""
    x, y, z, turn_deg = numbers(text, 4, "--part-pose")
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return Transform.from_rotation_translation(
        "build",
        "template",
        rotation=np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]),
        translation_mm=np.array([x, y, z]),
    )


SensorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--sensor-at",
        help="X,Y,Z of the scanner, in the scan's frame, mm; may be repeated. Tells unseen from "
        "missing.",
    ),
]


def sensors(texts: list[str] | None) -> np.ndarray | None:
    """(k, 3) sensor positions of the option; None where it was not given."""
    if not texts:
        return None
    return np.stack([numbers(text, 3, "--sensor-at") for text in texts])
