"""`amrepair align` and `amrepair detect`: look, touch nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amrepair.cli.files import read_early
from amrepair.cli.options import (
    CalibrationOption,
    SeedOption,
    SensorOption,
    UnitOption,
    calibration_named,
    sensors,
    with_settings,
)
from amrepair.errors import InputError
from gcode.cli import console
from gcode.cli.options import JsonOption

if TYPE_CHECKING:
    from amrepair.align import Registration
    from amrepair.library import Recognition
    from amrepair.regions import AnomalyMap
    from amrepair.repair import Stopwatch
    from amrepair.report.folder import RunFolder
    from amrepair.scans import Scan
    from amrepair.template.port import Template

_POINT_COLOURS = ((180, 180, 180), (0, 90, 200), (220, 120, 0))  # ok, missing, excess

TemplateOption = Annotated[
    Path,
    typer.Option(
        "--template", help="Template file, or the part's mesh, or a folder of them to choose from."
    ),
]

KnownOption = Annotated[
    bool,
    typer.Option(
        "--part-is-known",
        help="The scan shows this part, however bent: less of it has to fit.",
    ),
]


@console.command(
    "align",
    "amrepair align scan.ply --template part.safetensors",
    "amrepair align scan.ply --template part.stl -o aligned.ply --json",
)
def align(
    scan: Annotated[Path, typer.Argument(help="Point cloud, height map or scanned mesh, mm.")],
    template: TemplateOption,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The scan in the template's frame (.ply).")
    ] = None,
    method: Annotated[str, typer.Option(help="robust, or paper (PAM).")] = "robust",
    pam: Annotated[
        list[str] | None,
        typer.Option(
            help="Setting of the method paper, name=value; variant=code is the released code, "
            "ransac=off, icp=off or iterate=off an ablation. May be repeated."
        ),
    ] = None,
    part_is_known: KnownOption = False,
    sensor_at: SensorOption = None,
    scan_unit: UnitOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Find where a scan lies in its template."""
    if output is not None and output.suffix.lower() != ".ply":
        raise InputError(f"{output}: an aligned scan is written as .ply; rename it")
    if output is not None:
        console.writable(output)
    if pam and method != "paper":
        raise InputError(f"--pam belongs to --method paper, the method is {method}")
    _refuse_known_of_many(part_is_known, template)
    bars = console.Bars()
    cloud = read_early(scan, "scanner", sensors(sensor_at), scan_unit, bars)
    with console.starting():
        import numpy as np

        from amrepair.align.options import DEFAULT_ALIGN, PAM_VARIANTS
        from amrepair.repair import Stopwatch
        from amrepair.scans import write_ply

    settings = with_settings(PAM_VARIANTS, pam, "--pam")
    watch = Stopwatch()
    with bars.shown():
        _, found, chosen = _laid(
            cloud, template, method, seed, watch, bars,
            part_is_known=part_is_known, options=replace(DEFAULT_ALIGN, paper=settings),
        )  # fmt: skip
        if output is not None:
            moved = cloud.moved(found.template_from_scan)
            with bars.stage("write"):
                console.write_whole(output, lambda path: write_ply(moved, path))
    # Other programs take the pose as input, so that it keeps all digits.
    result: dict[str, Any] = {
        **found.to_json(),
        "covariance": found.covariance.tolist(),
        "method": found.method,
        "iterations": found.iterations,
        "seconds": round(watch.seconds["align"], 3),
        **chosen,
    }
    if as_json:
        console.show_json(result)
        return
    if chosen:
        console.out.print(f"Part: {chosen['template']}, confidence {chosen['confidence']:.2f}.")
    _say_clutter(found)
    console.out.print(
        f"Aligned: {found.rmse_mm:.3f} mm rms over {found.inlier_ratio:.1%} of the points, "
        f"{len(found.symmetric_alternatives)} other poses fit as well."
    )
    console.out.print(np.array2string(found.template_from_scan.matrix, precision=6))


