"""A loop over a print server, killed anywhere: gone on with, nothing is printed twice."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from loop_bench import LAYER, Scripted, Small, scan_of
from test_hosts_octoprint import FakeOctoPrint, printer_at

from amrepair.loop import LoopReport, Records, Tape, plan_stops, run_loop
from amrepair.loop.pick_up import pick_up
from amrepair.loop.sites import sites
from amrepair.report.folder import RunFolder
from amrepair.scans import Scan
from gcode.hosts.modes import Modes, follow
from gcode.progress import Progress, silent
from tests.draws import draws


class Following(FakeOctoPrint):
    """A server that knows where its printer's nozzle is, and what it has printed."""

    def __init__(self) -> None:
        super().__init__()
        self.modes, self.printed = Modes(), []
        self.heaters["bed"] = {"actual": 60.0, "target": 60.0}

    def finish(self) -> None:
        text = self.files[self.file].decode()
        self.printed.append(text)
        for line in text.splitlines():
            self.modes = follow(self.modes, line, "prusa")
        place = self.modes.position_mm
        self.place = " ".join(f"{axis}:{place.get(axis, 0.0):.3f}" for axis in "XYZE")
        super().finish()


@pytest.fixture
def server() -> Iterator[Following]:
    fake = Following()
    with fake.server:
        yield fake


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made()


def run(
    small: Small,
    folder: Path,
    fake: Following,
    scans: Callable[[int], Scan],
    *,
    going_on: bool,
    progress: Progress = silent,
) -> LoopReport:
    printer = printer_at(fake)
    tape = Tape(folder)
    if not going_on:
        printer.connect()
    try:
        return run_loop(
            small.job,
            small.checked,
            printer,
            Scripted(scans),
            sites(small.job, small.template, small.placed, small.setup, by_beads=False),
            stops=plan_stops(small.job, [LAYER], final=False),
            records=Records(
                RunFolder(folder).record,
                tape=tape,
                pick_up=pick_up(printer, release_c=40.0) if going_on else None,
            ),
            progress=progress,
        )
    finally:
        printer.close()
        tape.close()


@pytest.fixture(scope="module")
def whole(small: Small, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A run that nobody killed: its folder, and what the server printed."""
    folder = tmp_path_factory.mktemp("whole")
    broken = small.standing - small.block(-0.8, 0.2)
    with (fake := Following()).server:
        report = run(
            small, folder, fake, lambda n: scan_of((broken, small.standing)[n - 1]), going_on=False
        )
    assert [look.printed for look in report.looks] == [True, False]
    return folder, fake.printed


@pytest.mark.parametrize("state", draws(["never begun", "under way", "over"], "under way"))
@pytest.mark.parametrize("kind", ["repair", pytest.param("park", marks=pytest.mark.slow)])
def test_a_killed_loop_goes_on_over_a_server(
    small: Small,
    whole: tuple[Path, list[str]],
    server: Following,
    tmp_path: Path,
    kind: str,
    state: str,
) -> None:
    folder, printed = whole
    events = [json.loads(line) for line in (folder / "run.jsonl").read_text().splitlines()]
    sends = [k for k, event in enumerate(events) if event["event"] == "send"]
    cut = next(k for k in sends if events[k]["kind"] == kind)
    before = sends.index(cut)  # so many parts were printed before the one that was under way
    lines = (folder / "run.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "run.jsonl").write_text("".join(lines[: cut + 1]))
    for scan in folder.glob("scan-*.ply"):
        (tmp_path / scan.name).write_bytes(scan.read_bytes())
    for text in printed[:before]:
        server.file = "earlier"
        server.files["earlier"] = text.encode()
        server.finish()
    server.files.clear()
    sent = events[cut]
    server.file = f"gcode-{sent['sha256'][:12]}-{sent['first']}-{sent['end']}-00000000.gcode"
    if state != "never begun":
        server.files[server.file] = printed[before].encode()
    if state == "over":
        server.finish()
    elif state == "under way":
        server.flags, server.text = {"operational": True, "printing": True}, "Printing"
        server.completion = 10.0
        asked = server.handle

        def later(request: object) -> object:
            """It ends while it is being followed."""
            began_s.append(time.monotonic())
            if len(server.printed) == before and began_s[-1] > began_s[0] + 0.3:
                server.finish()
            return asked(request)  # type: ignore[arg-type]

        began_s: list[float] = []
        server.server.handle = later  # type: ignore[assignment]
    looked = sum(event["event"] == "look" for event in events[: cut + 1])
    broken = small.standing - small.block(-0.8, 0.2)
    scans = [broken, small.standing][looked:]
    told = []
    report = run(
        small, tmp_path, server, lambda n: scan_of(scans[n - 1]), going_on=True,
        progress=lambda *one: told.append(one),
    )  # fmt: skip
    assert [look.printed for look in report.looks] == [True, False]
    assert server.printed == printed
    # regression: a server tells how many bytes are printed, which were taken for lines of the job
    lines = float(small.checked.program.text.count("\n"))
    printing = [(done, total) for stage, done, total in told if stage == "print"]
    assert all(total == lines for _, total in printing)
    done = [done for done, _ in printing]
    assert done == sorted(done)
    assert done[-1] == lines
    if kind == "repair" and state != "over":
        # regression: a repair was printed, or followed after a kill, without a word
        repairing = [done / total for stage, done, total in told if stage == "repair"]
        assert repairing[0] == 0.0
        assert repairing[-1] == 1.0
