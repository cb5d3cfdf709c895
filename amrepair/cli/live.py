"""`amrepair view`: files on a page; and the live view that `loop` and `simulate` share."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amrepair.cli.files import refuse_traps, sort_inputs
from amrepair.errors import InputError
from amrepair.report.guarded import LOOPBACK
from gcode.cli import console
from gcode.cli.options import plain_text
from gcode.progress import Progress

if TYPE_CHECKING:
    from amrepair.loop import Decision, Look
    from amrepair.repair import RepairPlan
    from amrepair.report.live import LiveView
    from amrepair.report.operator import Operator
    from gcode.reader import Job

PROGRAM_SUFFIXES = frozenset({".gcode", ".gco", ".g", ".nc", ".bgcode"})
VIEW_PORT = 8642
TOKEN_VARIABLE = "AMREPAIR_TOKEN"

HostOption = Annotated[
    str, typer.Option(help="Address to serve on; any but this machine's own needs --token.")
]
PortOption = Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")]
ViewOption = Annotated[
    bool, typer.Option("--view", help="Show the run in a browser, with buttons that drive it.")
]
TokenOption = Annotated[
    str | None,
    typer.Option(
        envvar=TOKEN_VARIABLE,
        help="Secret that the page's address must carry where other machines may open it.",
    ),
]


@console.command(
    "view",
    "amrepair view scan.ply part.stl",
    "amrepair view out/demo/scan-1.ply out/demo/deficit-1.stl out/demo/repair-1.gcode",
)
def view(
    files: Annotated[
        list[Path], typer.Argument(help="Scans, meshes, templates (.safetensors), G-code.")
    ],
    host: HostOption = LOOPBACK,
    port: PortOption = VIEW_PORT,
    token: TokenOption = None,
) -> None:
    """Show files together in a browser, each with a box to hide it; Ctrl+C ends it."""
    refuse_traps(files)  # before what reads them is loaded
    for path in files:
        _refuse(path)
    shown = [shown_as(path) for path in files]
    with console.starting():
        from amrepair.report.live import LiveView

    page = LiveView(title="amrepair view", host=host, port=port, token=token)
    try:
        for show in shown:
            show(page)
        page.say("Files", [path.name for path in files])
        console.out.print(f"Open {page.url} (Ctrl+C ends it)")
        _until_interrupted()
    finally:
        page.close()


def shown_as(path: Path) -> Callable[[LiveView], None]:
    """Read a file, before any page is loaded; what puts it there."""
    import numpy as np

    suffix, name = path.suffix.lower(), path.name
    if suffix in PROGRAM_SUFFIXES:
        from gcode.reader import read_job

        job = read_job(plain_text(path))
        return lambda page: page.show_job(job, name=name, grown=True)
    if suffix == ".safetensors":
        from amrepair.template import load_template

        solid = load_template(path).solid()
        return lambda page: page.show_solid(name, solid, _colour())
    if sort_inputs([path])[0]:
        from amrepair.template.mesh_file import load_mesh

        mesh = load_mesh(path)
        corners, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        return lambda page: page.show_mesh(name, corners, faces, _colour())
    from amrepair.scans import read_scan

    points_mm = np.array(read_scan(path, frame="file").points_mm)
    return lambda page: page.show_cloud(name, points_mm)


def _colour() -> tuple[int, int, int]:
    from amrepair.report.live import PART_RGB

    return PART_RGB


def _refuse(path: Path) -> None:
    from amrepair.scans.files import SCAN_SUFFIXES
    from gcode.solids import SOLID_SUFFIXES as MESH_SUFFIXES
    from gcode.whole import why_no_file

    known = PROGRAM_SUFFIXES | {".safetensors"} | set(MESH_SUFFIXES) | SCAN_SUFFIXES
    if not path.is_file():
        raise InputError(f"{path}: {why_no_file(path)}")
    if path.suffix.lower() not in known:
        raise InputError(f"{path} cannot be shown; it is one of {', '.join(sorted(known))}")


def _until_interrupted() -> None:
    """Wait for Ctrl+C or a polite kill."""
    with contextlib.suppress(KeyboardInterrupt):
        threading.Event().wait()


@dataclass(frozen=True, slots=True)
class ViewPlace:
    """Whether and where a run is shown; and the desk that it is asked at instead."""

    view: bool
    host: str
    port: int
    token: str | None
    desk: Path | None = None


class NoView:
    """What a run tells where nobody looks.

    Attributes
    ----------
    address
        host:port of the page; empty where there is none.
    """

    address = ""

    def show_run(self, job: Job, part: Any) -> None:
        """Nothing is shown."""

    def drives(self, pause: Callable[[], None], resume: Callable[[], None]) -> None:
        """Nothing is driven."""

    def shows(self, plan: RepairPlan) -> None:
        """Nothing is shown."""

    def to_print(self, plan: RepairPlan) -> bool:
        """Nobody is asked."""
        return True

    def to_go_on(self, decision: Decision) -> bool:
        """Nobody is asked."""
        return False

    def recording(self, record: Callable[[Look], None]) -> Callable[[Look], None]:
        """The same."""
        return record

    def watching(self, progress: Progress) -> Progress:
        """The same."""
        return progress


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run on a page, with its operator."""

    page: LiveView
    operator: Operator
    ask: bool

    @property
    def address(self) -> str:
        """host:port of the page."""
        return self.page.address

    def show_run(self, job: Job, part: Any) -> None:
        """The part as it should be, and the beads that will appear."""
        from amrepair.report.live import PART_RGB

        self.page.show_solid("part", part, PART_RGB, opacity=0.25)
        self.page.show_job(job)

    def drives(self, pause: Callable[[], None], resume: Callable[[], None]) -> None:
        """What the pause button calls; rests first where it was pressed already."""
        self.operator.on_pause, self.operator.on_resume = pause, resume
        self.operator.wait_while_paused()  # pressed before there was a printer to pause

    def shows(self, plan: RepairPlan) -> None:
        """What is asked about elsewhere."""
        self.page.show_plan(plan, "Print this repair?")

    def to_print(self, plan: RepairPlan) -> bool:
        """Wait for a button, where the run asks at all; else for the end of a pause."""
        if self.ask:
            return self.page.approve(plan)
        self.operator.wait_while_paused()
        return True

    def to_go_on(self, decision: Decision) -> bool:
        """Wait for a button: whether the job goes on all the same."""
        return self.page.ask(decision)

    def recording(self, record: Callable[[Look], None]) -> Callable[[Look], None]:
        """Record a look, then show it."""

        def both(look: Look) -> None:
            record(look)
            self.page.record(look)

        return both

    def watching(self, progress: Progress) -> Progress:
        """Report progress here and on the page."""
        return self.page.watching(progress)


@contextmanager
def live_view(where: ViewPlace, *, ask: bool, title: str) -> Iterator[NoView | ShownRun]:
    """A page with buttons for a run, or nothing where nobody asked for one."""
    from amrepair.report.operator import Operator

    if not where.view:
        yield NoView()
        return
    from amrepair.report.live import LiveView

    operator = Operator()
    page = LiveView(
        title=title, operator=operator, host=where.host, port=where.port, token=where.token
    )
    there = "approve, skip and pause are" if ask else "a button to pause it is"
    console.errors.print(f"Open {page.url}: {there} there.")
    try:
        yield ShownRun(page, operator, ask)
    finally:
        page.close()
