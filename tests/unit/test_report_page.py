"""The report page: self-contained, escaped, faithful to its data, bounded, the same every time."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import manifold3d
import numpy as np
import pytest

import amrepair
import gcode
from amrepair.errors import InputError
from amrepair.repair import RepairPlan
from amrepair.report import (
    Counter,
    Figures,
    Outcome,
    ReportData,
    ReportDecision,
    SolidMesh,
    encode,
    outcome_of,
    payload,
    summary,
    write_report,
)
from amrepair.report import document as document_module
from amrepair.report.assemble import report_of_plan
from amrepair.report.collect import look_of, of_the_part, plan_result, together_mm3
from amrepair.report.data import ReportRule
from amrepair.report.document import render_report
from amrepair.report.live import COLOUR_STOPS
from amrepair.report.options import DEFAULT_PAGE
from amrepair.report.text import summary_of_result
from amrepair.scans import Scan
from tests.report_example import HOSTILE, POCKET_MM3, example

LOADING = {"src", "href", "srcset", "data", "poster", "action", "formaction", "background"}


class Elements(HTMLParser):
    """Start tags, and the text of script and style elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.blocks: list[tuple[str, dict[str, str | None], str]] = []
        self.visible: list[str] = []
        self._open: tuple[str, dict[str, str | None]] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._open = (tag, dict(attrs)) if tag in ("script", "style") else None

    def handle_data(self, data: str) -> None:
        if self._open:
            self.blocks.append((*self._open, data))
        else:
            self.visible.append(data)

    def handle_endtag(self, tag: str) -> None:
        self._open = None


def values_of(page: str) -> dict:
    found = re.search(r'id="report-data">(.*?)</script>', page, re.S)
    assert found
    return json.loads(found.group(1))


def decoded(encoded: dict) -> np.ndarray:
    """What the page's script makes of an encoded array."""
    kind = {"u1": "|u1", "u2": "<u2", "u4": "<u4"}[encoded["type"]]
    flat = np.frombuffer(base64.b64decode(encoded["data"]), dtype=kind).reshape(encoded["shape"])
    if "scale" not in encoded:
        return flat.astype(np.int64)
    return flat * np.array(encoded["scale"]) + np.array(encoded["offset"])


def empty(**changes: object) -> ReportData:
    nothing = Figures(0.0, None, 0.0, None, None, 0.0, 0.0, 0, 0.0, 0.0)
    return replace(ReportData("part", Outcome.NOTHING_TO_REPAIR, nothing, ()), **changes)


@pytest.fixture(scope="module")
def data() -> ReportData:
    return example(20_000)


@pytest.fixture(scope="module")
def page(data: ReportData) -> str:
    return render_report(data)


def test_nothing_is_loaded_from_elsewhere(page: str) -> None:
    elements = Elements(page)
    for tag, attributes in elements.tags:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        for name in LOADING & set(attributes):
            assert (attributes[name] or "").startswith(("#", "data:")), (tag, name)
    for tag, _, text in elements.blocks:
        if tag == "style":
            assert "@import" not in text
            assert not re.search(r"url\((?!['\"]?data:)", text)
    policy = [a["content"] for t, a in elements.tags if t == "meta" and "content" in a]
    assert any("default-src 'none'" in (text or "") for text in policy)


def test_hostile_text_stays_text(data: ReportData) -> None:
    looks = tuple(replace(look, label=HOSTILE) for look in data.looks)
    hostile = replace(
        data,
        title=HOSTILE,
        looks=looks,
        setup={HOSTILE: HOSTILE},
        provenance={HOSTILE: HOSTILE},
        regions=tuple(replace(row, type=HOSTILE, note=HOSTILE) for row in data.regions),
        decisions=tuple(replace(d, where=HOSTILE, reasons=(HOSTILE,)) for d in data.decisions),
        wire=tuple(replace(c, name=HOSTILE, meaning=HOSTILE) for c in data.wire),
        temperatures=tuple(replace(t, name=HOSTILE) for t in data.temperatures),
    )
    plain, attacked = Elements(render_report(data)), Elements(render_report(hostile))
    assert not [a for t, a in attacked.tags if "onerror" in a or t == "img"]
    count = [sum(t == "script" for t, _ in e.tags) for e in (plain, attacked)]
    assert count[0] == count[1] == 3
    assert any("evil.example" in text for text in attacked.visible)
    assert "<img" not in json.dumps(values_of(render_report(hostile)))


