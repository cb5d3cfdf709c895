"""A small job, its template, scans of what stands there: what the tests of the loop share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
import trimesh

from amrepair.frames import Transform
from amrepair.loop import Approval, LoopOptions, LoopReport, Records, Stop, plan_stops, run_loop
from amrepair.loop.sites import sites
from amrepair.scans import Scan, ScanRequest
from amrepair.template import MeshSdf
from gcode.check import CheckedProgram, check
from gcode.hosts.file import FilePrinter
from gcode.profiles import PrintSetup, load_setup
from gcode.progress import Progress, silent
from gcode.reader import Job, read_job
from gcode.slicing.job import plan_part
from gcode.writer import write

PLACE_MM = (100.0, 90.0, 0.0)
SIZE_MM = (16.0, 12.0, 1.6)
LAYER = 4


def solid_mesh(solid: m3.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))


def scan_of(
    solid: m3.Manifold,
    seed: int = 1,
    *,
    sigma_mm: float = 0.02,
    spacing_mm: float = 0.25,
    count: int | None = None,
) -> Scan:
    """A cloud of a solid's surface with a little noise, and its normals.

    Of so many points, or as many as lie `spacing_mm` apart.
    """
    mesh = solid_mesh(solid)
    count = count or int(mesh.area / spacing_mm**2)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    rng = np.random.default_rng(seed)
    noisy = np.asarray(points) + rng.normal(scale=sigma_mm, size=points.shape)
    normals = np.asarray(mesh.face_normals)[faces].astype(np.float32).astype(np.float64)
    return Scan(noisy, sigma_mm, "scanner", normals)


@dataclass(frozen=True)
class Small:
    """The job, ready to be printed."""

    setup: PrintSetup
    part: m3.Manifold
    template: MeshSdf
    job: Job
    checked: CheckedProgram
    placed: Transform

    @classmethod
    def made(cls, process: str = "repair_0.20", height_mm: float = SIZE_MM[2]) -> Small:
        setup = load_setup("prusa_mk3s", "pla", process)
        part = m3.Manifold.cube((*SIZE_MM[:2], height_mm))
        toolpath = plan_part(part.translate(PLACE_MM), setup).toolpath
        program = write(toolpath, setup, title="small")
        placed = Transform.from_rotation_translation(
            "build", "template", rotation=np.eye(3), translation_mm=np.array(PLACE_MM)
        )
        return cls(
            setup,
            part,
            MeshSdf.from_mesh(solid_mesh(part)),
            read_job(program, dialect=program.dialect),
            check(program, setup),
            placed,
        )

    @property
    def top_mm(self) -> float:
        return self.job.layers[LAYER].z_mm

    @property
    def standing(self) -> m3.Manifold:
        """What should stand after the layer, build frame."""
        return self.part.trim_by_plane((0.0, 0.0, -1.0), -self.top_mm).translate(PLACE_MM)

    def block(self, low_mm: float, high_mm: float, size_mm: float = 6.0) -> m3.Manifold:
        """A block over the part's middle, heights above the layer's top."""
        cube = m3.Manifold.cube((size_mm, size_mm, high_mm - low_mm))
        return cube.translate((105.0, 93.0, self.top_mm + low_mm))

    pose = Transform.identity("build", "scanner")

    def run(
        self,
        folder: Path,
        scans: Callable[[int], Scan] | Callable[[ScanRequest], Scan],
        *,
        stops: Sequence[Stop] | None = None,
        progress: Progress = silent,
        **named: Any,
    ) -> tuple[LoopReport, list[str]]:
        """Print with one stop, or those given; the report, and every line that was sent.

        `scans` is asked for the n-th scan, or, with stops, for what is requested. What is `named`
        are fields of the loop's options, of its approval and of its records.
        """
        folder.mkdir(exist_ok=True)
        printer = Thermal(folder / "sent.gcode")
        printer.connect()
        eye = Scripted(scans, by_request=stops is not None)
        try:
            report = run_loop(
                self.job,
                self.checked,
                printer,
                eye,
                sites(self.job, self.template, self.placed, self.setup, by_beads=False),
                stops=plan_stops(self.job, [LAYER], final=False) if stops is None else stops,
                options=LoopOptions(**_some(LoopOptions, named)),
                approval=Approval(**_some(Approval, named)),
                records=Records(**_some(Records, named)),
                progress=progress,
            )
        finally:
            printer.close()
        lines = (folder / "sent.gcode").read_text().splitlines()
        return report, [*lines, *["heaters off"] * printer.switched_off]


def _some(record: type, named: dict[str, Any]) -> dict[str, Any]:
    """Those of the named values that are fields of a record."""
    assert set(named) <= {f.name for kind in (LoopOptions, Approval, Records) for f in fields(kind)}
    return {f.name: named[f.name] for f in fields(record) if f.name in named}


class Thermal(FilePrinter):
    """A file that remembers whether its heaters were switched off."""

    switched_off = 0

    def heaters_off(self) -> None:
        self.switched_off += 1


class Scripted:
    """A scanner that gives the n-th scan of a script."""

    def __init__(self, scans: Callable[[Any], Scan], *, by_request: bool = False) -> None:
        self._scans, self._count, self._by_request = scans, 0, by_request

    @property
    def build_from_scanner(self) -> Transform:
        return Transform.identity("build", "scanner")

    def scan(self, request: ScanRequest) -> Scan:
        self._count += 1
        return self._scans(request if self._by_request else self._count)
