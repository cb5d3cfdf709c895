"""`amrepair template fit` and `amrepair template mesh`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amrepair.cli.files import refuse_traps, sort_inputs, write_mesh
from amrepair.cli.options import SeedOption, UnitOption, sensors, with_settings
from amrepair.errors import InputError
from gcode.cli import console
from gcode.cli.options import JsonOption

if TYPE_CHECKING:
    import numpy as np

    from amrepair.merge import ScanFit, SoundFit
    from amrepair.scans import Scan
    from amrepair.template import GridSdf, PaperSdf


@console.command(
    "fit",
    "amrepair template fit part.stl -o part.safetensors",
    "amrepair template fit part.3mf -o part.safetensors --device cpu --seed 1",
    "amrepair template fit part.stl sound*.ply -o part.safetensors",
    "amrepair template fit view*.ply -o part.safetensors --sensor-at 0,0,400",
    "amrepair template fit view*.ply -o part.safetensors --poses poses.json --json",
    "amrepair template fit turn*.ply -o part.safetensors --turntable 36",
)
def fit(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            help="A mesh of the part as it should be, or sound scans of it, or both: then the "
            "mesh's field learns what sound parts leave on it; mm."
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Template file (.safetensors).")],
    recipe: Annotated[str, typer.Option(help="fast, or paper for the published network.")] = "fast",
    paper: Annotated[
        list[str] | None,
        typer.Option(
            help="Setting of the recipe paper, name=value; variant=code is the released code, "
            "encoding=off an ablation, epochs=N shortens it. May be repeated."
        ),
    ] = None,
    device: Annotated[
        str, typer.Option(help="Where the recipe paper trains: auto, cpu or cuda.")
    ] = "auto",
    sensor_at: Annotated[
        list[str] | None,
        typer.Option(
            "--sensor-at",
            help="X,Y,Z of the scanner in the scans' frames, mm: once for all scans (a turntable "
            "before a fixed scanner), or once for each, in their order. Partial views need it to "
            "find each other surely; PLY and PCD files may carry it.",
        ),
    ] = None,
    scan_unit: UnitOption = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Where the scans stand: .conf (Stanford), .aln (MeshLab) or .json (file name to "
            "4×4). A poses.json beside the scans is taken unasked. The scans decide: poses that "
            "do not fit are found anew."
        ),
    ] = None,
    turntable: Annotated[
        float | None,
        typer.Option(help="The scans are a turntable's, in their order, so many degrees apart."),
    ] = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Fit the signed distance field that scans are held against."""
    refuse_traps(inputs)
    with console.starting():
        from amrepair.merge import fit_mesh
        from amrepair.template import fit_template
        from amrepair.template.paper import NETWORK_VARIANTS

    if paper and recipe != "paper":
        raise InputError(f"--paper belongs to --recipe paper, the recipe is {recipe}")
    settings = with_settings(NETWORK_VARIANTS, paper, "--paper")
    if output.suffix != ".safetensors":
        raise InputError(f"{output}: a template is written as .safetensors; rename it")
    console.writable(output)
    bars = console.Bars()
    meshes, scans = sort_inputs(inputs)
    words = (sensor_at, "sensor-at"), (scan_unit, "scan-unit"), (poses, "poses")
    for given, option in (*words, (turntable, "turntable")):
        if given and not scans:
            raise InputError(f"--{option} belongs to scans, only meshes are given")
    if scans and recipe == "paper" and not meshes:
        raise InputError("the recipe paper needs a mesh; fit the scans with --recipe fast")
    template: GridSdf | PaperSdf
    told: dict[str, Any] = {}
    with bars.shown():
        if scans and recipe == "fast":
            with bars.stage("read scans"):
                clouds = _clouds(scans, sensors(sensor_at), scan_unit)
            made = _from_scans(clouds, scans, meshes, poses, turntable, seed, bars)
            template, told = made.template, made.as_json([str(path) for path in scans])
        elif recipe == "fast" and len(meshes) == 1:
            template = fit_mesh(meshes[0], seed=seed, progress=bars)
        else:
            template = fit_template(
                meshes, recipe=recipe, paper=settings, device=device, seed=seed, progress=bars
            )
    template.save(output)
    notes = [note for note in template.metadata.get("notes", "").split("; ") if note]
    if as_json:
        console.show_json(
            {"template": str(output), "bias_mm": template.bias_mm, "notes": notes, **told}
        )
        return
    console.errors.print(f"{output}: surface good to {template.bias_mm:.3f} mm (99 %)")
    for note in notes:
        console.errors.print(f"  {note}")


