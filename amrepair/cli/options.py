"""Options and inputs that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from amrepair.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from amrepair.frames import Transform
    from amrepair.regions.error_calibration import Calibration
    from gcode.profiles import PrintSetup

Options = TypeVar("Options")
_SWITCH = {"true": True, "on": True, "yes": True, "false": False, "off": False, "no": False}

SeedOption = Annotated[int, typer.Option(min=0, help="Seed of everything that is drawn.")]


def scaled_mesh(path: Path, scale: str, setup: PrintSetup) -> Any:
    """A part's mesh, scaled as asked.

    Raises
    ------
    InputError
        If the file is no solid, or the factor is none.
    """
    import numpy as np

    from amrepair.simulate.run import scale_to_fit
    from amrepair.template import load_mesh

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
    import numpy as np

    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option} is {text!r}; give {count} numbers with commas between them")
    return values


def part_pose(text: str) -> Transform:
    """`X,Y,Z,RZ`: where the part's origin stands on the bed, and its turn about Z, degrees."""
    from amrepair.frames import Transform

    return Transform.on_bed(*numbers(text, 4, "--part-pose").tolist())


APPROVALS = ("ask", "auto")
SCAN_TIMEOUT_S = 120.0

ScannerOption = Annotated[
    str | None,
    typer.Option(
        help="watch:DIR, a folder that scans are dropped in; python:FILE, a scanner of your "
        "own; probe, the printer's own probe, which touches; or simulated:FILE, of what 'gcode "
        "emulate --motion FILE' has printed."
    ),
]
ScannerPoseOption = Annotated[
    Path | None,
    typer.Option(help="File that 'amrepair calibrate' wrote; identity where left out."),
]
SoundOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="What 'amrepair calibrate --sound' learned and kept by this name; left out: "
        "learned from the job's own first clean layers.",
    ),
]
ScanTimeoutOption = Annotated[float, typer.Option(min=1.0, help="Wait for a scan.")]


def require_approval(approve: str) -> None:
    """Refuse a word of `--approve` that says neither who nor what decides.

    Raises
    ------
    InputError
        If it is none of `APPROVALS`.
    """
    if approve not in APPROVALS:
        raise InputError(f"--approve is {approve!r}; it is one of {', '.join(APPROVALS)}")


SensorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--sensor-at",
        help="X,Y,Z of the scanner, in the scan's frame, mm; may be repeated. Tells unseen from "
        "missing.",
    ),
]


UnitOption = Annotated[
    str | None,
    typer.Option(
        "--scan-unit",
        help="Of the scan's lengths (mm, cm, m, um, in), where the file does not say it: mm.",
    ),
]


CalibrationOption = Annotated[
    str | None,
    typer.Option(
        "--calibration",
        help="Name under which 'calibrate --sound' kept what this scanner leaves on sound parts.",
    ),
]


def calibration_named(name: str | None) -> Calibration | None:
    """The calibration of that name, from the user's folder; None where none was named."""
    from amrepair.regions.error_calibration import Calibration, users_folder

    return None if name is None else Calibration.load(name, users_folder())


def sensors(texts: list[str] | None) -> np.ndarray | None:
    """(k, 3) sensor positions of the option; None where it was not given."""
    import numpy as np

    if not texts:
        return None
    return np.stack([numbers(text, 3, "--sensor-at") for text in texts])


def with_settings(
    variants: dict[str, Options], texts: Sequence[str] | None, option: str
) -> Options:
    """A recipe's options, changed by `name=value` words; `variant=name` chooses where to start.

    Raises
    ------
    InputError
        If a word is no assignment, its name is unknown, or its value is of another kind.
    """
    words = []
    base = next(iter(variants.values()))
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"{option} is {text!r}; write name=value")
        if name == "variant":
            if value not in variants:
                raise InputError(
                    f"{option}: the variant {value!r} is unknown; choose {', '.join(variants)}"
                )
            base = variants[value]
        else:
            words.append((name, value))
    known = {field.name: getattr(base, field.name) for field in fields(base)}  # type: ignore[arg-type]
    changes = {}
    for name, value in words:
        if name not in known:
            raise InputError(f"{option}: there is no setting {name!r}; choose {', '.join(known)}")
        changes[name] = _value(value, known[name], f"{option} {name}")
    return replace(base, **changes)  # type: ignore[type-var]


def _value(text: str, like: object, what: str) -> object:
    """A word as the kind of value that `like` is."""
    if isinstance(like, str):
        return text
    try:
        if isinstance(like, bool):
            return _SWITCH[text.lower()]
        return int(text) if isinstance(like, int) else float(text)
    except (KeyError, ValueError) as error:
        kind = {bool: "on or off", int: "a whole number", float: "a number"}[type(like)]
        raise InputError(f"{what} is {text!r}; give {kind}") from error
