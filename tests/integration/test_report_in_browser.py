"""The report as a person sees it: drawn, moved, played, turned, printed, in light and dark."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from amrepair.report import write_report
from tests.integration.browser import Watched, launched, why_not
from tests.report_example import example

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(why_not()), reason=why_not()),
    # playwright leaves its own loop and pipes to the collector
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
PICTURES = Path(__file__).parents[2] / "docs" / "images"
SETTLED = "() => window.reportSettled()"
# All corners of the drawn box in the pane's own coordinates, −1…1, from the matrices drawn with.
CORNERS = """(id) => {
  const div = document.querySelector('#' + id + ' .plot');
  const plot = div._fullLayout.scene._scene.glplot, c = plot.cameraParams;
  const low = plot.bounds[0], high = plot.bounds[1], out = [];
  const times = (m, v) => [0, 1, 2, 3].map((r) => [0, 1, 2, 3].reduce((s, k) => s + m[4 * k + r] * v[k], 0));
  for (let n = 0; n < 8; n++) {
    const p = [0, 1, 2].map((a) => (n >> a & 1 ? high : low)[a]).concat([1]);
    const q = times(c.projection, times(c.view, times(c.model, p)));
    out.push([q[0] / q[3], q[1] / q[3]]);
  }
  return out;
}"""  # noqa: E501


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as found:
        yield found


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(example(30_000), path)
    return path


@pytest.fixture(scope="module")
def shown(browser: Any, report: Path) -> Watched:
    watched = Watched(browser, report.as_uri(), viewport={"width": 1300, "height": 900})
    watched.page.evaluate(SETTLED)
    return watched


def pixels(page: Any, selector: str) -> np.ndarray:
    page.evaluate(SETTLED)
    # plotly draws on the next frame; two more, and it is on the screen
    page.evaluate(
        "() => new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))"
    )
    return np.asarray(Image.open(io.BytesIO(page.locator(selector).screenshot())).convert("RGB"))


def test_nothing_is_complained_of_and_nothing_is_fetched(shown: Watched, report: Path) -> None:
    assert shown.complaints == []
    assert shown.requests == [report.as_uri()]
    assert shown.page.locator(".failed").count() == 0


def test_the_scan_is_visible_in_its_colours(shown: Watched) -> None:
    picture = pixels(shown.page, "#viewer .plot").astype(int)
    red, green, blue = picture[..., 0], picture[..., 1], picture[..., 2]
    assert ((blue - red) > 60).mean() > 0.004  # what is missing
    assert ((red - blue) > 60).mean() > 0.001  # what is too much
    grey = (abs(red - blue) < 14) & (abs(red - green) < 14) & (red > 110) & (red < 225)
    assert grey.mean() > 0.1  # the part


def test_pixels_change_when_the_slider_moves_and_play_plays(shown: Watched) -> None:
    page = shown.page
    page.locator("input[name=preset][value=repair]").check(force=True)
    full = pixels(page, "#viewer .plot")
    page.locator("#layer").focus()
    page.keyboard.press("Home")
    first = pixels(page, "#viewer .plot")
    assert (full != first).any(axis=-1).mean() > 0.001
    assert page.locator("#layer-text").inner_text().startswith("Layer 1 of 15")
    page.locator("#play").click()
    page.wait_for_function("() => Number(document.getElementById('layer').value) >= 2")
    page.locator("#play").click()
    assert page.locator("#play").get_attribute("aria-label") == "Play the repair layer by layer"
    assert (pixels(page, "#viewer .plot") != first).any(axis=-1).mean() > 1e-4


def test_before_and_after_turn_together_by_keyboard(shown: Watched) -> None:
    page = shown.page
    page.locator("input[name=preset][value=deviation]").check(force=True)
    was = pixels(page, "#after .plot")
    page.locator("#before").focus()
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    now = pixels(page, "#after .plot")
    assert (was != now).any(axis=-1).mean() > 0.02
    cameras = page.evaluate(
        "() => ['before', 'after'].map((id) => "
        "document.querySelector('#' + id + ' .plot')._fullLayout.scene.camera.eye)"
    )
    assert cameras[0] == cameras[1]
    page.keyboard.press("0")
    assert (pixels(page, "#after .plot") != now).any()


@pytest.mark.parametrize("width", [1300, 700])
def test_the_whole_part_is_in_the_first_view(browser: Any, report: Path, width: int) -> None:
    watched = Watched(browser, report.as_uri(), viewport={"width": width, "height": 900})
    pixels(watched.page, "#viewer .plot")
    for pane in ("viewer", "before", "after"):
        corners = np.array(watched.page.evaluate(CORNERS, pane))
        assert corners.shape == (8, 2)
        assert np.abs(corners).max() < 0.97, pane
        assert np.abs(corners).max() > 0.7, pane  # and it is not lost in the distance
    watched.page.close()


def test_dark_and_print(browser: Any, report: Path) -> None:
    watched = Watched(
        browser, report.as_uri(), viewport={"width": 1000, "height": 800}, color_scheme="dark"
    )
    page = watched.page
    assert pixels(page, ".top").mean() < 80
    assert pixels(page, "#viewer .plot").mean() < 110
    page.set_viewport_size({"width": 690, "height": 980})  # A4 less its margins
    page.emulate_media(media="print", color_scheme="dark")  # paper is white all the same
    page.evaluate(SETTLED)
    assert page.locator(".player").is_hidden()
    assert page.locator(".index").is_hidden()
    assert page.locator("#regions table").is_visible()
    # regression: drawings kept the window's size, and lay over each other on paper
    for frame in page.locator(".view, .chart").all():
        outer = frame.bounding_box()
        inner = frame.locator(".svg-container").bounding_box()
        assert inner["width"] > 100, frame
        assert inner["x"] >= outer["x"] - 1, frame
        assert inner["x"] + inner["width"] <= outer["x"] + outer["width"] + 1, frame
        assert inner["y"] + inner["height"] <= outer["y"] + outer["height"] + 1, frame
    assert page.evaluate("() => getComputedStyle(document.body).backgroundColor").startswith(
        "rgb(255, 255, 255"
    )
    assert watched.complaints == []
    page.close()


def test_figures_that_nobody_knows_do_not_stop_the_page(browser: Any, tmp_path: Path) -> None:
    data = example(3000)
    nan = float("nan")
    figures = replace(data.figures, unreachable_mm3=nan, repaired_ratio=nan, print_time_s=nan)
    looks = (data.looks[0], replace(data.looks[1], missing_mm3=nan, threshold_mm=nan))
    write_report(replace(data, figures=figures, looks=looks), tmp_path / "nan.html")
    watched = Watched(browser, (tmp_path / "nan.html").as_uri())
    watched.page.evaluate(SETTLED)
    assert watched.complaints == []
    text = watched.page.locator("body").inner_text()
    assert "NaN" not in text
    assert "nan " not in text
    assert "not known" in text
    watched.page.close()


def test_a_picture_for_the_docs(shown: Watched, regenerate_golden: bool) -> None:
    """Taken anew with --regenerate-golden; it is there otherwise."""
    if regenerate_golden:
        shown.page.evaluate(SETTLED)
        shown.page.evaluate("() => window.scrollTo(0, 0)")
        raw = shown.page.screenshot(clip={"x": 0, "y": 0, "width": 1300, "height": 1180},
                                    full_page=True)  # fmt: skip
        picture = Image.open(io.BytesIO(raw)).convert("RGB")
        picture.save(PICTURES / "report.png", optimize=True)
    assert (PICTURES / "report.png").stat().st_size < 400_000
