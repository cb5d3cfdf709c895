"""The stage: an emulated printer's motion becomes a world, and a scanner looks at it.

`Stage` is the `Scanner` that a simulated loop uses, and the only one who knows the truth: beside
the world with its defects it keeps a reference, printed by the same motion without them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import manifold3d
import numpy as np
from scipy import ndimage

from amrepair.arrays import ColumnMask
from amrepair.loop.probing import ProbeScanner
from amrepair.loop.wire import Wire
from amrepair.scans import Scan, ScanRequest
from amrepair.simulate.columns import Columns, IntervalMap, Window
from amrepair.simulate.defects import PlacedDefect
from amrepair.simulate.options import DEFAULT_TRUTH
from amrepair.simulate.scanner import SimulatedScanner
from amrepair.simulate.world import World
from gcode.firmware.motion import MotionBatch
from gcode.surfaces import HeightField


@dataclass(frozen=True, slots=True)
class DefectTruth:
    """How much of one defect was repaired, as the simulated world itself shows.

    Attributes
    ----------
    kind
        void, under_extrusion, chip, blob.
    label
        The stop at which it was scanned, the last of them.
    missing_mm3
        Volume that it took away, measured against the reference at the stops that saw it happen.
    filled_mm3
        Of that volume, what is solid after the last repair.
    excess_mm3
        Volume that it added.
    added_mm3
        Volume that repairs put where nothing should be: around the defect, where neither the
        reference nor the part as designed has any, beyond what stood out before them.
    surface_ratio
        Share of the area over what was missing whose top is now within half a layer of the
        reference's, give or take a column sideways; 1 where nothing was missing.
    """

    kind: str
    label: str
    missing_mm3: float
    filled_mm3: float
    excess_mm3: float
    added_mm3: float = 0.0
    surface_ratio: float = 1.0


@dataclass(slots=True)
class _Wound:
    """A defect that has happened; what it took away, by the stops at which it was first seen."""

    defect: PlacedDefect
    label: str
    missing: list[IntervalMap]
    standing_out: IntervalMap
    excess_mm3: float
    filled_mm3: float = 0.0
    added_mm3: float = 0.0
    surface_ratio: float = 1.0


class FeltStage:
    """A stage that is not looked at, but touched by the emulated printer's own probe.

    Parameters
    ----------
    probe
        Touches.
    stand
        Has the emulated printer feel what stands there.
    """

    def __init__(
        self, stage: Stage, probe: ProbeScanner, stand: Callable[[HeightField], None]
    ) -> None:
        self._stage, self._probe, self._stand = stage, probe, stand
        self.build_from_scanner = probe.build_from_scanner

    def send_by(self, wire: Wire) -> None:
        """Have the printer move by this wire from now on."""
        self._probe.send_by(wire)

    def scan(self, request: ScanRequest) -> Scan:
        """Lay what was printed since the last look, then touch it."""
        self._stage.lay(request)
        self._stand(self._stage.world.felt())
        return self._probe.scan(request)


class Stage:
    """A simulated scanner over a world that the printer's motion builds.

    Parameters
    ----------
    world
        Empty.
    defects
        Those with layers act on the job's motion; the others on the finished part.
    scanner
        Looks at `world`.
    take_motion
        Hands over what the printer did since it was last asked.
    box_mm
        XY box (x_min, y_min, x_max, y_max) that truth is compared in.
    layer_height_mm
        Of the job: surfaces within half of it of the reference's are as they should be.
    part
        As designed, build frame: what a repair adds within it is not too much, even where the
        reference's own beads left a gap.
    """

    def __init__(
        self,
        world: World,
        *,
        defects: Sequence[PlacedDefect],
        scanner: SimulatedScanner,
        take_motion: Callable[[], MotionBatch],
        box_mm: tuple[float, float, float, float],
        layer_height_mm: float = 0.2,
        part: manifold3d.Manifold | None = None,
    ) -> None:
        self.world = world
        self.reference = world.copy()
        self._defects = tuple(defects)
        self._scanner, self.build_from_scanner = scanner, scanner.build_from_scanner
        self._take_motion = take_motion
        self._box_mm = box_mm
        self._layer_height_mm = layer_height_mm
        self._design: IntervalMap | None = None
        if part is not None:
            ny, nx = world.columns.shape
            design = Columns(
                origin_mm=world.columns.origin_mm,
                size_mm=((nx - 0.5) * world.cell_mm, (ny - 0.5) * world.cell_mm),
                cell_mm=world.cell_mm,
            )
            design.unite(design.rasterise(part))
            self._design = design.snapshot(self._window())
        self._wounds: list[_Wound] = []
        self._stops: list[str] = []
        self._printed = -1.0  # layers of the job, up to this one

    @property
    def truth(self) -> tuple[DefectTruth, ...]:
        """The state of every defect that has happened."""
        return tuple(
            DefectTruth(
                kind=str(wound.defect.kind),
                label=wound.label,
                missing_mm3=sum(missing.volume_mm3 for missing in wound.missing),
                filled_mm3=wound.filled_mm3,
                excess_mm3=wound.excess_mm3,
                added_mm3=wound.added_mm3,
                surface_ratio=wound.surface_ratio,
            )
            for wound in self._wounds
        )

    def scan(self, request: ScanRequest) -> Scan:
        """Lay what was printed since the last look, then look; points in the scanner frame."""
        self.lay(request)
        return self._scanner.scan(request)

    def lay(self, request: ScanRequest) -> None:
        """Lay what was printed since the last look, and let happen what is due."""
        motion = self._take_motion()
        if request.label in self._stops:  # a repair: it is laid in the broken world alone
            self.world.deposit(motion, onto_cold=True)
        else:
            self._stops.append(request.label)
            self._print_job(motion)
            self._break(request)
        self._measure(request.label)

    def finish(self, *, measure: bool = False) -> None:
        """Lay what was printed after the last look.

        Parameters
        ----------
        measure
            Whether to measure the last stop's defects once more: what was too thin for beads of its
            own is filled by the next layer's. The reference takes their flow as well, so that its
            top is too high there by what they fill.
        """
        self._print_job(self._take_motion())
        if measure and self._stops:
            self._measure(self._stops[-1])

    def _print_job(self, motion: MotionBatch) -> None:
        """The same motion, in the world with its defects and in the reference without."""
        flow = [defect for defect in self._defects if len(defect.flow_regions)]
        with ThreadPoolExecutor(2) as pool:
            twin = pool.submit(self.reference.deposit, motion)
            self.world.deposit(motion, flow)
            twin.result()

    def _break(self, request: ScanRequest) -> None:
        """Let the defects of this stop happen, and take their measure."""
        printed = np.inf if request.layer_index is None else float(request.layer_index)
        if request.layers is not None:  # of several objects one is finished
            printed = request.layers - 1.0
        due = [
            d
            for d in self._defects
            if any(self._printed < layer <= printed for layer in d.layers)
            or (d.last_layer == request.layer_index and self._can_happen(d))
        ]
        self._printed = printed
        for defect in due:
            if defect.removed is not None:
                self.world.remove(defect.removed)
            if defect.added is not None:
                self.world.add(defect.added)
        window = self._window()
        mine, other = self.world.snapshot(window), self.reference.snapshot(window)
        missing, excess = other.minus(mine), mine.minus(other)
        for wound in self._wounds:
            for earlier in wound.missing:
                missing = missing.minus(earlier)
        for defect in due:
            own = missing.clipped(defect.box_mm)
            missing = missing.minus(own)
            extra_mm3 = excess.clipped(defect.box_mm).volume_mm3
            begun = next((wound for wound in self._wounds if wound.defect is defect), None)
            if begun is None:
                wound = _Wound(defect, request.label, [own], excess, extra_mm3)
                self._wounds.append(wound)
            else:
                begun.label = request.label
                begun.missing.append(own)

    def _can_happen(self, defect: PlacedDefect) -> bool:
        """Whether a part that it breaks stands there by now, and is whole yet."""
        if any(wound.defect is defect for wound in self._wounds):
            return False
        down = np.where([[1, 1, 0], [1, 1, 1]], defect.box_mm, 0.0)  # to the bed
        standing = self.reference.snapshot(self._window()).clipped(down)
        return bool(len(defect.layers) or standing.volume_mm3 > 0.0)

    def _measure(self, label: str) -> None:
        """How much of this stop's missing volume is solid now, and how even its surface is."""
        wounds = [wound for wound in self._wounds if wound.label == label]
        if not wounds:
            return
        window = self._window()
        standing, wanted = self.world.snapshot(window), self.reference.snapshot(window)
        extra = standing.minus(wanted)
        if self._design is not None:
            extra = extra.minus(self._design)
        even = _even(standing, wanted, 0.5 * self._layer_height_mm)
        around = np.array([[-1.0], [1.0]]) * DEFAULT_TRUTH.spreads_mm
        for wound in wounds:
            wound.filled_mm3 = sum(m.common(standing).volume_mm3 for m in wound.missing)
            added = extra.minus(wound.standing_out).clipped(wound.defect.box_mm + around)
            wound.added_mm3 = added.volume_mm3
            thickness_mm = sum(missing.thickness_mm() for missing in wound.missing)
            over = np.asarray(thickness_mm) > DEFAULT_TRUTH.least_missing_mm
            wound.surface_ratio = float(even[over].mean()) if over.any() else 1.0

    def _window(self) -> Window:
        x0, y0, x1, y1 = self._box_mm
        return self.world.columns.box_window((x0, y0), (x1, y1))


def _even(standing: IntervalMap, wanted: IntervalMap, tolerance_mm: float) -> ColumnMask:
    """Columns whose top is as high as the reference's within a tolerance up, down and sideways.

    Sideways it is one column: at a wall, height says nothing.
    """
    top, should_mm = standing.top_mm(), wanted.top_mm()
    low_mm = ndimage.minimum_filter(should_mm, 3) - tolerance_mm
    high_mm = ndimage.maximum_filter(should_mm, 3) + tolerance_mm
    return np.asarray((top >= low_mm) & (top <= high_mm))