def test_the_drawing_holds_the_data(data: ReportData, page: str) -> None:
    values = values_of(page)
    assert [look["total"] for look in values["looks"]] == [
        len(look.points_mm) for look in data.looks
    ]
    for shown, look in zip(values["looks"], data.looks, strict=True):
        inside = payload.near_part(look, payload.bounds(data))
        kept = encode.thinned(
            inside.points_mm, inside.label_of_point != 0, budget=DEFAULT_PAGE.points_per_look
        )
        points = decoded(shown["points"])
        assert np.abs(points - inside.points_mm[kept]).max() < 0.001
        deviation = decoded(shown["deviation"]).reshape(-1)
        assert np.abs(deviation - inside.deviation_mm[kept]).max() < 0.001
        assert sum(shown["histogram"]["counts"]) == len(inside.points_mm)
        assert list(zip(shown["noise"]["area"], shown["noise"]["depth"], strict=True)) == list(
            look.smallest_mm
        )
    assert values["volumes"]["missing"] == [POCKET_MM3, 1.9]
    solid = values["looks"][0]["missing"]
    corners = decoded(solid["vertices"])[decoded(solid["faces"])]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(POCKET_MM3, rel=1e-3)
    beads = data.looks[0].beads
    assert beads is not None
    ends = decoded(values["looks"][0]["beads"]["ends"])
    assert np.abs(ends - np.hstack([beads.start_mm, beads.end_mm])).max() < 0.001
    assert values["temperatures"][0]["target"][0] == 215.0


def test_tables_are_on_the_page(data: ReportData, page: str) -> None:
    seen = " ".join(Elements(page).visible)
    for text in ("Within tolerance", "48,213", "Prusa MK3S", "fill now", "chip", "9f0c"):
        assert text in seen, text


def test_a_stop_is_compared_with_itself(data: ReportData) -> None:
    # regression: the layer that broke worst stood beside the finished part
    broken, whole = data.looks
    looks = (
        replace(broken, label="a1", stop="layer-016"),
        replace(whole, label="a2", stop="layer-016"),
        replace(whole, label="b", stop="final"),
    )
    several = replace(data, looks=looks, compare=None)
    assert payload.compared(several, payload.drawn_looks(several)) == (0, 1)
    alone = replace(data, looks=(looks[0], looks[2]), compare=None)  # declined, and gone on
    assert payload.compared(alone, payload.drawn_looks(alone)) == (0, 1)


def test_the_first_view_looks_from_where_the_defect_is_seen(data: ReportData) -> None:
    # regression: a chip at the far side of a knob hid behind it
    assert values_of(render_report(data))["facing"] == [-1, -1]  # front left, as it lies
    box_mm = payload.bounds(data)
    pocket = data.looks[0].missing
    assert pocket is not None
    across = pocket.vertices_mm * (-1, -1, 1) + box_mm.sum(axis=0) * (1, 1, 0) + (8.0, 8.0, 0.0)
    looks = (replace(data.looks[0], missing=SolidMesh(across, pocket.faces)), data.looks[1])
    assert payload.facing(replace(data, looks=looks), (0, 1), box_mm) == (1, 1)


def test_a_repair_that_leaves_something_is_headed_so() -> None:
    result = {"missing_mm3_before": 188.0, "filament_mm": 71.0, "unprintable_mm3": 29.7}
    outcome = outcome_of(result, within_tolerance=False)
    assert outcome is Outcome.PLANNED_IN_PART  # not "not within tolerance": nothing was printed
    assert outcome_of(result, within_tolerance=True) is Outcome.PLANNED
    page = render_report(empty(outcome=outcome, figures=Figures.from_result(result)))
    seen = " ".join(Elements(page).visible)
    assert "does not mend all" in seen
    assert "29.7 mm³ can hold no bead" in seen
    assert "Left out" in seen