def _laid(
    cloud: Scan,
    template: Path,
    method: str,
    seed: int,
    watch: Stopwatch,
    bars: console.Bars,
    **how: Any,
) -> tuple[Template, Registration, dict[str, Any]]:
    """The template, or the one of a folder that a scan shows; where the scan lies; the choice."""
    import numpy as np

    from amrepair.align import align
    from amrepair.template import open_template

    if template.is_dir():
        known = from_library(cloud, template, method, seed, watch, bars)
        return known.template, known.registration, chosen_part(known)
    field, rng = open_template(template, progress=bars), np.random.default_rng(seed)
    with watch("align"):
        return field, align(cloud, field, method=method, rng=rng, progress=bars, **how), {}


def _say_clutter(found: Registration) -> None:
    if found.clutter_ratio > 0.0:
        console.out.print(
            f"{found.clutter_ratio:.0%} of the scan is not the part (scattered points, what it "
            "stands on, other pieces) and was left aside."
        )


def _refuse_known_of_many(part_is_known: bool, template: Path) -> None:
    if part_is_known and template.is_dir():
        raise InputError(f"--part-is-known needs one template; {template} is a folder of them")


def from_library(
    cloud: Scan, folder: Path, method: str, seed: int, watch: Stopwatch, bars: console.Bars
) -> Recognition:
    """The part of a folder that a scan shows, aligned."""
    from amrepair.library import recognise, template_files
    from amrepair.template import open_template

    parts = [(path.stem, partial(open_template, path)) for path in template_files(folder)]
    with watch("align"):
        return recognise(cloud, parts, method=method, seed=seed, progress=bars)


def chosen_part(known: Recognition) -> dict[str, Any]:
    """A choice of a part, as results record it."""
    return {
        "template": known.name,
        "confidence": round(known.confidence, 4),
        "candidates": {c.name: round(c.misfit_ratio, 4) for c in known.candidates},
    }


