"""Every command of both programs, given what cannot be used: one sentence, exit 2, nothing left.

The commands are those that the programs have: one that is new must be given its words here.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from amrepair.cli.app import app as amrepair_app
from amrepair.cli.app import main as amrepair_main
from gcode.cli.app import app as gcode_app
from gcode.cli.app import main as gcode_main

MAIN = {"amrepair": amrepair_main, "gcode": gcode_main}
# {bad} is the file that cannot be used, {to} where something would be written.
WORDS = {
    "amrepair simulate": "{bad}.stl --out {to}",
    "amrepair align": "{bad}.ply --template {bad}.stl -o {to}.ply",
    "amrepair detect": "{bad}.ply --template {bad}.stl --out {to}",
    "amrepair repair": "{bad}.ply --template {bad}.stl -o {to}.gcode",
    "amrepair loop": "{bad}.gcode --template {bad}.stl --port file:{to} --scanner probe --out {to}",
    "amrepair postprocess": "{bad}.gcode",
    "amrepair calibrate": "--sound {bad}.ply --template {bad}.stl --name mine",
    "amrepair replay": "{bad}",
    "amrepair bench": "{bad} --format real3d-ad --method pasdf --out {to}",
    "amrepair synth": "{bad}.stl --out {to} --format real3d-ad",
    "amrepair doctor": "--options --nonsense",
    "amrepair view": "{bad}.ply",
    "amrepair fleet": "{bad}.toml",
    "amrepair agent": "--moonraker {bad} --template {bad}.stl --scanner watch:{bad}",
    "amrepair template fit": "{bad}.stl -o {to}.safetensors",
    "amrepair template mesh": "{bad}.safetensors -o {to}.stl",
    "amrepair batch align": "{bad} --template {bad}.stl --out {to}",
    "amrepair batch detect": "{bad} --template {bad}.stl --out {to}",
    "amrepair batch repair": "{bad} --template {bad}.stl --out {to}",
    "gcode slice": "{bad}.stl -o {to}.gcode",
    "gcode check": "{bad}.gcode",
    "gcode estimate": "{bad}.gcode",
    "gcode resume-at": "{bad}.gcode -o {to}.gcode --layer 3",
    "gcode touch": "{bad}.gcode --port /dev/none --above-mm 4 --layer 3 --printer generic_marlin",
    "gcode print-onto": "{bad}.stl {bad}.gcode -o {to}.gcode",
    "gcode send": "{bad}.gcode --port file:{to}",
    "gcode emulate": "--printer {bad}.toml",
    "gcode profiles list": "--nonsense",
    "gcode profiles show": "{bad}.toml",
    "gcode profiles import": "{bad}.gcode",
    "gcode profiles find": "--nonsense",
}
BAD = {
    "missing": None,
    "empty": b"",
    "noise": bytes(range(256)) * 8,
    "half": b"ply\nformat ascii 1.0\nelement vertex 3\nsolid x\nfacet normal 0 0 1\nG1 X1 E",
}


def commands() -> list[str]:
    """Whatever the two programs can be asked to do."""
    found: list[str] = []

    def walk(command: Any, name: str) -> None:
        if not hasattr(command, "commands"):
            found.append(name)
            return
        for each, below in command.commands.items():
            walk(below, f"{name} {each}")

    for name, app in (("amrepair", amrepair_app), ("gcode", gcode_app)):
        walk(get_command(app), name)
    return found


def test_every_command_has_words_here() -> None:
    assert sorted(commands()) == sorted(WORDS)


@pytest.mark.slow  # half a minute: what the commands load
@pytest.mark.parametrize("kind", BAD)
@pytest.mark.parametrize("command", WORDS)
def test_a_refusal_is_one_sentence(
    command: str,
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    content = BAD[kind]
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    if content is not None:
        for suffix in ("", ".stl", ".ply", ".gcode", ".toml", ".safetensors", ".txt"):
            (tmp_path / f"bad{suffix}").write_bytes(content)
    words = WORDS[command].format(bad=tmp_path / "bad", to=tmp_path / "to")
    before = {p.name for p in tmp_path.iterdir()}
    program = command.split(maxsplit=1)[0]
    monkeypatch.setattr(sys, "argv", [*command.split(), *words.split()])
    with pytest.raises(SystemExit) as end:
        MAIN[program]()
    said = capsys.readouterr()
    assert end.value.code == 2, said.err
    assert said.out == ""
    # what a command takes where nothing is said may be told first; the refusal is the last line
    told = [line for line in said.err.strip().splitlines() if "no --printer is given" not in line]
    if command == "gcode check" and kind == "half":  # its answer: line by line
        assert all(line.startswith("line ") for line in told)
    else:
        assert len(told) == 1, said.err
        assert told[0].startswith(program)
    assert {p.name for p in tmp_path.iterdir()} - before <= {"config", "state"}