def test_repairs_are_counted_in_whole_numbers() -> None:
    result = {"missing_mm3_before": 3.0, "missing_mm3_after": 0.0, "filament_mm": 5.0,
              "iterations": 2}  # fmt: skip
    assert "over 2 repairs" in summary_of_result(result, within_tolerance=True)[1]


# Machado, Oliveira and Fernandes (2009), severity 1.0, on linear RGB.
SEEN_BY = {
    "protanope": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "deuteranope": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
    "tritanope": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
}


@pytest.mark.parametrize("eye", SEEN_BY)
def test_missing_and_too_much_are_told_apart_by_every_eye(eye: str) -> None:
    script = document_module._asset("report.js")
    found = re.search(r"const STOPS = (\[\[.*?\]\]);", script)
    assert found
    stops = np.array(json.loads(found.group(1)), dtype=np.float64)
    assert np.array_equal(stops, COLOUR_STOPS)  # one scale, in the report and in the live view
    linear = np.where(stops <= 10.31, stops / 3294.6, ((stops / 255 + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(SEEN_BY[eye]).T, 0.0, 1.0)
    xyz = seen @ np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    ).T  # fmt: skip
    root = np.cbrt(np.maximum(xyz / [0.9505, 1.0, 1.089], 0.0))
    lab = np.stack(
        [116 * root[:, 1] - 16, 500 * (root[:, 0] - root[:, 1]), 200 * (root[:, 1] - root[:, 2])],
        axis=1,
    )
    middle = len(lab) // 2
    for near in range(1, middle + 1):  # a ΔE of 20 is seen at a glance; 2.3 just so
        missing, excess = lab[middle - near], lab[middle + near]
        assert np.linalg.norm(missing - excess) > 20.0
        assert np.linalg.norm(missing - lab[middle]) > 10.0
        assert np.linalg.norm(excess - lab[middle]) > 10.0


def test_a_rule_that_decided_is_told_in_words(data: ReportData) -> None:
    rule = ReportRule("S9", "gravest is fill now", "fill now: the patch has passed the checker")
    decision = ReportDecision("Layer 16, scan 1", "fill now", ("It fits.",), (rule,))
    page = render_report(replace(data, decisions=(decision, decision)))
    seen = " ".join(Elements(page).visible)
    assert "By rule S9." in seen
    assert seen.count(rule.then) == 1
    assert "What these rules say" not in render_report(data)  # it names none


def test_one_scan_has_no_history(data: ReportData) -> None:
    # regression: one bar as wide as the page, under "Volumes and temperatures" without any
    page = render_report(replace(data, looks=data.looks[:1], temperatures=()))
    assert "Volume at each scan" not in page
    assert "Volumes" not in page


def test_same_data_same_bytes(data: ReportData, tmp_path: Path) -> None:
    write_report(data, tmp_path / "a.html")
    write_report(example(20_000), tmp_path / "b.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "b.html"]


@pytest.mark.slow
def test_half_a_million_points_stay_in_budget_and_it_is_said() -> None:
    page = render_report(example(500_000))
    assert len(page.encode()) < 15e6
    for look in values_of(page)["looks"]:
        assert look["shown"] <= DEFAULT_PAGE.points_per_look < look["total"]
    seen = " ".join(Elements(page).visible)
    assert "use every point" in seen  # the counts themselves: the script's caption


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"outcome": Outcome.STOPPED},
        {
            "outcome": Outcome.PLANNED,
            "looks": (
                replace(example(500).looks[1], excess=None, unseen_mm=None, height_map=None),
            ),
        },
        {
            "looks": (
                replace(
                    example(500).looks[1],
                    points_mm=np.zeros((0, 3)),
                    deviation_mm=np.zeros(0),
                    label_of_point=np.zeros(0, dtype=np.int64),
                    normals=None,
                ),
            )
        },
        {"looks": (replace(example(500).looks[1], missing_mm3=float("nan")),)},
        {"figures": Figures.from_result({"repaired_ratio": float("nan")})},
        {
            "figures": Figures(
                *[float("nan")] * 7, iterations=1, filament_mm=20.0, print_time_s=float("nan")
            ),
            "wire": (Counter("resends", float("nan")),),
            "seconds": {"print": float("nan")},
        },
    ],
    ids=[
        "no looks",
        "stopped",
        "one bare look",
        "no points",
        "nan volume",
        "nan result",
        "nan everywhere",
    ],
)
def test_unknown_or_absent_values(changes: dict) -> None:
    page = render_report(empty(**changes))
    elements = Elements(page)
    seen = " ".join(elements.visible)
    seen += " ".join(str(v) for _, attributes in elements.tags for v in attributes.values() if v)
    assert values_of(page)
    assert not re.search(r"\bnan\b|\bNone\b", seen)


