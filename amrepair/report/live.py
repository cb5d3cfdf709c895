"""`LiveView`: a page on this machine that shows a run as it goes, and buttons that drive it.

It draws what it is handed and hands on what is pressed; it decides nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from amrepair.arrays import Points, Values, Vertices
from amrepair.loop import Decision, Look
from amrepair.repair import RepairPlan
from amrepair.report import guarded
from amrepair.report.collect import decision_of, look_label, of_the_part
from amrepair.report.operator import Operator, OperatorAnswer
from amrepair.report.options import DEFAULT_LIVE
from amrepair.report.text import plan_lines
from gcode.errors import GcodeError
from gcode.meshes import mesh_of
from gcode.moves import Extrude, Toolpath
from gcode.progress import Progress
from gcode.reader import Job

# Blue is missing, grey agrees, orange is too much: as in the report, safe for the colour-blind.
COLOUR_STOPS = np.array(
    [[8, 64, 129], [33, 113, 181], [94, 160, 211], [203, 207, 210], [240, 160, 92], [214, 92, 16],
     [133, 45, 2]], dtype=np.float64,
)  # fmt: skip
MISSING_RGB, EXCESS_RGB, BEADS = (10, 98, 180), (207, 82, 0), (18, 144, 111)
PART_RGB, JOB_RGB = (125, 139, 152), (176, 186, 194)


def deviation_colours(deviation_mm: Values, range_mm: float) -> np.ndarray:
    """(n, 3) 0…255 colours of signed deviations, −range…range."""
    at = (
        (np.clip(deviation_mm / max(range_mm, 1e-9), -1.0, 1.0) + 1.0) / 2 * (len(COLOUR_STOPS) - 1)
    )
    steps = np.arange(len(COLOUR_STOPS))
    channels = [np.interp(at, steps, COLOUR_STOPS[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


class LiveView:
    """A running page.

    Parameters
    ----------
    operator
        Whom the buttons speak for; None shows no buttons.
    host, port
        Where it is served; port 0 takes a free one.
    token
        Needed where `host` is not this machine alone.

    Raises
    ------
    InputError
        If others could reach it without a token.
    MissingDependencyError
        If viser is not there or cannot be guarded.
    """

    def __init__(
        self,
        *,
        title: str,
        operator: Operator | None = None,
        host: str = guarded.LOOPBACK,
        port: int = 0,
        token: str | None = None,
    ) -> None:
        self.server = guarded.start(host=host, port=port, token=token, title=title)
        self._host, self._token = host, token
        self._operator = operator
        self._open = True
        self._job_steps: list[tuple[int, Any]] = []
        self._grown = 0  # of the steps, those that are shown
        self._switches: dict[str, Any] = {}
        self._handles: dict[str, Any] = {}
        scene, gui = self.server.scene, self.server.gui
        scene.set_up_direction("+z")
        self._centre: np.ndarray | None = None
        self._stage = gui.add_markdown("Getting ready.")
        self._found = gui.add_markdown("")
        if operator is not None:
            self._approve = gui.add_button("Approve", color="green", disabled=True)
            self._skip = gui.add_button("Skip", disabled=True)
            self._pause = gui.add_button("Pause")
            self._approve.on_click(lambda _: operator.decide(OperatorAnswer.APPROVE))
            self._skip.on_click(lambda _: operator.decide(OperatorAnswer.SKIP))
            self._pause.on_click(lambda _: self._toggle_pause(operator))
            operator.changed = self._show_operator
        self._folder = gui.add_folder("Shown", expand_by_default=False)  # a phone has no room
        with self._folder:
            dark = gui.add_checkbox("dark page", False, order=float("inf"))
        dark.on_update(lambda _: self._dress(dark=dark.value))
        self._dress(dark=False)
        self.server.on_client_connect(self._stand_back)

    def _stand_back(self, client: Any) -> None:
        """A window that is higher than wide sees all of the part from farther away."""
        camera, first = client.camera, self.server.initial_camera
        if self._centre is None or camera.aspect >= 1:
            return
        look_at = np.asarray(first.look_at)
        camera.position = look_at + (np.asarray(first.position) - look_at) / camera.aspect
        camera.look_at = look_at  # viser moves it along with the position

    def _dress(self, *, dark: bool) -> None:
        """Colours of the page; viser's button that puts it on a public server is not shown."""
        self.server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, control_width="medium"
        )

    @property
    def url(self) -> str:
        """The address to open."""
        host = "localhost" if guarded.is_loopback(self._host) else self._host
        tail = f"?token={self._token}" if self._token else ""
        return f"http://{host}:{self.server.get_port()}/{tail}"

    @property
    def address(self) -> str:
        """host:port that it is served at."""
        return f"{self._host}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop serving; a question that waits is answered with skip."""
        self._open = False
        if self._operator is not None:
            self._operator.changed = lambda: None  # what is answered now is drawn nowhere
            self._operator.close()
        self.server.stop()

    # ---- what stands there -----------------------------------------------------------------

    def show_solid(
        self, name: str, solid: Any, colour: tuple[int, int, int], *, opacity: float = 1.0
    ) -> None:
        """Draw a `manifold3d.Manifold`; an empty one takes away what had the name."""
        if solid.is_empty():
            self._remove(name)
            return
        vertices, faces = mesh_of(solid)
        self.show_mesh(name, vertices, faces, colour, opacity=opacity)

    def show_mesh(
        self,
        name: str,
        vertices_mm: Vertices,
        faces: np.ndarray,
        colour: tuple[int, int, int],
        *,
        opacity: float = 1.0,
    ) -> None:
        """Draw triangles."""
        self._look_at(vertices_mm)
        handle = self.server.scene.add_mesh_simple(
            f"/{name}",
            self._local(vertices_mm),
            faces.astype(np.uint32),
            color=colour,
            opacity=None if opacity >= 1 else opacity,
            flat_shading=True,
            side="double",
        )
        self._switch(name, handle)

    def show_cloud(
        self,
        name: str,
        points_mm: Points,
        deviation_mm: Values | None = None,
        *,
        range_mm: float = 1.0,
    ) -> None:
        """Draw points, coloured by deviation where it is known; many are thinned."""
        self._look_at(points_mm)
        step = max(1, -(-len(points_mm) // DEFAULT_LIVE.points))
        colours: Any = (140, 146, 152)
        if deviation_mm is not None:
            colours = deviation_colours(np.asarray(deviation_mm[::step]), range_mm)
        handle = self.server.scene.add_point_cloud(
            f"/{name}",
            self._local(points_mm[::step]),
            colours,
            point_size=DEFAULT_LIVE.point_mm,
            precision="float32",
        )
        self._switch(name, handle)

    def show_segments(
        self, name: str, start_mm: Points, end_mm: Points, colour: tuple[int, int, int]
    ) -> Any:
        """Draw beads as lines."""
        if not len(start_mm):
            return None
        self._look_at(start_mm)
        step = max(1, -(-len(start_mm) // DEFAULT_LIVE.segments))
        ends = np.stack([start_mm[::step], end_mm[::step]], axis=1)
        return self.server.scene.add_line_segments(
            f"/{name}",
            self._local(ends.reshape(-1, 3)).reshape(-1, 2, 3),
            colour,
            thickness=DEFAULT_LIVE.bead_mm,
        )

    def show_toolpath(self, name: str, toolpath: Toolpath) -> None:
        """Draw the beads of a toolpath."""
        chains = [move for move in toolpath if isinstance(move, Extrude)]
        if not chains:
            self._remove(name)
            return
        start = np.concatenate([np.asarray(chain.points_mm)[:-1] for chain in chains])
        end = np.concatenate([np.asarray(chain.points_mm)[1:] for chain in chains])
        self._switch(name, self.show_segments(name, start, end, BEADS))

    def show_job(self, job: Job, *, name: str = "job", grown: bool = False) -> None:
        """Hand over a job: its beads appear as they are printed, or at once (`grown`)."""
        beads = job.beads
        real = np.flatnonzero(beads.layer >= 0)
        for k, part in enumerate(np.array_split(real, min(DEFAULT_LIVE.job_steps, len(real)))):
            handle = self.show_segments(
                f"{name}/{k}", beads.start_mm[part], beads.end_mm[part], JOB_RGB
            )
            handle.visible = grown
            self._job_steps.append((int(beads.line[part[-1]]), handle))
        self._grown = len(self._job_steps) if grown else 0

    def say(self, title: str, lines: list[str]) -> None:
        """Words beside the scene."""
        self._stage.content = f"**{title}**"
        self._found.content = "\n".join(f"- `{line}`" for line in lines)

    # ---- a run -----------------------------------------------------------------------------

    def watching(self, progress: Progress) -> Progress:
        """The same callback, which also tells this page."""

        def told(stage: str, done: float, total: float) -> None:
            progress(stage, done, total)
            if not self._open:
                return
            words = f"**{stage}**: {100 * done / max(total, 1e-9):.0f} %"
            if words != self._stage.content:  # it is told of every line; people read per cent
                self._stage.content = words
            if stage == "print":
                self._grow_to(done)

        return told

    def _grow_to(self, line: float) -> None:
        """Show the job's beads up to a line; only pieces that change are touched."""
        steps = self._job_steps
        while self._grown < len(steps) and steps[self._grown][0] < line:
            steps[self._grown][1].visible = True
            self._grown += 1
        while self._grown > 0 and steps[self._grown - 1][0] >= line:
            self._grown -= 1
            steps[self._grown][1].visible = False

    def show_plan(self, plan: RepairPlan, label: str, why: Sequence[str] = ()) -> None:
        """Draw a scan with its deviations, what is missing, what is too much, and the patch."""
        if not self._open:
            return
        build_from_template = plan.build_from_template
        anomaly = plan.anomaly
        near = of_the_part(plan)
        self.show_cloud(
            "scan",
            build_from_template.apply(plan.scan.points_mm[near]),
            np.asarray(anomaly.deviation_mm[near]),
            range_mm=4 * anomaly.threshold_mm,
        )
        self.show_solid("missing", plan.deficit.missing, MISSING_RGB, opacity=0.6)
        self.show_solid("too much", plan.deficit.excess, EXCESS_RGB)
        if plan.patch is not None:
            self.show_toolpath("repair", plan.patch.toolpath)
        else:
            self._remove("repair")
        found = [f"- {line}" for line in (*why, *plan_lines(plan))]
        self._found.content = "\n".join([f"**{label}**", *found])

    def approve(self, plan: RepairPlan) -> bool:
        """Show a plan and wait for Approve or Skip (the `approve` of `run_loop`)."""
        if self._operator is None:
            return True
        self.show_plan(plan, "Print this repair?")
        return self._operator.ask() is OperatorAnswer.APPROVE

    def ask(self, decision: Decision) -> bool:
        """Show why the run rests and wait: Approve goes on all the same, Skip ends it."""
        if self._operator is None:
            return False
        why = [f"- {line}" for line in decision.told]
        self._found.content = "\n".join(["**Go on all the same?** (Skip ends the run)", *why])
        return self._operator.ask() is OperatorAnswer.APPROVE

    def record(self, look: Look) -> None:
        """Show a look with its outcome (the `record` of `run_loop`)."""
        decision = decision_of(look)
        self.show_plan(look.plan, f"{look_label(look)}: {decision.choice}", decision.reasons)
        if self._operator is not None:
            self._operator.wait_while_paused()

    def _toggle_pause(self, operator: Operator) -> None:
        """Pause or go on; what the printer has against it is said here: nobody else hears it."""
        try:
            operator.toggle_pause()
        except GcodeError as error:
            now = "The run rests before its next part" if operator.paused else "The run goes on"
            self._stage.content = f"**{now}**, but the printer: {error}"

    def _show_operator(self) -> None:
        assert self._operator is not None
        asked, paused = self._operator.asked, self._operator.paused
        self._approve.disabled = self._skip.disabled = not asked
        self._pause.label = "Go on" if paused else "Pause"
        if asked:
            self._stage.content = "**Waiting for you**: approve or skip this repair."
        elif paused:
            self._stage.content = "**Paused**: the nozzle is lifted after the line under way."

    # ---- the scene --------------------------------------------------------------------------

    def _look_at(self, points_mm: np.ndarray) -> None:
        """The first thing shown is put where the camera looks; everything else lies around it."""
        if self._centre is not None:
            return
        low, high = points_mm.min(axis=0), points_mm.max(axis=0)
        self._centre = 0.5 * (low + high)
        self._centre[2] = low[2]
        size_mm = float(np.linalg.norm(high - low))
        camera = self.server.initial_camera
        camera.position = tuple(1.3 * size_mm * np.array([-0.55, -0.75, 0.55]))
        camera.look_at = (0.0, 0.0, 0.4 * float(high[2] - low[2]))
        camera.near, camera.far = 0.01 * size_mm, 20.0 * size_mm
        self.server.scene.add_grid(
            "/bed", width=3 * size_mm, height=3 * size_mm, cell_size=10.0, section_size=50.0
        )

    def _local(self, points_mm: np.ndarray) -> np.ndarray:
        """Around the centre, in single precision."""
        assert self._centre is not None
        return (points_mm - self._centre).astype(np.float32)

    def _switch(self, name: str, handle: Any) -> None:
        """A box to show and hide one thing."""
        if handle is None:
            return
        old = self._switches.get(name)
        if old is None:
            with self._folder:
                old = self.server.gui.add_checkbox(name, True)
            self._switches[name] = old
            old.on_update(lambda _: self._apply(name))
        self._handles[name] = handle
        self._apply(name)

    def _apply(self, name: str) -> None:
        if name in self._handles:
            self._handles[name].visible = self._switches[name].value

    def _remove(self, name: str) -> None:
        handle = self._handles.pop(name, None)
        if handle is not None:
            handle.remove()
