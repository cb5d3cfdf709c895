"""`amrepair agent`: beside a printer's own server, look at what it prints and repair it."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amrepair.cli.live import (
    VIEW_PORT,
    HostOption,
    PortOption,
    TokenOption,
    ViewOption,
    ViewPlace,
)
from amrepair.cli.options import (
    SCAN_TIMEOUT_S,
    ScannerOption,
    ScannerPoseOption,
    ScanTimeoutOption,
    SeedOption,
    SoundOption,
    calibration_named,
    require_approval,
)
from amrepair.errors import InputError
from amrepair.report.guarded import LOOPBACK
from gcode.cli import console
from gcode.cli.options import ProcessOption
from gcode.cli.owning import JobMaterialOption, JobPrinterOption
from gcode.profiles import DEFAULT_PROCESS

if TYPE_CHECKING:
    from gcode.hosts.secret import ApiKey
    from gcode.hosts.web import Address


@console.command(
    "agent",
    "amrepair agent --macros amrepair.cfg",
    "amrepair agent --moonraker http://127.0.0.1:7125 --template part.stl --scanner watch:scans",
    "amrepair agent --octoprint http://octopi.local --api-key-file octoprint.key "
    "--template parts --scanner watch:scans",
    "amrepair agent --unit amrepair-agent.service",
)
def agent(
    moonraker: Annotated[
        str | None, typer.Option(metavar="URL", help="The printer's Moonraker: http://HOST:PORT.")
    ] = None,
    octoprint: Annotated[
        str | None,
        typer.Option(metavar="URL", help="The printer's OctoPrint, with our plugin in it."),
    ] = None,
    api_key_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The server's API key, in a file that only its owner can read; else from "
            "OCTOPRINT_API_KEY or MOONRAKER_API_KEY.",
        ),
    ] = None,
    template: Annotated[
        Path | None,
        typer.Option(
            help="The part: a fitted template or a mesh; or a folder of them, where each job finds "
            "the one whose name its own begins with."
        ),
    ] = None,
    scanner: ScannerOption = None,
    printer: JobPrinterOption = None,
    material: JobMaterialOption = None,
    process: ProcessOption = DEFAULT_PROCESS,
    approve: Annotated[
        str,
        typer.Option(
            help="ask on the printer's screens before every repair, or auto: within the limits "
            "that the process profile sets."
        ),
    ] = "ask",
    calibration: ScannerPoseOption = None,
    sound: SoundOption = None,
    scan_timeout_s: ScanTimeoutOption = SCAN_TIMEOUT_S,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o",
            help="Folder for the runs, one a print; a run begun there is gone on with.",
        ),
    ] = Path("out/agent"),
    pose_confirmed: Annotated[
        bool,
        typer.Option(
            "--pose-confirmed",
            help="The run that is gone on with: a scan has shown that the part stands where it "
            "stood.",
        ),
    ] = False,
    once: Annotated[
        bool,
        typer.Option("--once", help="End after one print, with the exit code of a loop: 0 done, 2 "
                     "not looked at, 3 not within tolerance, 4 its looks were ended."),
    ] = False,
    macros: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the printer's macros, to be included in "
                     "printer.cfg, and end; - prints them."),
    ] = None,
    unit: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a systemd unit for the agent, and end; - prints "
                     "it."),
    ] = None,
    view: ViewOption = False,
    view_host: HostOption = LOOPBACK,
    view_port: PortOption = VIEW_PORT,
    token: TokenOption = None,
    seed: SeedOption = 0,
) -> None:  # fmt: skip
    """Look at a printer's prints where their jobs are marked, repair them, and let them go on.

    The jobs are begun as ever, from Mainsail, Fluidd, OctoPrint or the printer's screen.
    """
    if macros is not None or unit is not None:
        _hand_out(macros, unit)
        return
    require_approval(approve)
    for name, value in {"--template": template, "--scanner": scanner}.items():
        if value is None:
            raise InputError(f"{name} is missing; see 'amrepair agent --help'")
    with console.starting():
        from amrepair.cli import serving

    address, key = _server(moonraker, octoprint, api_key_file)
    errors = calibration_named(sound)
    code = serving.serve(
        serving.Served(
            address, key, Path(str(template)), out, (printer, material, process), calibration,
            ViewPlace(view or octoprint is not None, view_host, view_port, token), once=once,
            pose_confirmed=pose_confirmed,
            said={
                "scanner": scanner, "approve": approve, "scan_timeout_s": scan_timeout_s,
                "sound": () if errors is None else astuple(errors), "seed": seed,
            },
        )
    )  # fmt: skip
    if code:
        raise typer.Exit(code)


def _server(
    moonraker: str | None, octoprint: str | None, key_file: Path | None
) -> tuple[Address, ApiKey]:
    """The one server that was named, and its key."""
    from gcode.hosts.secret import find_key, key_in
    from gcode.hosts.web import Address

    named = {"moonraker": moonraker, "octoprint": octoprint}
    given = [f"{kind}+{url}" for kind, url in named.items() if url is not None]
    if len(given) != 1:
        raise InputError("name one server, by --moonraker or --octoprint")
    kind, _, url = given[0].partition("+")
    if not url.startswith(("http://", "https://")):
        raise InputError(f"--{kind} is {url!r}; write it as http://HOST:PORT")
    address = Address.parse(given[0])
    if key_file is not None:
        return address, key_in(key_file)
    return address, find_key(address.kind, address.spec)


def _hand_out(macros: Path | None, unit: Path | None) -> None:
    """Write or print files that come with the agent."""
    from amrepair.agent.shipped import MACROS, UNIT, shipped

    for path, name in ((macros, MACROS), (unit, UNIT)):
        if path is None:
            continue
        if str(path) == "-":
            console.out.print(shipped(name), end="", highlight=False, soft_wrap=True)
            continue
        console.write_text(path, shipped(name))
        console.errors.print(f"{path} is written; it says at its head where it belongs.")
