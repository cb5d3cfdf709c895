"""`ReportData`: everything a report shows, as plain typed values.

It says what a report holds, not how it looks (`page`, `payload`) nor where the values come from
(`collect`). All geometry is in the build frame: bed corner at the origin, Z up, mm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Box, Faces, Numbers, Points, Values, Vertices
from gcode.moves import Extrude, LayerChange, Role, Toolpath
from gcode.surfaces import HeightField


class Outcome(StrEnum):
    """How a run ended, in the words of the report's headline."""

    WITHIN_TOLERANCE = "within_tolerance"
    NOT_WITHIN_TOLERANCE = "not_within_tolerance"
    NOTHING_TO_REPAIR = "nothing_to_repair"
    PLANNED = "planned"  # G-code was made; the part has not been scanned since
    PLANNED_IN_PART = "planned_in_part"  # the same, and the program leaves something
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class SolidMesh:
    """Triangles of a closed surface.

    Attributes
    ----------
    vertices_mm
        (v, 3) build frame.
    faces
        (f, 3) vertex indices, counter-clockwise from outside.
    """

    vertices_mm: Vertices
    faces: Faces


@dataclass(frozen=True, slots=True)
class LeftPart:
    """What a repair leaves open for one cause.

    Attributes
    ----------
    key
        `left_reach`, `left_bead`, `left_covered` or `left_span`: out of the head's reach; too small
        for a bead, or with nothing that holds one; under what stands above it; over a gap too wide
        for a bridge.
    shape
        As columns, the surface of all of them.
    """

    key: str
    volume_mm3: float
    shape: SolidMesh


@dataclass(frozen=True, slots=True)
class BeadPath:
    """The beads of a repair, one segment a row, in the order they are printed.

    Attributes
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions, build frame; the bead hangs below them by its height.
    width_mm, height_mm
        (n,) cross-section as drawn.
    layer
        (n,) index into `layer_top_mm`, rising.
    role
        (n,) index into `roles`.
    layer_top_mm
        (k,) nozzle height of each layer.
    roles
        Names of the roles that occur.
    """

    start_mm: Points
    end_mm: Points
    width_mm: Values
    height_mm: Values
    layer: Numbers
    role: Numbers
    layer_top_mm: Float[np.ndarray, " k"]
    roles: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.layer)

    @classmethod
    def from_toolpath(cls, toolpath: Toolpath) -> BeadPath | None:
        """The beads of a toolpath without its skirt; None where nothing is extruded.

        Layers are told by `LayerChange`; chains before the first one open a layer of their own.
        """
        starts, ends, widths, heights, layers, roles = [], [], [], [], [], []
        names: list[str] = []
        tops_mm: list[float] = []
        pending_top_mm: float | None = None
        for move in toolpath:
            if isinstance(move, LayerChange):
                pending_top_mm = float(move.z_mm)
            elif isinstance(move, Extrude) and move.role is not Role.SKIRT:
                if pending_top_mm is None and not tops_mm:
                    pending_top_mm = float(move.points_mm[0, 2])
                if pending_top_mm is not None:
                    tops_mm.append(pending_top_mm)
                    pending_top_mm = None
                if str(move.role) not in names:
                    names.append(str(move.role))
                points_mm = np.asarray(move.points_mm, dtype=np.float64)
                count = len(points_mm) - 1
                starts.append(points_mm[:-1])
                ends.append(points_mm[1:])
                widths.append(np.full(count, move.width_mm))
                heights.append(np.full(count, move.height_mm))
                layers.append(np.full(count, len(tops_mm) - 1))
                roles.append(np.full(count, names.index(str(move.role))))
        if not starts:
            return None
        return cls(
            start_mm=np.concatenate(starts),
            end_mm=np.concatenate(ends),
            width_mm=np.concatenate(widths),
            height_mm=np.concatenate(heights),
            layer=np.concatenate(layers),
            role=np.concatenate(roles),
            layer_top_mm=np.array(tops_mm),
            roles=tuple(names),
        )


@dataclass(frozen=True, slots=True)
class RegionRow:
    """One defect, as the table shows it.

    Attributes
    ----------
    type
        `void`, `chip`, `blob`, …
    box_mm
        (2, 3) lowest and highest corner, build frame.
    reachable_ratio
        Share of the volume that the nozzle can reach, 0..1, or None where nobody asked.
    note
        Why it was or was not filled, in a sentence.
    """

    type: str
    volume_mm3: float
    box_mm: Box
    reachable_ratio: float | None = None
    note: str = ""


@dataclass(frozen=True, slots=True)
class ReportRule:
    """One row of the decision table: its name there, when it holds, what follows."""

    id: str
    when: str
    then: str


@dataclass(frozen=True, slots=True)
class ReportDecision:
    """One decision with its reasons.

    Attributes
    ----------
    where
        Such as `Layer 80, z = 16.0 mm`.
    choice
        Such as `fill now`.
    reasons
        Whole sentences.
    rules
        The rows of the decision table that led to it; none where no table was asked.
    """

    where: str
    choice: str
    reasons: tuple[str, ...]
    rules: tuple[ReportRule, ...] = ()


@dataclass(frozen=True, slots=True)
class Counter:
    """A number from the wire and what it means."""

    name: str
    value: float
    meaning: str = ""


@dataclass(frozen=True, slots=True)
class TemperatureSeries:
    """A heater over the run.

    Attributes
    ----------
    time_s
        (n,) the printer's clock, s.
    measured_c, target_c
        (n,) °C; target is None where it is not known.
    """

    name: str
    time_s: Values
    measured_c: Values
    target_c: Values | None = None


