"""Help and completion: every command has examples that would run, and a shell can complete it."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
import typer
from typer.testing import CliRunner

from amrepair.cli.app import app as amrepair_app
from gcode.cli.app import app as gcode_app

ROOT = Path(__file__).parents[2]
APPS = {"amrepair": amrepair_app, "gcode": gcode_app}
ROOTS = {name: typer.main.get_command(app) for name, app in APPS.items()}


def commands(command: click.Command, path: tuple[str, ...]) -> list[tuple[str, click.Command]]:
    """Leaf commands below one, by what is typed."""
    below = getattr(command, "commands", None)
    if below is None:
        return [(" ".join(path), command)]
    return [found for name, one in below.items() for found in commands(one, (*path, name))]


ALL = [found for name, root in ROOTS.items() for found in commands(root, (name,))]


@pytest.mark.parametrize(("name", "command"), ALL, ids=[name for name, _ in ALL])
def test_examples_of_a_command_are_understood_by_it(name: str, command: click.Command) -> None:
    lines = [line for line in (command.epilog or "").split("\n\n") if line.startswith("$ ")]
    assert lines, f"{name} has no examples"
    for line in lines:
        words = shlex.split(line.removeprefix("$ ").split(" > ")[0])
        assert words[: len(name.split())] == name.split()
        # parses words, types, ranges and what is required; runs nothing
        command.make_context(name, words[len(name.split()) :])


@pytest.mark.parametrize(("name", "command"), ALL, ids=[name for name, _ in ALL])
def test_every_command_and_option_says_what_it_is(name: str, command: click.Command) -> None:
    assert command.help
    for parameter in command.params:
        assert getattr(parameter, "help", None), f"{name}: {parameter.name} has no help"


def test_bench_names_the_methods_that_there_are() -> None:
    from amrepair.bench.registry import BENCH_METHODS
    from amrepair.cli.benchmark import METHOD_HELP

    named = {word.strip(",.;") for word in METHOD_HELP.split()}
    assert {name.removesuffix("+pam") for name in BENCH_METHODS} <= named
    assert [
        name for name in BENCH_METHODS if name + "+pam" not in BENCH_METHODS and "+pam" not in name
    ] == [
        "pasdf",
        "pasdf-paper",
    ]  # "but for the first two"


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("amrepair sim", {"simulate"}),
        ("amrepair template ", {"fit", "mesh"}),
        ("amrepair simulate --printer prusa_mk", {"prusa_mk3s", "prusa_mk4"}),
        ("gcode est", {"estimate"}),
        (
            "gcode slice --process repair_",
            {"repair_0.10", "repair_0.20", "repair_0.20_nonplanar", "repair_0.30"},
        ),
    ],
)
def test_bash_completes(typed: str, offered: set[str]) -> None:
    program = typed.split(maxsplit=1)[0]
    count = len(typed.split()) - (0 if typed.endswith(" ") else 1)
    done = CliRunner().invoke(
        APPS[program],
        [],
        prog_name=program,
        env={
            f"_{program.upper()}_COMPLETE": "complete_bash",
            "COMP_WORDS": typed,
            "COMP_CWORD": str(count),
        },
    )
    assert set(done.stdout.split()) == offered, done.output


def test_a_completion_script_can_be_had() -> None:
    for program in ROOTS:
        done = subprocess.run(
            [sys.executable, "-c", f"from {program}.cli import main; main()",
             "--show-completion", "bash"],
            capture_output=True, text=True, timeout=120, check=False, cwd=ROOT,
            env={**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        )  # fmt: skip
        assert f"_{program.upper()}_COMPLETE" in done.stdout, done.stderr
