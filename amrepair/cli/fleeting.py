"""`amrepair fleet`: many printers under one supervisor."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amrepair.cli.live import HostOption, PortOption, TokenOption
from amrepair.errors import LoopError
from amrepair.report.guarded import LOOPBACK
from gcode.cli import console

if TYPE_CHECKING:
    from amrepair.fleet.history import History
    from amrepair.fleet.supervisor import Fleet

FLEET_PORT = 8643
STEP_S = 0.25
LAST_LOOK_S = 1.5  # an open page asks every second, and is to show how it ended


@console.command(
    "fleet", "amrepair fleet fleet.toml", "amrepair fleet fleet.toml --view-port 9000 --until-done"
)
def fleet(
    file: Annotated[
        Path, typer.Argument(metavar="FLEET", help="File that names printers and their jobs.")
    ],
    until_done: Annotated[
        bool, typer.Option("--until-done", help="End when no printer prints any more.")
    ] = False,
    view_host: HostOption = LOOPBACK,
    view_port: PortOption = FLEET_PORT,
    token: TokenOption = None,
) -> None:
    """Print on many printers, each in a process of its own, with one page for all."""
    with console.starting():
        from amrepair.fleet.config import read_config
        from amrepair.fleet.history import History
        from amrepair.fleet.page import Page
        from amrepair.fleet.supervisor import Fleet, RunState

    config = read_config(file)
    crew = Fleet(config)
    with crew.alone():
        history = History(config.options.out / "history.sqlite")
        page = Page(crew, history, host=view_host, port=view_port, token=token)
        console.errors.print(f"Open {page.url} (Ctrl+C ends all runs safely)")
        try:
            _watch(crew, history, until_done=until_done)
        finally:
            console.errors.print("Ending all runs: nozzles lifted, heaters off.")
            crew.end()
            _remember(crew, history, {})
            page.close()
            history.close()
    for row in crew.told():
        console.out.print(
            f"{row['name']}: {row['state']}{': ' if row['sentence'] else ''}{row['sentence']}"
        )
    if any(row["state"] == RunState.FAILED for row in crew.told()):
        raise typer.Exit(LoopError.exit_code)
    if any(row["state"] != RunState.DONE for row in crew.told()):
        raise typer.Exit(console.NOT_WITHIN_TOLERANCE)


def _watch(crew: Fleet, history: History, *, until_done: bool) -> None:
    """Step until it is over, or somebody interrupts."""
    told: dict[str, str] = {}
    kept: dict[str, object] = {}
    while True:
        crew.step()
        for row in crew.told():
            if told.get(row["name"]) != row["state"]:
                told[row["name"]] = row["state"]
                console.errors.print(
                    f"{row['name']}: {row['state']}. {row['sentence']}".rstrip(". ") + "."
                )
        while crew.notes:
            console.errors.print(crew.notes.pop(0))
        _remember(crew, history, kept)
        if until_done and crew.over:
            time.sleep(LAST_LOOK_S)
            return
        time.sleep(STEP_S)


def _remember(crew: Fleet, history: History, kept: dict[str, object]) -> None:
    """Put what runs have recorded since into the history."""
    from amrepair.loop.tape import TAPE

    for row in crew.told():
        tape = Path(row["folder"]) / TAPE
        now = (tape.stat().st_size if tape.exists() else 0, row["state"])
        if kept.get(row["name"]) != now:
            history.take(row["name"], row["part"], Path(row["folder"]), row["state"])
            kept[row["name"]] = now
