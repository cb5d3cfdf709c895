"""An agent beside a small Moonraker, its job, and what kills it: for the tests of both scanners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import manifold3d as m3
import pytest
from loop_bench import PLACE_MM, SIZE_MM, Scripted, scan_of, solid_mesh
from moonraker_fake import AgentsMoonraker

from amrepair.cli import running, serving
from amrepair.cli.live import ViewPlace
from amrepair.loop.tape import read_events
from amrepair.postprocess import LooksAsked, mark
from amrepair.scans import Scan
from amrepair.template import open_template
from gcode.hosts.moonraker_session import MoonrakerSession
from gcode.hosts.secret import ApiKey
from gcode.hosts.web import Address
from gcode.profiles import load_setup
from gcode.slicing.job import plan_part
from gcode.writer import write

LAYER_MM, LOOK_LAYER = 0.2, 4
TOP_MM = LAYER_MM * (LOOK_LAYER + 1)
PRINTER = ("generic_klipper", "pla", "repair_0.20")


@dataclass(frozen=True)
class Ready:
    """A marked job, its part, and what stands at its look."""

    plain: str
    text: str
    template: Path
    whole: m3.Manifold
    broken: m3.Manifold


def made_ready(here: Path) -> Ready:
    """One, with its template in a folder."""
    setup = load_setup(*PRINTER)
    part = m3.Manifold.cube(SIZE_MM)
    plain = write(plan_part(part.translate(PLACE_MM), setup).toolpath, setup, title="small").text
    marked = mark(plain, "job.gcode", "klipper", LooksAsked(every=LOOK_LAYER + 1, final=False))
    assert [place.layer for place in marked.places] == [LOOK_LAYER]
    solid_mesh(part).export(here / "small.stl")
    open_template(here / "small.stl").save(here / "small.safetensors")  # type: ignore[attr-defined]
    (here / "small.stl").unlink()
    whole = part.trim_by_plane((0.0, 0.0, -1.0), -TOP_MM).translate(PLACE_MM)
    pocket = m3.Manifold.cube((6.0, 6.0, 1.0)).translate((105.0, 93.0, TOP_MM - 0.8))
    return Ready(plain, marked.text, here / "small.safetensors", whole, whole - pocket)


class Bench:
    """A printer, and one agent after another."""

    def __init__(self, ready: Ready, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ready, self.folder = ready, folder
        (folder / "gcodes").mkdir()
        (folder / "gcodes" / "small_pla.gcode").write_text(ready.text)
        self.fake = AgentsMoonraker(folder / "gcodes")
        self.klipper = self.fake.klipper
        self.scans = [scan_of(each, spacing_mm=0.18) for each in (ready.broken, ready.whole)]
        monkeypatch.setattr(serving, "LOOK_S", 0.05)
        monkeypatch.setattr(running, "open_scanner", lambda *given: Scripted(self._scan))
        self.starts = True
        self.heard: list[str] = []
        self.answers: Callable[[str], None] = lambda text: None
        self.fake.on_said = self._hear

    def _scan(self, number: int) -> Scan:
        return self.scans.pop(0)

    def _hear(self, text: str) -> None:
        self.heard.append(text)
        if self.starts and "the agent is here" in text:
            self.starts = False
            self.fake.start("small_pla.gcode")
        self.answers(text)

    def agent(self, approve: str = "auto", **changed: Any) -> int:
        said = {"scanner": f"watch:{self.folder}", "approve": approve, "scan_timeout_s": 1.0,
                "sound": (), "seed": 0}  # fmt: skip
        told = {"template": self.ready.template, "out": self.folder / "runs", "named": PRINTER,
                "calibration": None, "page": ViewPlace(False, "", 0, None), "once": True,
                "pose_confirmed": False, "said": said}  # fmt: skip
        return serving.serve(
            serving.Served(
                Address.parse(f"moonraker+{self.fake.url}"), ApiKey(""), **{**told, **changed}
            )
        )

    def told(self) -> str:
        return "\n".join(self.klipper.said)

    def executed(self) -> list[str]:
        """What moved or heated, in order; M400 only waits."""
        return [line for line in self.klipper.executed if line != "M400"]

    def events(self) -> list[dict[str, Any]]:
        (run,) = (self.folder / "runs").iterdir()
        return read_events(run)


class Killed(BaseException):
    """What ends an agent without its knowing."""


class Killer:
    """Kills the agent at its n-th step of a repair, before or after it has reached the printer."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, step: int, *, reaches: bool) -> None:
        self.steps, self.dead = 0, False
        original = MoonrakerSession.call

        def call(session: MoonrakerSession, method: str, *given: Any, **named: Any) -> Any:
            """What a dead agent says goes nowhere."""
            if self.dead:
                raise Killed
            if given and "_AMREPAIR_STEP PROGRAM" in str(given[0]):
                self.steps += 1
                if self.steps == step:
                    self.dead = True
                    if reaches:
                        original(session, method, *given, **named)
                    raise Killed
            return original(session, method, *given, **named)

        monkeypatch.setattr(MoonrakerSession, "call", call)
