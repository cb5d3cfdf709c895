"""What a printer, a material and a process profile say: keys, units and ranges.

It does not read files (`store`) and knows no slicer's own format (`importers`).
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from gcode.dialects import DIALECTS
from gcode.errors import ProfileError


def _known_dialect(name: str) -> str:
    if name not in DIALECTS:
        raise ValueError(f"it is one of {', '.join(map(repr, DIALECTS))}")
    return name


DialectName = Annotated[str, AfterValidator(_known_dialect)]
Positive = Annotated[float, Field(gt=0)]
Ratio = Annotated[float, Field(ge=0, le=1)]
Xy = tuple[float, float]
Xyz = tuple[float, float, float]
_ROUND_SIDES = 48  # 0.2 % beyond the circle
_CONE_STEP_MM = 0.1


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class _Profile(_Strict):
    id: str
    name: str
    sha256: str = ""


class AxisLimits(_Strict):
    """A limit by axis."""

    x: Positive
    y: Positive
    z: Positive
    e: Positive

    @property
    def xyze(self) -> tuple[float, float, float, float]:
        """All four, in this order."""
        return self.x, self.y, self.z, self.e


class EnvelopeSlice(_Strict):
    """A height range of the tool head as a convex polygon around the nozzle's axis.

    `polygon_mm` is relative to the nozzle tip, counter-clockwise; the slice occupies
    `z_from_mm` to the next slice's `z_from_mm` above the tip (the last one: up to infinity).
    Over a height field, whose columns are solid down to the bed, only the side that looks down
    matters. In a file, `radius_mm` (about the axis) or `box_mm` (x0, y0, x1, y1) may stand for the
    polygon. A cone widens from `radius_mm` at `z_from_mm` to `radius_to_mm` at `z_to_mm`.

    Attributes
    ----------
    widening_mm
        How far a cone's upper rim lies outside of the polygon; 0: none.
    z_to_mm
        Height of that rim above the tip.
    """

    part: Literal["nozzle", "block", "duct", "carriage", "gantry"]
    z_from_mm: Annotated[float, Field(ge=0)]
    polygon_mm: Annotated[tuple[Xy, ...], Field(min_length=3)]
    widening_mm: Annotated[float, Field(ge=0)] = 0.0
    z_to_mm: float | None = None

    @model_validator(mode="before")
    @classmethod
    def _outline(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "polygon_mm" in data:
            return data
        short = {"radius_mm", "radius_to_mm", "box_mm"}
        rest = {key: value for key, value in data.items() if key not in short}
        if "radius_to_mm" in data:
            rest["widening_mm"] = float(data["radius_to_mm"]) - float(data.get("radius_mm", 0.0))
        if "radius_mm" in data:
            corner_mm = float(data["radius_mm"]) / math.cos(math.pi / _ROUND_SIDES)
            angles = [2 * math.pi * (k + 0.5) / _ROUND_SIDES for k in range(_ROUND_SIDES)]
            rest["polygon_mm"] = [
                (round(corner_mm * math.cos(a), 4), round(corner_mm * math.sin(a), 4))
                for a in angles
            ]
        elif "box_mm" in data:
            x0, y0, x1, y1 = data["box_mm"]
            rest["polygon_mm"] = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        return rest

    @field_validator("polygon_mm")
    @classmethod
    def _convex(cls, polygon: tuple[Xy, ...]) -> tuple[Xy, ...]:
        n = len(polygon)
        for k in range(n):
            (ax, ay), (bx, by), (cx, cy) = polygon[k], polygon[(k + 1) % n], polygon[(k + 2) % n]
            if (bx - ax) * (cy - by) - (by - ay) * (cx - bx) < -1e-9:
                raise ValueError("must be a convex polygon, counter-clockwise")
        return polygon

    @model_validator(mode="after")
    def _upward(self) -> EnvelopeSlice:
        if (self.z_to_mm is None) != (self.widening_mm == 0):
            raise ValueError("a cone has both radius_to_mm, more than radius_mm, and z_to_mm")
        if self.z_to_mm is not None and self.z_to_mm <= self.z_from_mm:
            raise ValueError(f"z_to_mm must be more than z_from_mm ({self.z_from_mm:g})")
        return self

    @property
    def is_tip(self) -> bool:
        """Whether it is the flat around the bore."""
        return self.z_from_mm < 1e-9

    @property
    def height_mm(self) -> float:
        """Of a cone, from rim to rim; 0: none."""
        return 0.0 if self.z_to_mm is None else self.z_to_mm - self.z_from_mm

    @property
    def reach_mm(self) -> float:
        """How far from the axis it reaches in X or Y, its rim included."""
        return max(abs(v) for corner in self.polygon_mm for v in corner) + self.widening_mm

    @property
    def steps(self) -> tuple[EnvelopeSlice, ...]:
        """A cone as slices that do not widen, no more than half a step off it; others as is."""
        if self.widening_mm == 0:
            return (self,)
        count = math.ceil(self.height_mm / _CONE_STEP_MM)
        rim_mm = max(math.hypot(x, y) for x, y in self.polygon_mm)
        found = []
        for k in range(count + 1):
            wider = 1.0 + self.widening_mm * k / count / rim_mm
            polygon_mm = tuple((x * wider, y * wider) for x, y in self.polygon_mm)
            z_mm = self.z_from_mm + self.height_mm * max(k - 0.5, 0.0) / count
            found.append(EnvelopeSlice(part=self.part, z_from_mm=z_mm, polygon_mm=polygon_mm))
        return tuple(found)


class StartMacro(_Strict):
    """A macro of the machine's own that homes all axes, heats, and waits for both heaters.

    `hotend` and `bed` are the parameters that tell it how hot.
    """

    name: str
    hotend: str
    bed: str


class ProbeProfile(_Strict):
    """A probe that feels plastic, for whoever touches what stands on the bed.

    What senses metal or a sheet (inductive, optical) feels no part: a printer with such a one has
    no probe here. It is not inherited: a child is another machine.

    Attributes
    ----------
    kind
        `nozzle`: the nozzle itself feels (load cell, strain gauge, contact); `pin`: one beside it.
    command
        Whose depth the host sets: `G38.2` (Marlin with G38_PROBE_TARGET, RepRapFirmware) or
        `AMREPAIR_TOUCH` (a macro around Klipper's PROBE).
    offset_mm
        Of the tip that feels from the nozzle's: x, y, and z, 0 or below.
    tip_radius_mm
        Of the flat that meets the part: it feels the highest place below it.
    sigma_mm
        Standard deviation of one touch, until repeated touches tell.
    speed_mm_s
        Downwards, while it feels.
    depth_mm
        Deepest that a touch may go below what it is to feel.
    cold_c
        A nozzle that feels is no warmer: plastic gives way, and what oozes is felt for the part.
    """

    kind: Literal["nozzle", "pin"]
    command: Literal["G38.2", "AMREPAIR_TOUCH"]
    offset_mm: tuple[float, float, Annotated[float, Field(ge=-10, le=0)]] = (0.0, 0.0, 0.0)
    tip_radius_mm: Annotated[float, Field(gt=0, le=3)]
    sigma_mm: Annotated[float, Field(gt=0, le=0.2)]
    speed_mm_s: Annotated[float, Field(gt=0, le=4)]
    depth_mm: Annotated[float, Field(gt=0, le=3)]
    cold_c: Annotated[float, Field(ge=40, le=160)] = 60.0

    @model_validator(mode="after")
    def _nozzle_is_itself(self) -> ProbeProfile:
        if self.kind == "nozzle" and any(self.offset_mm):
            raise ValueError("a nozzle that feels has offset_mm 0, 0, 0")
        return self


class PrinterProfile(_Profile):
    """A machine: what it can reach, how fast, how hot, and in which words it is spoken to."""

    dialect: DialectName
    bed_size_mm: tuple[Positive, Positive]
    bed_min_mm: Xy = (0.0, 0.0)  # its corner of least X and Y; beds about the origin have one below
    delta: bool = False  # three towers: the bed is round, homing lifts the head to their tops
    homes_up: bool = False  # homing Z takes the nozzle away from the bed
    ends_homing: bool = False  # so its maker's end script does over the part, which shows no more
    max_z_mm: Positive
    reach_min_mm: Xy | None = None  # where the nozzle may go off the bed (purge, wiper); the bed
    reach_max_mm: Xy | None = None  # itself where left out
    off_bed_mm: Annotated[float, Field(ge=0, le=100)] = 0.0  # a user's job may, where nobody knows
    nozzle_diameter_mm: Annotated[float, Field(ge=0.1, le=10.0)]  # pellets' are wide
    heads: Annotated[int, Field(ge=1, le=64)] = 1  # that T0, T1, … choose, each heated by itself,
    tool: Annotated[int, Field(ge=0, lt=64)] = 0  # of them, that programs of ours take
    one_nozzle: bool = False  # or filaments to one nozzle
    filament_diameter_mm: Annotated[float, Field(ge=1.0, le=3.5)] = 1.75
    max_speed_mm_s: AxisLimits
    max_acceleration_mm_s2: AxisLimits
    max_jerk_mm_s: AxisLimits
    max_hotend_c: Annotated[float, Field(gt=0, le=500)]
    max_bed_c: Annotated[float, Field(ge=0, le=200)]
    max_volumetric_mm3_s: Positive
    min_extrude_c: Annotated[float, Field(ge=0)] = 170.0
    max_bead_section_mm2: Positive
    max_extrude_only_mm: Positive
    travel_speed_mm_s: Positive
    z_speed_mm_s: Positive
    retraction_mm: Annotated[float, Field(ge=0, le=30)]
    retraction_speed_mm_s: Positive
    z_hop_mm: Annotated[float, Field(ge=0, le=5)]
    park_mm: Xyz
    prime_mm: Xyz
    prime_length_mm: Annotated[float, Field(ge=0)]
    envelope: tuple[EnvelopeSlice, ...]  # empty: nobody has measured it
    probe: ProbeProfile | None = None  # that feels plastic
    baud: int = 115200
    start_gcode: tuple[str, ...]
    end_gcode: tuple[str, ...]
    macros: tuple[str, ...] = ()  # commands of this machine beyond its firmware's own
    start_macro: StartMacro | None = None
    end_macro: str | None = None  # switches both heaters off
    slicer_names: tuple[str, ...] = ()  # as slicers call it; capitals, no spaces or dashes, * any

    @field_validator("start_gcode", "end_gcode", mode="before")
    @classmethod
    def _lines(cls, value: Any) -> Any:
        return value.strip().splitlines() if isinstance(value, str) else value

    @property
    def feeler(self) -> ProbeProfile:
        """The probe, for whoever touches what stands there.

        Raises
        ------
        ProfileError
            If it has none that feels plastic.
        """
        if self.probe is None:
            raise ProfileError(
                f"{self.name} has no probe that feels plastic in its profile: write '[probe]' into "
                "a profile of your own that inherits this one, where it has a load cell, a strain "
                "gauge or a pin, and its firmware a touch whose depth can be told (G38.2, or "
                "Klipper with the macro AMREPAIR_TOUCH)."
            )
        return self.probe

    @property
    def head(self) -> tuple[EnvelopeSlice, ...]:
        """The tool head's shape, for whoever goes near what stands there.

        Raises
        ------
        ProfileError
            If nobody has measured it.
        """
        if not self.envelope:
            raise ProfileError(
                f"The shape of {self.name}'s tool head is not known (its 'envelope' is empty), so "
                "nothing can be printed on or beside what stands there; measure it, and write it "
                "into a profile of your own that inherits this one."
            )
        return self.envelope

    @property
    def nozzles(self) -> int:
        """How many heads there are with a heater and a nozzle of their own."""
        return 1 if self.one_nozzle else self.heads

    @property
    def docks(self) -> bool:
        """Whether a head must be taken, or its own heater chosen, before it prints."""
        return self.nozzles > 1

    @property
    def bed_box_mm(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max) of the bed."""
        (x, y), (width, depth) = self.bed_min_mm, self.bed_size_mm
        return x, y, x + width, y + depth

    @property
    def bed_middle_mm(self) -> tuple[float, float]:
        """X and Y of the bed's middle."""
        x0, y0, x1, y1 = self.bed_box_mm
        return 0.5 * (x0 + x1), 0.5 * (y0 + y1)

    @property
    def reach_box_mm(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max) where the nozzle may go; at least the bed."""
        x0, y0, x1, y1 = self.bed_box_mm
        low = self.reach_min_mm or (x0, y0)
        high = self.reach_max_mm or (x1, y1)
        return min(low[0], x0), min(low[1], y0), max(high[0], x1), max(high[1], y1)


class MaterialProfile(_Profile):
    """A filament: temperatures, cooling, flow and what the bed must keep to hold the part."""

    density_g_cm3: Positive
    hotend_c: Positive
    first_layer_hotend_c: Positive
    bed_c: Annotated[float, Field(ge=0)]
    bed_release_c: Annotated[float, Field(ge=0)]
    fan_ratio: Ratio
    flow_ratio: Annotated[float, Field(ge=0.5, le=1.5)] = 1.0
    max_volumetric_mm3_s: Positive
    repair_first_bead_delta_c: Annotated[float, Field(ge=0, le=30)] = 0.0
    # the longest strand over air: OrcaSlicer's `max_bridge_length`, beyond which it supports them
    max_bridge_mm: Annotated[float, Field(ge=0, le=100)] = 10.0
    # one of length L sags by this times L²: 3D Orchard's table of gaps, up to 0.2 mm at 20 mm
    bridge_sag_per_mm: Annotated[float, Field(ge=0, le=0.01)] = 0.0005
    bridge_fan_ratio: Ratio | None = None  # over air; as ever where left out


class ProcessProfile(_Profile):
    """How a solid becomes beads."""

    layer_height_mm: Annotated[float, Field(ge=0.02, le=1.5)]
    first_layer_height_mm: Annotated[float, Field(ge=0.02, le=1.5)]
    line_width_mm: Annotated[float, Field(ge=0.1, le=3.0)]
    perimeters: Annotated[int, Field(ge=1, le=20)]
    infill_ratio: Ratio
    infill_pattern: Literal["rectilinear", "grid", "concentric"] = "rectilinear"
    top_layers: Annotated[int, Field(ge=0, le=100)]
    bottom_layers: Annotated[int, Field(ge=0, le=100)]
    skirt_loops: Annotated[int, Field(ge=0, le=20)]
    skirt_distance_mm: Annotated[float, Field(ge=0, le=50)]
    perimeter_speed_mm_s: Positive
    external_perimeter_speed_mm_s: Positive
    infill_speed_mm_s: Positive
    solid_infill_speed_mm_s: Positive
    first_layer_speed_mm_s: Positive
    repair_speed_mm_s: Positive
    bridge_speed_mm_s: Positive | None = None  # of strands over air; a repair's where left out
    acceleration_mm_s2: Positive
    max_gap_layers: Annotated[float, Field(ge=1, le=4)] = 2.0
    # of ways to lay a patch the best fills most, less what is too much and the time that it takes
    repair_spill_weight: Annotated[float, Field(ge=0, le=10)] = 1.0  # to a volume that is filled
    repair_worth_mm3_s: Annotated[float, Field(ge=0, le=1)] = 0.002  # to fill for each second more
    nonplanar_top: bool = False  # patches end along gentle slopes instead of in steps
    unasked_max_mm3: Positive = 500.0  # the most that a repair may be printed of without asking
    unasked_max_s: Positive = 1800.0
    unasked_min_reachable_ratio: Ratio = 0.5
