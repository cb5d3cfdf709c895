"""`amrepair replay`: the decisions of a recorded run, made again from its scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcode.cli import console
from gcode.cli.options import JsonOption

if TYPE_CHECKING:
    from amrepair.loop.replay import Replayed

DIFFERENT = 1


@console.command(
    "replay",
    "amrepair replay out/demo",
    "amrepair replay out/loop --json",
    "amrepair replay out/loop --rule least_mm3=2.5 --rule sure=0.95",
)
def replay_command(
    run: Annotated[Path, typer.Argument(help="Folder of a run of 'loop' or 'simulate'.")],
    rule: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=VALUE of a number of the policy (see 'amrepair doctor --options'): the "
            "recorded facts are judged by it, and no scan is read; may be repeated."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Decide again from the recorded scans: exit 0 if all is the same, 1 if something differs."""
    with console.starting():
        from amrepair.loop.replay import decide_again, replay

    bars = console.Bars()
    with bars.shown():
        looks = decide_again(run, rule) if rule else replay(run, progress=bars)
    same = not any(look.differences for look in looks)
    if as_json:
        console.show_json(
            {
                "same": same,
                "looks": [
                    {
                        "look": look.look,
                        "stop": look.stop,
                        "decision": look.then["action"],
                        "row": look.then["row"],
                        "differences": list(look.differences),
                    }
                    for look in looks
                ],
            }
        )
    else:
        for look in looks:
            console.out.print(_words(look))
        count = sum(bool(look.differences) for look in looks)
        console.out.print(
            f"{len(looks)} looks, all decided as they were."
            if same
            else f"{count} of {len(looks)} looks are decided differently."
        )
    if not same:
        raise typer.Exit(DIFFERENT)


def _words(look: Replayed) -> str:
    head = f"{look.look}  {look.stop}: {look.then['action']} ({look.then['row']})"
    if not look.differences:
        return f"{head}: the same"
    return "\n".join([f"{head}: DIFFERENT", *(f"     {text}" for text in look.differences)])