def test_an_unwritable_place_is_one_sentence(data: ReportData, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="cannot be written"):
        write_report(data, tmp_path / "file" / "report.html")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_assets_are_found_as_package_data() -> None:
    for name in ("report.css", "report.js"):
        assert len(document_module._asset(name)) > 1000


def test_a_part_that_nobody_looked_at_is_not_called_sound() -> None:
    """regression: a loop whose scanner was silent told that the part agrees with its template."""
    result = {"stops": [], "passed_by": ["layer-029", "final"], "missing_mm3_before": 0.0}
    found, _, left = summary_of_result(result | {"missing_mm3_after": 0.0}, within_tolerance=False)
    assert found == "The part was not looked at: what is missing is not known."
    assert "missing any more" not in left
    assert left.endswith("; no scan came at layer-029, final.")
    result |= {"stops": [{}], "passed_by": ["final"], "missing_mm3_after": 0.0}
    found, _, left = summary_of_result(result, within_tolerance=False)
    assert found == "Nothing was missing at the looks that had a scan."
    assert left == "Nothing is missing; no scan came at final."
    result |= {"passed_by": []}
    found, _, left = summary_of_result(result, within_tolerance=True)
    assert found == "Nothing is missing: the part agrees with its template."


def test_a_plan_that_leaves_something_is_not_said_to_be_printed() -> None:
    figures = Figures(44.0, None, 0.0, None, None, 20.0, 0.0, 1, 12.0, 36.0)
    said = summary(Outcome.NOT_WITHIN_TOLERANCE, figures, ())[1]
    assert said.startswith("The repair takes 12 mm of filament in 36 s")
    assert "has not been printed" in said


@pytest.mark.parametrize(("before_mm3", "said"), [(0.0, "missing."), (44.0, "missing any more.")])
def test_what_never_was_missing_is_not_missing_any_more(before_mm3: float, said: str) -> None:
    figures = Figures(before_mm3, 0.0, 0.0, None, None, 0.0, 0.0, 1, 0.0, 0.0)
    assert summary(Outcome.NOTHING_TO_REPAIR, figures, ())[2].startswith(f"Nothing is {said}")


def test_a_scan_without_normals_is_drawn_as_bright_as_one_with() -> None:
    """Seen from the first view, whose sides look left, front and up."""
    sides = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    for normal in sides:
        flat = rng.uniform(0.0, 10.0, (400, 3)) * (normal == 0)
        told = encode.shading(flat, np.tile(normal, (400, 1)))
        untold = encode.shading(flat, None)
        assert abs(told.mean() - untold.mean()) < 0.7