@dataclass(frozen=True, slots=True)
class ReportLook:
    """One scan and what followed from it.

    Attributes
    ----------
    label
        Such as `Layer 80, before repair`.
    points_mm
        (n, 3) scan points, build frame.
    deviation_mm
        (n,) signed distance to the expected surface, negative inside: material is missing.
    label_of_point
        (n,) 0 ok, 1 missing, 2 excess (`detect.Label`).
    threshold_mm
        The limit that the detection used.
    normals
        (n, 3) unit normals or None; they only shade the drawing.
    unseen_mm
        (u, 3) points of the expected surface that no ray reached.
    missing, excess
        Solids, or None where there is none.
    beads
        What was printed after this look, or None.
    left
        What the repair after this look does not fill, by cause.
    missing_mm3, excess_mm3
        Volumes at this look, as measured.
    height_map
        The top surface at this look, or None; cells that are not `seen` are drawn as unknown.
    outlines_mm
        (k, 2) each: closed XY outlines of the defects, drawn over it.
    stop
        What the looks at one stop of a job have in common; they are compared with each other.
    scanned_points
        How many points the scan had, where `points_mm` are only some; 0 where they are all.
    smallest_mm
        Areas, mm², each with the least depth that the scan would show over it, mm.
    noise
        What the scan tells of its own errors and of the part as a whole, sentences.
    """

    label: str
    points_mm: Points
    deviation_mm: Values
    label_of_point: Numbers
    threshold_mm: float
    normals: Points | None = None
    unseen_mm: Float[np.ndarray, "u 3"] | None = None
    missing: SolidMesh | None = None
    excess: SolidMesh | None = None
    beads: BeadPath | None = None
    left: tuple[LeftPart, ...] = ()
    missing_mm3: float = 0.0
    excess_mm3: float = 0.0
    height_map: HeightField | None = None
    outlines_mm: tuple[Float[np.ndarray, "_ 2"], ...] = ()
    stop: str = ""
    scanned_points: int = 0
    smallest_mm: tuple[tuple[float, float], ...] = ()
    noise: str = ""


MAY_BE_UNKNOWN = ("missing_mm3_after", "excess_mm3_after", "repaired_ratio")


@dataclass(frozen=True, slots=True)
class Figures:
    """The figures of a run that a person asks for first; None where they are not known.

    Attributes
    ----------
    looked
        Whether a scan of the part was had at all; a loop whose scanner is silent has none.
    passed_by
        Looks that were due and had no scan.
    """

    missing_mm3_before: float
    missing_mm3_after: float | None
    excess_mm3_before: float
    excess_mm3_after: float | None
    repaired_ratio: float | None
    unreachable_mm3: float
    unseen_area_mm2: float
    iterations: int
    filament_mm: float
    print_time_s: float
    unprintable_mm3: float = 0.0
    covered_mm3: float = 0.0
    looked: bool = True
    passed_by: tuple[str, ...] = ()

    @classmethod
    def from_result(cls, result: Mapping[str, object]) -> Figures:
        """The figures of a `--json` result of `simulate`, `repair` or `loop`."""
        names = [one.name for one in fields(cls) if one.name not in ("looked", "passed_by")]
        told: dict[str, Any] = {name: _number(result, name) for name in names}
        told |= {name: value or 0.0 for name, value in told.items() if name not in MAY_BE_UNKNOWN}
        looked, passed = result.get("stops") != [], result.get("passed_by")
        if not looked:
            told |= {"missing_mm3_before": math.nan, "missing_mm3_after": None}
        return cls(
            **told | {"iterations": int(told["iterations"])},
            looked=looked,
            passed_by=tuple(map(str, passed)) if isinstance(passed, list) else (),
        )


@dataclass(frozen=True, slots=True)
class ReportData:
    """Everything that one report shows.

    Attributes
    ----------
    title
        Name of the part or the run.
    setup
        Such as printer, material, process, command: shown under the title, in order.
    expected
        The part as it should be, or None.
    looks
        Scans in the order they were taken.
    compare
        Indices of the looks shown side by side at first; None picks the one with most missing
        and the last at its stop.
    seconds
        Time spent by stage.
    provenance
        Versions, profile hashes, seed: what another person needs to repeat the run.
    """

    title: str
    outcome: Outcome
    figures: Figures
    looks: tuple[ReportLook, ...]
    setup: Mapping[str, str] = field(default_factory=dict)
    expected: SolidMesh | None = None
    regions: tuple[RegionRow, ...] = ()
    decisions: tuple[ReportDecision, ...] = ()
    wire: tuple[Counter, ...] = ()
    temperatures: tuple[TemperatureSeries, ...] = ()
    compare: tuple[int, int] | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)


def regions_from_result(result: Mapping[str, object]) -> tuple[RegionRow, ...]:
    """The `regions` of a `--json` result."""
    rows = result.get("regions")
    if not isinstance(rows, (list, tuple)):
        return ()
    return tuple(
        RegionRow(
            type=str(row["type"]),
            volume_mm3=float(row["volume_mm3"]),
            box_mm=np.asarray(row["box_mm"], dtype=np.float64).reshape(2, 3),
            reachable_ratio=_number(row, "reachable_ratio"),
        )
        for row in rows
    )


def _number(result: Mapping[str, object], key: str) -> float | None:
    value = result.get(key)
    return float(value) if isinstance(value, (int, float)) and not math.isnan(value) else None
