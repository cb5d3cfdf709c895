"""`amrepair bench` and `amrepair synth`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from amrepair.cli.options import SeedOption, with_settings
from gcode.cli import console

METHOD_HELP = (
    "pasdf (ours), pasdf-paper, btf-raw, btf-fpfh, patchcore-fpfh, patchcore-fpfh-raw, "
    "patchcore-pointmae or patchcore-pointbert; but for the first two also with +pam, aligned "
    "first. May be repeated."
)
FormatOption = Annotated[
    str,
    typer.Option(
        "--format",
        help="anomaly-shapenet, real3d-ad, 3d-adam, or folder for scans of your own. A folder that "
        "is not there is answered with where to get the data set.",
    ),
]
WrittenOption = Annotated[str, typer.Option("--format", help="anomaly-shapenet or real3d-ad.")]


@console.command(
    "bench",
    "amrepair bench out/synth --format anomaly-shapenet --method pasdf --out out/bench",
    "amrepair bench out/synth --format anomaly-shapenet --method pasdf "
    "--method btf-fpfh --out out/bench --jobs 2",
    "amrepair bench my-scans --format folder --method pasdf --out out/mine",
)
def bench(
    dataset: Annotated[Path, typer.Argument(help="Folder of the data set.")],
    layout: FormatOption,
    method: Annotated[list[str], typer.Option("--method", help=METHOD_HELP)],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder for the results; gone on with if it has some."),
    ],
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    checkpoint: Annotated[
        Path | None, typer.Option(help="Pretrained weights, for the methods that need them.")
    ] = None,
    paper: Annotated[
        list[str] | None,
        typer.Option(
            help="Setting of pasdf-paper's recipe, name=value; variant=paper is the published "
            "schedule, more than an hour a class. May be repeated."
        ),
    ] = None,
) -> None:
    """Compare methods on a data set."""
    with console.starting():
        from amrepair.bench.paper import BENCH_PAPER
        from amrepair.bench.runner import run_bench
        from amrepair.bench.tables import in_short
        from amrepair.template.paper import NETWORK_VARIANTS

    recipe = with_settings({"bench": BENCH_PAPER, **NETWORK_VARIANTS}, paper, "--paper")
    bars = console.Bars()
    with bars.shown():
        report = run_bench(
            dataset,
            format=layout,
            methods=method,
            out=out,
            jobs=jobs,
            checkpoint=checkpoint,
            paper=recipe,
            progress=bars,
        )
    console.out.print(in_short(report.rows))
    console.out.print(f"Results: {report.markdown_path}")


@console.command(
    "synth",
    "amrepair synth examples/parts/knob.stl --format anomaly-shapenet --out out/synth",
    "amrepair synth one.stl two.stl --format real3d-ad --seed 7 --out out/synth",
    "amrepair synth part.stl --format anomaly-shapenet --smallest 0.01 --smooth 0.5 --out out/hard",
)
def synth(
    parts: Annotated[list[Path], typer.Argument(help="Meshes; each becomes a class.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the data set.")],
    layout: WrittenOption,
    seed: SeedOption = 0,
    smallest: Annotated[
        float | None,
        typer.Option(
            help="Width of the smallest defects, share of the part's diagonal (0.01 to 0.08); "
            "without it, those of the published sets."
        ),
    ] = None,
    smooth: Annotated[
        float, typer.Option(help="Share of bulges and concavities without an edge (0 to 1).")
    ] = 0.0,
) -> None:
    """Make a data set with labelled defects from meshes."""
    with console.starting():
        from amrepair.bench.synth import SynthOptions, synthesize

    options = SynthOptions(smallest_ratio=smallest, smooth_ratio=smooth)
    bars = console.Bars()
    with bars.shown():
        made = synthesize(parts, out, layout, seed, options=options, progress=bars)
    console.out.print(f"Data set: {made}")