def _clouds(scans: list[Path], places: np.ndarray | None, unit: str | None) -> list[Scan]:
    import numpy as np

    from amrepair.scans import read_scan

    if places is not None and len(places) not in (1, len(scans)):
        raise InputError(
            f"--sensor-at is given {len(places)} times for {len(scans)} scans; give it once, or "
            "once for each"
        )
    each = [None] * len(scans) if places is None else np.broadcast_to(places, (len(scans), 3))
    return [
        read_scan(path, frame="scanner", sensor_at=place, unit=unit)
        for path, place in zip(scans, each, strict=True)
    ]


def _from_scans(
    clouds: list[Scan],
    scans: list[Path],
    meshes: list[Path],
    poses: Path | None,
    turntable_deg: float | None,
    seed: int,
    bars: console.Bars,
) -> ScanFit | SoundFit:
    from amrepair.merge import fit_from_scans, learn_from_scans
    from amrepair.merge.told import POSES_FILE, read_poses
    from amrepair.template import load_mesh

    if len(meshes) > 1:
        raise InputError(f"a template has one nominal mesh, {len(meshes)} were given")
    if meshes:
        for given, option in ((poses, "poses"), (turntable_deg, "turntable")):
            if given is not None:
                raise InputError(f"--{option} belongs to scans without a mesh; leave one out")
        return learn_from_scans(clouds, load_mesh(meshes[0]), seed=seed, progress=bars)
    if poses is not None and turntable_deg is not None:
        raise InputError("--poses and --turntable both say where the scans stand; give one")
    beside = scans[0].parent / POSES_FILE
    if poses is None and turntable_deg is None and beside.is_file():
        poses = beside
    return fit_from_scans(
        clouds,
        poses=None if poses is None else read_poses(poses),
        turntable_deg=turntable_deg,
        seed=seed,
        progress=bars,
    )


@console.command(
    "mesh",
    "amrepair template mesh part.safetensors -o part.stl",
    "amrepair template mesh part.safetensors -o half.stl --below-z-mm 12 --voxel-mm 0.15",
)
def mesh(
    file: Annotated[Path, typer.Argument(help="Template file.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="STL, OBJ, PLY or 3MF to write.")],
    level_mm: Annotated[float, typer.Option(help="Level of the field, mm.")] = 0.0,
    voxel_mm: Annotated[float, typer.Option(help="Edge of a voxel, mm.")] = 0.2,
    below_z_mm: Annotated[
        float | None, typer.Option(help="Only what is printed up to this height.")
    ] = None,
) -> None:
    """Extract the template's surface as a closed mesh."""
    with console.starting():
        from amrepair.template import CutTemplate, extract_mesh, open_template

    console.writable(output)
    bars = console.Bars()
    with bars.shown():
        template = open_template(file, progress=bars)
        cut = template if below_z_mm is None else CutTemplate(template, below_z_mm)
        with bars.stage("extract"):
            made = extract_mesh(cut, voxel_mm, level_mm=level_mm)
            write_mesh(made, output)
    size = " × ".join(f"{mm:.1f}" for mm in made.extents)
    console.out.print(
        f"{output}: {len(made.faces):,} triangles, {size} mm, {made.volume:,.0f} mm³, closed"
    )
