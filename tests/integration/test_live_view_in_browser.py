"""The live view as an operator uses it: a click in Chromium drives a loop on an emulated one."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
import pytest
import trimesh
from PIL import Image

import gcode
from amrepair.cli.live import ShownRun
from amrepair.loop import Approval
from amrepair.report.live import LiveView
from amrepair.report.operator import Operator
from amrepair.simulate.defects import parse_defect
from amrepair.simulate.run import PreparedRun, SimulatedRun, prepare_run, simulate_run
from amrepair.template import MeshSdf
from tests.integration.browser import Watched, launched, why_not

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
PICTURES = Path(__file__).parents[2] / "docs" / "images"
JOIN_S = 280.0


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as found:
        yield found


@pytest.fixture(scope="module")
def prepared() -> PreparedRun:
    solid = m3.Manifold.cube((22.0, 18.0, 3.0))
    solid += m3.Manifold.cube((12.0, 11.0, 1.5)).translate((3.0, 3.0, 2.9))
    mesh = solid.to_mesh64()
    part = trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    defects = [parse_defect("void:diameter=7,layers=3")]
    return prepare_run(MeshSdf.from_mesh(part), gcode.load_setup(), defects, title="plate", seed=3)


class Run:
    """A simulated run in a thread of its own, with its page."""

    def __init__(self, prepared: PreparedRun) -> None:
        self.operator = Operator()
        self.page = LiveView(title="plate", operator=self.operator)
        self.shown = ShownRun(self.page, self.operator, ask=True)
        self.shown.show_run(prepared.job, prepared.part)
        self.result: list[SimulatedRun | BaseException] = []
        self._thread = threading.Thread(target=self._go, args=(prepared,), daemon=True)

    def _go(self, prepared: PreparedRun) -> None:
        try:
            run = simulate_run(
                prepared,
                approval=Approval(self.shown.to_print),
                record=self.shown.recording(lambda look: None),
                progress=self.shown.watching(lambda stage, done, total: None),
            )
            self.result.append(run)
        except BaseException as error:  # noqa: BLE001  told to the test
            self.result.append(error)

    def start(self) -> None:
        self._thread.start()

    def finished(self) -> SimulatedRun:
        self._thread.join(JOIN_S)
        (found,) = self.result
        assert isinstance(found, SimulatedRun), found
        return found

    def close(self) -> None:
        self.page.close()
        self._thread.join(JOIN_S)


@pytest.fixture
def run(prepared: PreparedRun) -> Iterator[Run]:
    made = Run(prepared)
    yield made
    made.close()


def picture(page: Any) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


@pytest.mark.parametrize("button", ["Approve", "Skip"])
def test_a_click_decides(browser: Any, run: Run, button: str, regenerate_golden: bool) -> None:
    watched = Watched(browser, run.page.url, viewport={"width": 1280, "height": 800})
    page = watched.page
    page.get_by_role("button", name=button).wait_for()
    assert page.get_by_role("button", name="Approve").is_disabled()
    empty = picture(page)
    run.start()
    page.wait_for_function(
        "(name) => [...document.querySelectorAll('button')]"
        ".some((b) => b.innerText.trim() === name && !b.disabled)",
        arg=button,
    )
    page.get_by_text("Print this repair?").wait_for()
    page.wait_for_function("() => document.querySelector('canvas') !== null")
    if button == "Approve" and regenerate_golden:
        page.wait_for_timeout(5000)  # a picture for people: let everything arrive
        page.locator(".mantine-Notification-closeButton").evaluate_all(
            "buttons => buttons.forEach((button) => button.click())"
        )  # viser's word on a browser that draws without a GPU
        page.wait_for_timeout(1000)
        Image.fromarray(picture(page)).save(PICTURES / "live-view.png", optimize=True)
    # part, scan, what is missing and the patch are drawn by now or within some frames
    pictures = (picture(page) for _ in range(100))
    assert any((now != empty).any(axis=-1).mean() > 0.03 for now in pictures)
    page.get_by_role("button", name=button).click()
    report = run.finished().report
    first = report.looks[0]
    assert first.printed is (button == "Approve")
    assert first.declined is (button == "Skip")
    assert bool(report.repair_prints) is (button == "Approve")
    assert watched.complaints == []
    local = run.page.url.split("://")[1].split("/")[0]
    assert all(local in url or url.startswith(("data:", "blob:")) for url in watched.requests)
    page.close()


def test_pause_holds_the_run(browser: Any, run: Run) -> None:
    said: list[str] = []
    run.shown.drives(lambda: said.append("pause"), lambda: said.append("resume"))
    watched = Watched(browser, run.page.url)
    page = watched.page
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Go on").wait_for()
    run.start()
    page.wait_for_function(
        "() => [...document.querySelectorAll('button')]"
        ".some((b) => b.innerText.trim() === 'Approve' && !b.disabled)"
    )
    page.get_by_role("button", name="Approve").click()
    page.get_by_role("button", name="Go on").click()
    page.get_by_role("button", name="Pause").wait_for()
    report = run.finished().report
    assert report.looks[0].printed
    assert said == ["pause", "resume"]
    page.close()


def test_a_wrong_token_shows_nothing(browser: Any) -> None:
    token = "0123456789abcdef0123"
    view = LiveView(title="test", token=token)
    try:
        page = browser.new_page()
        assert page.goto(view.url.replace(token, "x" * 20)).status == 403
        assert page.goto(view.url.split("?")[0]).status == 403
        assert page.goto(view.url).status == 200
        assert "token" not in page.url  # it went into a cookie
        page.get_by_text("Getting ready.").wait_for(timeout=240_000)  # it came by the socket
        page.close()
    finally:
        view.close()


def test_a_picture_for_the_docs() -> None:
    """Taken anew with --regenerate-golden; it is there otherwise."""
    assert (PICTURES / "live-view.png").stat().st_size < 700_000


def test_the_command_line_runs_with_a_view_and_json_stays_alone(tmp_path: Path) -> None:
    part = tmp_path / "plate.stl"
    trimesh.creation.box(bounds=((0, 0, 0), (20, 16, 2))).export(part)
    code = "from amrepair.cli import main; main()"
    words = ["simulate", part, "--defect", "none", "--out", tmp_path / "run", "--json"]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *words, "--view", "--view-port", "0"],
        capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["iterations"] == 0  # one object and nothing else
    assert "Open http://localhost:" in done.stderr