@console.command(
    "detect",
    "amrepair detect scan.ply --template part.safetensors --out out/detect",
    "amrepair detect scan.ply --template part.stl --sensor-at 120,100,400 --out out/detect --json",
)
def detect(
    scan: Annotated[Path, typer.Argument(help="Point cloud, height map or scanned mesh, mm.")],
    template: TemplateOption,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for anomaly.npz, anomaly.ply, result.json.")
    ],
    part_is_known: KnownOption = False,
    sensor_at: SensorOption = None,
    scan_unit: UnitOption = None,
    calibration: CalibrationOption = None,
    smallest_mm: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Depth of the smallest defect that matters: refuse a scan too noisy."
        ),
    ] = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Align a scan and say what is missing and what is too much."""
    _refuse_known_of_many(part_is_known, template)
    bars = console.Bars()
    cloud = read_early(scan, "scanner", sensors(sensor_at), scan_unit, bars)
    known_errors = calibration_named(calibration)
    with console.starting():
        import numpy as np

        from amrepair.deficit import compute_deficit, measured_regions
        from amrepair.deficit.options import DEFAULT_DEFICIT
        from amrepair.frames import Transform
        from amrepair.regions import detect as detect_defects
        from amrepair.repair import Stopwatch
        from amrepair.repair.other_part import refuse_other_part
        from amrepair.report.collect import rounded
        from amrepair.report.folder import RunFolder

    watch = Stopwatch()
    with bars.shown():
        folder = RunFolder(out)
        field, found, chosen = _laid(
            cloud, template, "robust", seed, watch, bars, part_is_known=part_is_known
        )
        placed = cloud.moved(found.template_from_scan)
        with watch("detect"):
            anomaly = detect_defects(placed, field, calibration=known_errors, progress=bars)
        _refuse_too_noisy(anomaly, smallest_mm, scan)
        if not part_is_known:
            refuse_other_part(anomaly, field, cloud.source)
        with watch("measure"):
            in_place = Transform.identity("build", "template")
            solids = replace(DEFAULT_DEFICIT, early_mm3=np.inf)  # nobody asks what stands there
            deficit = compute_deficit(
                placed, field, anomaly, build_from_template=in_place, options=solids, progress=bars
            )
            regions = measured_regions(anomaly, deficit)
        with bars.stage("write"):
            _keep(folder, cloud, anomaly)
    result = {
        "object_score": anomaly.object_score,
        "threshold": anomaly.threshold_mm,
        "threshold_source": anomaly.threshold_source,
        "regions": [
            {
                "label": region.label.name.lower(),
                "type": str(region.type),
                "volume_mm3": region.volume_mm3,
                "area_mm2": region.area_mm2,
                "depth_mm": region.depth_mm,
                "box_mm": region.box_mm,
                "p_value": None if np.isnan(region.p_value) else region.p_value,
            }
            for region in regions
        ],
        **_told(anomaly, calibration),
        **found.to_json(),
        "seconds": watch.rounded_s(),
        **chosen,
    }
    result = dict(rounded(result))
    folder.write_json("result.json", result)
    if as_json:
        console.show_json(result)
        return
    if chosen:
        console.out.print(f"Part: {chosen['template']}, confidence {chosen['confidence']:.2f}.")
    _say_clutter(found)
    if others := len(found.symmetric_alternatives):
        console.out.print(
            f"{1 + others} poses fit equally well: of a part that is not symmetric the regions may "
            "lie at another of them; scan more of it, or give the sensors' places (--sensor-at)."
        )
    count = len(regions)
    console.out.print(
        f"{count} {'region' if count == 1 else 'regions'} beyond {anomaly.threshold_mm:.3f} mm "
        f"({anomaly.threshold_source}); object score {anomaly.object_score:.3f} mm."
    )
    for sentence in anomaly.told():
        console.out.print(sentence)
    for region in regions:
        console.out.print(
            f"  {region.label.name.lower()} {region.type}: {region.volume_mm3:.1f} mm³, "
            f"{region.depth_mm:.2f} mm deep"
        )


def _told(anomaly: AnomalyMap, calibration: str | None) -> dict[str, Any]:
    """What a result says beside its regions: noise, what belongs to the whole part, settings."""
    from dataclasses import asdict

    assert anomaly.noise is not None
    assert anomaly.options is not None
    return {
        "noise": anomaly.noise.to_json(),
        "nuisance": None if anomaly.nuisance is None else anomaly.nuisance.to_json(),
        "contradicting_views": [one.to_json() for one in anomaly.contradicting],
        "told": list(anomaly.told()),
        "options": asdict(anomaly.options),
        "calibration": calibration,
    }


def _refuse_too_noisy(anomaly: AnomalyMap, smallest_mm: float | None, scan: Path) -> None:
    """Refuse a scan that cannot show the smallest defect asked for."""
    assert anomaly.noise is not None
    if smallest_mm is not None and anomaly.noise.too_sparse:
        raise InputError(f"{scan}: {anomaly.noise.told_sparse()}")
    area_mm2, depth_mm = min(anomaly.noise.smallest_mm, key=lambda pair: pair[1])
    if smallest_mm is not None and depth_mm > smallest_mm:
        raise InputError(
            f"{scan}: the smallest defect that this scan could show is {depth_mm:.2f} mm deep over "
            f"{area_mm2:.0f} mm², and {smallest_mm:g} mm was asked for; scan more finely or from "
            "more sides"
        )


def _keep(folder: RunFolder, cloud: Scan, anomaly: AnomalyMap) -> None:
    """The anomaly map as arrays, and as a coloured cloud."""
    import numpy as np

    from amrepair.scans import write_ply

    console.write_whole(
        folder.file("anomaly.npz"),
        lambda path: np.savez(  # deflate saves a tenth of the size, in half a second
            path,
            points_mm=cloud.points_mm,
            deviation_mm=anomaly.deviation_mm,
            score=anomaly.score,
            label=anomaly.label,
            template_points_mm=anomaly.template_points_mm,
            template_label=anomaly.template_label,
        ),
    )
    console.write_whole(
        folder.file("anomaly.ply"),
        lambda path: write_ply(
            cloud,
            path,
            colours=np.array(_POINT_COLOURS)[anomaly.label],
            scalars={"deviation": anomaly.deviation_mm, "label": anomaly.label},
        ),
    )
