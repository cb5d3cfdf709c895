"""A plate as a job, and what a probe would feel of it: no printer, no world."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from amrepair.loop import Stop
from amrepair.loop.probing import ProbeScanner
from amrepair.loop.travel import park
from amrepair.loop.wire import Wire
from amrepair.repair import RepairPlan, Site, plan_repair
from amrepair.scans import ScanRequest
from amrepair.simulate.run import PreparedRun, prepare_run
from amrepair.template import MeshSdf
from gcode.firmware.contact import ProbeContact
from gcode.moves import ModalState
from gcode.profiles import load_setup
from gcode.resumption.head import state_at_rest
from gcode.surfaces import HeightField

CELL_MM = 0.1
Hole = tuple[float, float, float, float]
"""X, Y and radius from the plate's middle, and depth, mm."""


def plate(
    size_mm: tuple[float, float, float] = (30.0, 20.0, 3.0), *, printer: str = "generic_marlin"
) -> PreparedRun:
    """A plate in the middle of the bed, of solid layers of 0.2 mm."""
    mesh = trimesh.creation.box(extents=size_mm)
    setup = load_setup(printer, "pla", "repair_0.20")
    return prepare_run(MeshSdf.from_mesh(mesh), setup, [], title="plate")


def standing(run: PreparedRun, stop: Stop, *holes: Hole, rough_mm: float, seed: int) -> HeightField:
    """A plate up to a stop's height: its beads' roughness, and holes with steep walls."""
    box = run.part.bounding_box()
    rng = np.random.default_rng([seed, 7])
    nx, ny = (int(np.ceil((box[3 + k] - box[k]) / CELL_MM)) for k in (0, 1))
    z_mm = stop.z_mm + rng.normal(0.0, rough_mm, (ny, nx))
    x = box[0] + (np.arange(nx) + 0.5) * CELL_MM - 0.5 * (box[0] + box[3])
    y = box[1] + (np.arange(ny) + 0.5) * CELL_MM - 0.5 * (box[1] + box[4])
    for x_mm, y_mm, radius_mm, depth_mm in holes:
        z_mm[np.hypot(*np.meshgrid(x - x_mm, y - y_mm)) < radius_mm] -= depth_mm
    return HeightField(np.array(box[:2]), CELL_MM, z_mm, np.ones(z_mm.shape, bool))


class FieldFeeler:
    """Touches answered by a height field; no program is sent (`Feeler`)."""

    def __init__(self, run: PreparedRun, field: HeightField, *, seed: int = 0) -> None:
        self._contact = ProbeContact.of(run.setup.printer.feeler, field, seed=seed)
        self.asked_mm: list[np.ndarray] = []

    def send_by(self, wire: Wire) -> None:
        """Nothing is sent."""

    def get_ready(self, rest: ModalState) -> None:
        """Nothing is hot."""

    def get_back(self, rest: ModalState) -> None:
        """Nothing was."""

    def feel(
        self,
        places_mm: np.ndarray,
        rest: ModalState,
        standing: HeightField,
        told: Callable[[], None],
    ) -> np.ndarray:
        """What the field has."""
        self.asked_mm.append(places_mm[:, :2])
        met = [self._contact.met_at_mm(float(x), float(y)) for x, y, _ in places_mm]
        return np.array(met, dtype=float)


def prober(
    run: PreparedRun, field: HeightField, *, seed: int = 0
) -> tuple[ProbeScanner, FieldFeeler]:
    """The scanner over such a field."""
    feeler = FieldFeeler(run, field, seed=seed)
    return ProbeScanner(feeler, run.job, run.setup, clock=lambda: 0.0), feeler


def judged(scanner: ProbeScanner, run: PreparedRun, site: Site, stop: Stop) -> RepairPlan:
    """One look, as the loop judges it."""
    assert site.build_from_template is not None
    scan = scanner.scan(ScanRequest(stop.label, stop.layer_index, stop.z_mm))
    guess = site.build_from_template.inverse() @ scanner.build_from_scanner
    _, rest = park(run.setup, state_at_rest(run.job, stop.line))
    return plan_repair(scan, site, title="a look", guess=guess, interruption=rest, strict=False)
