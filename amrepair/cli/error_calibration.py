"""What `amrepair calibrate --sound` does: learn from sound parts what a scanner leaves on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from amrepair.align import align
from amrepair.errors import InputError
from amrepair.regions import detect
from amrepair.regions.detection import judged_scales
from amrepair.regions.error_calibration import file_of, users_folder
from amrepair.regions.error_calibration_fit import Sound, calibrated
from amrepair.regions.options import RegionOptions
from amrepair.scans import read_scan
from amrepair.template import open_template
from gcode.cli import console


def run(
    sound: Sequence[Path],
    template: Path | None,
    name: str | None,
    *,
    scan_unit: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Lay each scan in the template, look at its errors, keep what they have in common."""
    if template is None or name is None:
        raise InputError(
            "--sound wants --template FILE and --name NAME: what was scanned, and how "
            "the calibration is to be called"
        )
    folder = users_folder()
    file_of(name, folder)
    bars = console.Bars()
    seen: list[Sound] = []
    with bars.shown():
        field = open_template(template, progress=bars)
        for path in sound:
            with bars.stage(f"read {path.name}"):
                cloud = read_scan(path, frame="scanner", unit=scan_unit)
            pose = align(cloud, field, rng=np.random.default_rng(seed), progress=bars)
            with bars.stage(f"look at {path.name}"):
                seen.append(judged_scales(detect(cloud.moved(pose.template_from_scan), field)))
    found = calibrated(name, seen, RegionOptions())
    kept = found.save(folder)
    if as_json:
        console.show_json({**asdict(found), "file": str(kept)})
        return
    widths = ", ".join(
        f"{wander[0]:.3f} mm over {width:g} mm"
        for width, wander in zip(found.width_mm, found.wander_mm, strict=True)
    )
    plural = "scan" if len(sound) == 1 else "scans"
    console.out.print(
        f"{kept}: from {len(sound)} sound {plural}; local means wander by {widths} where they are "
        f"well seen. Use it with --calibration {name}."
    )
