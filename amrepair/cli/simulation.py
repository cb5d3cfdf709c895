"""`amrepair simulate`: a whole run on an emulated printer."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amrepair.cli.files import refuse_traps
from amrepair.cli.live import (
    VIEW_PORT,
    HostOption,
    PortOption,
    TokenOption,
    ViewOption,
    ViewPlace,
    live_view,
)
from amrepair.cli.options import SeedOption, scaled_mesh
from amrepair.report.guarded import LOOPBACK
from gcode.cli import console
from gcode.cli.options import JsonOption, MaterialOption, PrinterOption, ProcessOption
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

if TYPE_CHECKING:
    from amrepair.frames import Transform
    from amrepair.loop import Tape
    from amrepair.policy import PolicyOptions
    from amrepair.report import ReportData
    from amrepair.report.folder import RunFolder
    from amrepair.simulate.run import PreparedRun, SimulatedRun
    from gcode.hosts.port import Printer

DEFAULT_DEFECTS = ("void", "under_extrusion", "chip")


@console.command(
    "simulate",
    "amrepair simulate",
    "amrepair simulate part.stl --defect void:diameter=8,layers=4 --defect chip "
    "--seed 3 --out out/run",
    "amrepair simulate part.stl --world world.toml --scanner laser-line",
    "amrepair simulate part.stl --printer voron_2_4 --material petg --scale fit --json",
)
def simulate(
    part: Annotated[
        Path | None,
        typer.Argument(help="STL, OBJ, 3MF or PLY, mm. Default: the bracket of the examples."),
    ] = None,
    defect: Annotated[
        list[str] | None,
        typer.Option(
            "--defect",
            help="TYPE[:key=value,…]: void, missing_beads, under_extrusion, chip, blob or none; "
            "may be repeated. "
            f"Default: {', '.join(DEFAULT_DEFECTS)}, where there is room.",
        ),
    ] = None,
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    scale: Annotated[
        str, typer.Option(help="Factor for the part, or 'fit': as large as the printer allows.")
    ] = "1",
    world: Annotated[
        Path | None,
        typer.Option(
            help="TOML with what differs from the shipped world: beads, flow, shrinkage, scanners."
        ),
    ] = None,
    scanner: Annotated[
        str,
        typer.Option(
            help="structured-light, laser-line, another of the world's file, recorded:FILE (the "
            "noise of a real scanner), or probe: the printer's own probe touches."
        ),
    ] = "structured-light",
    max_iterations: Annotated[
        int, typer.Option(min=0, max=10, help="Repairs at one stop, at most.")
    ] = 3,
    view: ViewOption = False,
    view_host: HostOption = LOOPBACK,
    view_port: PortOption = VIEW_PORT,
    token: TokenOption = None,
    seed: SeedOption = 0,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for result, G-code, scans, report.")
    ] = Path("out/simulate"),
    as_json: JsonOption = False,
) -> None:
    """Print a part on an emulated printer, break it, find what is missing and print only that."""
    refuse_traps([] if part is None else [part])
    from amrepair.simulate.defects import parse_defect
    from gcode.profiles import load_setup

    defects = [parse_defect(text) for text in defect or DEFAULT_DEFECTS]
    defects = [d for d in defects if d.kind != "none"]
    setup = load_setup(printer, material, process)
    with console.starting():  # a second: what was typed wrong is refused before
        import numpy as np

        from amrepair.cli.telling import exit_code_of
        from amrepair.loop import Approval
        from amrepair.policy import PolicyOptions
        from amrepair.repair import Stopwatch
        from amrepair.report import write_report
        from amrepair.report.folder import RunFolder
        from amrepair.scans import PROBE
        from amrepair.simulate.parameters import load_world
        from amrepair.simulate.part_files import part_path
        from amrepair.simulate.run import place_on_bed, prepare_run, simulate_run

    watch, bars = Stopwatch(), console.Bars()
    policy = PolicyOptions(most_passes=max_iterations)
    told = load_world(world)
    _ = setup.printer.feeler if scanner == PROBE else told.scanner(scanner)  # before any work
    path = part or part_path("bracket")
    mesh = scaled_mesh(path, scale, setup)
    ids = (printer, material, process)
    place_on_bed(np.asarray(mesh.bounds, dtype=np.float64), setup)  # refused before any work
    folder = RunFolder(out)
    with bars.shown():
        from amrepair.template import load_or_fit

        with watch("template"):
            template = load_or_fit(mesh, seed=seed, progress=bars)
        prepared = prepare_run(
            template, setup, defects,
            title=path.stem, where_room=not defect, seed=seed, watch=watch, progress=bars,
        )  # fmt: skip
        folder.write_text("job.gcode", prepared.checked.program.text)
        with live_view(
            ViewPlace(view, view_host, view_port, token), ask=True, title=path.name
        ) as page:
            page.show_run(prepared.job, prepared.part)

            def begun(pose: Transform, printer: Printer) -> Tape:
                page.drives(printer.pause, printer.resume)
                return _recorded(prepared, folder, pose, ids, policy, scanner=scanner)

            run = simulate_run(
                prepared,
                wire_log=folder.file("wire.log"),
                world=told,
                scanner=scanner,
                policy=policy,
                approval=Approval(page.to_print),
                record=page.recording(folder.record),
                begun=begun,
                watch=watch,
                progress=page.watching(bars),
            )
    seconds = watch.rounded_s()
    result = _result(run, folder, seed, seconds)
    result["world"] = {"file": world and str(world), "sha256": told.sha256, "scanner": scanner}
    folder.write_json("result.json", result)
    with watch("report"), bars.shown(), bars.stage("report"):
        write_report(_report_data(run, path, result), folder.file("report.html"))
    within = run.report.within_tolerance
    for why in prepared.left_out:
        console.errors.print(f"A default defect is left out: {why}.")
    if run.report.stopped:
        console.errors.print(f"The run was ended: {run.report.stopped}.")
    if as_json:
        console.show_json(result)
    else:
        _say(run, result, folder, within)
    if code := exit_code_of(run.report):
        raise typer.Exit(code)


def _recorded(
    run: PreparedRun,
    folder: RunFolder,
    pose: Transform,
    ids: tuple[str, str, str],
    policy: PolicyOptions,
    *,
    scanner: str,
) -> Tape:
    """Write down what the run begins with; the tape that it is recorded on."""
    from amrepair.loop import Tape
    from amrepair.loop.run_folder import Setting, forget, keep

    tape = Tape(folder.path)
    tape.hold(anew=True)
    forget(folder.path)
    setting = Setting.of(
        run.setup,
        ids,
        stops=run.stops,
        build_from_template=run.build_from_template,
        build_from_scanner=pose,
        by_beads=run.by_beads,
        seed=run.seed,
        policy=policy,
        scanner=scanner,
    )
    keep(folder.path, setting, run.checked.program.text, run.template)
    return tape


def _result(
    run: SimulatedRun, folder: RunFolder, seed: int, seconds: dict[str, float]
) -> dict[str, Any]:
    from amrepair.cli.telling import last_repair
    from amrepair.report.collect import loop_result, rounded

    result = loop_result(
        run.report,
        repaired_ratio=run.repaired_ratio,
        gcode=last_repair(run.report, folder),
        seed=seed,
        seconds=seconds,
        setup=run.prepared.setup,
    )
    speed = run.printer_clock_s / run.print_wall_s if run.print_wall_s > 0 else 0.0
    return {
        **result,
        "truth": rounded(
            [
                {
                    "type": t.kind,
                    "stop": t.label,
                    "missing_mm3": t.missing_mm3,
                    "filled_mm3": t.filled_mm3,
                    "excess_mm3": t.excess_mm3,
                    "added_mm3": t.added_mm3,
                    "repaired_ratio": t.filled_mm3 / t.missing_mm3 if t.missing_mm3 > 0 else None,
                }
                for t in run.truth
            ]
        ),
        "job": {
            "gcode": str(folder.file("job.gcode")),
            "lines": run.prepared.checked.program.line_count,
            "layers": len(run.prepared.job.layers),
            "printer_clock_s": round(run.printer_clock_s, 1),
            "unprintable_mm3": rounded(sum(u.volume_mm3 for u in run.prepared.plan.unprintable)),
        },
        "left_out": run.prepared.left_out,
        "speed_up": round(speed, 1),
        **({"touches": rounded([asdict(felt) for felt in run.felt])} if run.felt else {}),
    }


def _report_data(run: SimulatedRun, path: Path, result: dict[str, Any]) -> ReportData:
    from amrepair.report import TemperatureSeries, report_of_loop

    prepared = run.prepared
    clock, hotend, bed = run.temperatures.T
    return report_of_loop(
        run.report,
        result,
        title=f"Simulated run: {path.name}",
        setup=prepared.setup,
        about={
            "part": path.name,
            "defects": ", ".join(str(t.kind) for t in run.truth) or "none",
        },
        expected=prepared.part,
        temperatures=(
            TemperatureSeries("hotend", clock, hotend),
            TemperatureSeries("bed", clock, bed),
        ),
    )


def _say(run: SimulatedRun, result: dict[str, Any], folder: RunFolder, within: bool) -> None:
    from rich.table import Table

    from amrepair.report import summary_of_result

    table = Table(title=None, show_edge=False, pad_edge=False)
    for name in ("defect", "stop", "missing mm³", "filled mm³", "ratio", "elsewhere mm³"):
        table.add_column(name, justify="left" if name in {"defect", "stop"} else "right")
    for t in run.truth:
        ratio = f"{t.filled_mm3 / t.missing_mm3:.3f}" if t.missing_mm3 > 0 else "–"
        volumes = (f"{t.missing_mm3:.1f}", f"{t.filled_mm3:.1f}", ratio, f"{t.added_mm3:.1f}")
        table.add_row(t.kind, t.label, *volumes)
    if run.truth:
        console.out.print(table)
    for felt in run.felt:
        console.out.print(f"{felt.stop}: {felt.told()}.")
    console.out.print(f"Simulated {result['speed_up']:g} times as fast as the printer prints.\n")
    for line in summary_of_result(result, within_tolerance=within):
        console.out.print(line)
    console.out.print(f"Report: {folder.file('report.html')}")
