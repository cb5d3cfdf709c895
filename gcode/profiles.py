"""Printer, material and process profiles: load, inherit, validate.

A profile is a TOML file under `profiles/` or a path of the user's. Unknown keys and values out
of range are refused naming file, key, value and range. Nothing here talks to a printer.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

DialectName = Literal["marlin", "prusa", "klipper", "reprap"]
Positive = Annotated[float, Field(gt=0)]
Ratio = Annotated[float, Field(ge=0, le=1)]
Xy = tuple[float, float]
Xyz = tuple[float, float, float]


class _Profile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    id: str
    name: str
    sha256: str = ""


class AxisLimits(BaseModel):
    """A limit by axis."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    x: Positive
    y: Positive
    z: Positive
    e: Positive


class EnvelopeSlice(BaseModel):
    """A height range of the tool head as a convex polygon around the nozzle's axis.

    `polygon_mm` is relative to the nozzle tip, counter-clockwise; the slice occupies
    `z_from_mm` to the next slice's `z_from_mm` above the tip (the last one: up to infinity).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    part: Literal["nozzle", "block", "duct", "carriage", "gantry"]
    z_from_mm: Annotated[float, Field(ge=0)]
    polygon_mm: tuple[Xy, ...]


class PrinterProfile(_Profile):
    """A machine: what it can reach, how fast, how hot, and in which words it is spoken to."""

    dialect: DialectName
    bed_size_mm: tuple[Positive, Positive]
    max_z_mm: Positive
    nozzle_diameter_mm: Annotated[float, Field(ge=0.1, le=2.0)]
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
    retraction_mm: Annotated[float, Field(ge=0, le=15)]
    retraction_speed_mm_s: Positive
    z_hop_mm: Annotated[float, Field(ge=0, le=5)]
    park_mm: Xyz
    prime_mm: Xyz
    prime_length_mm: Annotated[float, Field(ge=0)]
    envelope: tuple[EnvelopeSlice, ...]
    baud: int = 115200
    start_gcode: tuple[str, ...]
    end_gcode: tuple[str, ...]


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
    shrinkage_ratio: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    repair_first_bead_delta_c: Annotated[float, Field(ge=0, le=30)] = 0.0


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
    acceleration_mm_s2: Positive
    infill_overlap_ratio: Ratio = 0.15
    max_gap_layers: Annotated[float, Field(ge=1, le=4)] = 2.0
    surface_allowance_mm: Annotated[float, Field(ge=0, le=1)] = 0.05