@pytest.fixture(scope="module")
def planned(example_files: Path) -> RepairPlan:
    """A repair of a broken part on a piece of its bed."""
    site = amrepair.Site.of_part(
        amrepair.open_template(example_files / "part.safetensors"), gcode.load_setup()
    )
    scan = amrepair.read_scan(example_files / "scan.ply", frame="build")
    x, y = np.meshgrid(np.arange(95.0, 99.0, 0.3), np.arange(75.0, 105.0, 0.3))
    bed_mm = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    bed_mm = np.vstack(
        [bed_mm, [(110.0, 90.0, 25.0), (90.0, 78.0, 14.0)]]
    )  # reflections in the air
    up = np.tile([0.0, 0.0, 1.0], (len(bed_mm), 1))
    both = Scan(
        np.vstack([scan.points_mm, bed_mm]),
        0.03,
        "build",
        np.vstack([np.asarray(scan.normals), up]),
    )
    return amrepair.plan_repair(both, site, title="repair")


def test_a_look_of_a_plan_carries_normals_and_outlines(
    planned: RepairPlan, example_files: Path
) -> None:
    plan = planned
    scan = amrepair.read_scan(example_files / "scan.ply", frame="build")
    shown = look_of(plan, "as scanned", printed=False)
    assert shown.normals is not None
    kept = of_the_part(plan)[: len(scan)]
    assert np.abs(shown.normals - np.asarray(scan.normals)[kept]).max() < 0.02  # both in the bed's
    # what the scan tells of its errors, and the least that it could show
    assert shown.noise.startswith("One point is off by 0.0")
    assert [area for area, _ in shown.smallest_mm] == sorted(a for a, _ in shown.smallest_mm)
    assert all(0.1 < depth < 1.0 for _, depth in shown.smallest_mm)
    assert shown.height_map is not None
    (outline,) = shown.outlines_mm
    low, high = outline.min(axis=0), outline.max(axis=0)
    # what is missing is grown back by up to three times the tolerance's 0.2 mm at a rim
    assert low == pytest.approx([123.0, 80.0], abs=0.6)
    assert high == pytest.approx([130.0, 88.0], abs=0.6)
    # and its page says what is to be done, and why
    setup = gcode.load_setup()
    result = plan_result(plan, gcode="r.gcode", seed=0, seconds={}, setup=setup)
    data = report_of_plan(
        plan,
        result,
        title="r",
        setup=setup,
        template=amrepair.open_template(example_files / "part.safetensors"),
    )
    (decision,) = data.decisions
    assert decision.choice == "print the repair: it does not fill all"
    told = " ".join(decision.reasons)
    assert re.search(r"Missing: \d+\.\d mm³ in 1 region, at X 12\d", told)
    assert "Left out: 1" in told
    assert "passed the checker" in told
    assert "Decisions" in "".join(Elements(render_report(data)).visible)


def test_counters_are_told_in_figures_that_people_read(data: ReportData) -> None:
    wire = (Counter("acknowledged", 42483.0), Counter("slowest round trip, ms", 1.098156955))
    visible = Elements(render_report(replace(data, wire=wire))).visible
    assert {"42,483", "1.1"} <= set(visible)


def test_the_bed_beside_the_part_is_not_drawn_as_excess(
    planned: RepairPlan, example_files: Path
) -> None:
    scan = amrepair.read_scan(example_files / "scan.ply", frame="build")
    shown = look_of(planned, "as scanned", printed=False)
    assert len(shown.points_mm) == len(shown.deviation_mm) == len(shown.label_of_point)
    assert shown.points_mm[:, 0].min() > 99.0  # nothing of the bed
    assert shown.points_mm[:, 2].max() < 9.5  # nor of what hangs in the air
    kept = len(shown.points_mm) / len(scan.points_mm)
    assert kept == pytest.approx(1.0, abs=0.002)  # and all of the part


def test_what_stands_out_at_two_stops_counts_once() -> None:
    """Regression: strips of 25 mm³ were told as 46, once for each look that saw them."""
    strip = manifold3d.Manifold.cube((10.0, 0.5, 1.0))
    aside = strip.translate((0.0, 5.0, 0.0))
    assert together_mm3([strip, manifold3d.Manifold(), strip, aside]) == pytest.approx(10.0)
    assert together_mm3([manifold3d.Manifold()]) == 0.0
