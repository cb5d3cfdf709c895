"""What `amrepair calibrate --sound` does: learn from sound parts what a scanner leaves on them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from amrepair.align import align
from amrepair.errors import InputError
from amrepair.regions import Region, detect
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
    doubtful: list[str] = []
    with bars.shown():
        field = open_template(template, progress=bars)
        for path in sound:
            with bars.stage(f"read {path.name}"):
                cloud = read_scan(path, frame="scanner", unit=scan_unit)
            pose = align(cloud, field, rng=np.random.default_rng(seed), progress=bars)
            with bars.stage(f"look at {path.name}"):
                anomaly = detect(cloud.moved(pose.template_from_scan), field)
            seen.append(judged_scales(anomaly))
            if (doubt := why_perhaps_not_sound(path.name, anomaly.regions)) is not None:
                doubtful.append(doubt)
    found = calibrated(name, seen, RegionOptions())
    kept = found.save(folder)
    for doubt in doubtful:
        console.errors.print(f"warning: {doubt}.")
    if as_json:
        console.show_json({**asdict(found), "file": str(kept), "warnings": doubtful})
        return
    widths = ", ".join(
        f"{wander[0]:.3f} mm over {width:g} mm"
        for width, wander in zip(found.width_mm, found.wander_mm, strict=True)
    )
    plural = "scan" if len(sound) == 1 else "scans"
    console.out.print(
        f"{kept}: from {len(sound)} sound {plural}; local means wander by {widths} where they are "
        f"well seen. Use it with --calibration {shlex.quote(name)}."
    )


def why_perhaps_not_sound(name: str, regions: Sequence[Region]) -> str | None:
    """One sentence where a scan that is said to be of a sound part shows defects; else None."""
    if not regions:
        return None
    deepest = max(regions, key=lambda region: region.depth_mm)
    number = "a region" if len(regions) == 1 else f"{len(regions)} regions"
    return (
        f"{name} shows {number} that would be told as missing or too much, the deepest "
        f"{deepest.label.name.lower()}, by {deepest.depth_mm:.2f} mm: all of this is now taken "
        "for the scanner's own and no longer told of other scans; if the part is not sound, scan "
        "one that is, and calibrate by the same name again"
    )
