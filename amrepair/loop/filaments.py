"""Which of several filaments a job holds at a line, and which of them laid what is missing there.

They go to one nozzle, or each of several heads has its own; what nozzle it is of counts as well.

Their materials are those that the slicer wrote into the job; nothing is measured here.
"""

from __future__ import annotations

import functools

import numpy as np

from amrepair.repair import RepairPlan
from gcode.profiles.importers.jobs import read_settings
from gcode.reader import Job

AROUND_MM = 0.5
"""How far around what is missing its neighbours' beads are asked: about one bead."""


def other_material(plan: RepairPlan, job: Job, line: int) -> str:
    """Which material is in the nozzle after lines [0, line), where it is not what is missing.

    Of beads around what is to be filled the most plastic counts. Empty where it is the same, or
    where the job does not tell: other colours of one material are no other material.
    """
    materials = materials_of(job.program.text)
    if len(set(materials)) < 2 or not plan.to_fill:
        return ""
    beads = job.beads
    tools = job.tools
    tool, now = tools[beads.line], int(tools[line])
    middle_mm = 0.5 * (beads.start_mm + beads.end_mm)
    volume_mm3 = beads.section_mm2 * np.linalg.norm(beads.end_mm - beads.start_mm, axis=1)
    near = np.zeros(len(tool), dtype=bool)
    for region in plan.to_fill:
        low, high = np.asarray(region.box_mm) + np.array([[-AROUND_MM], [AROUND_MM]])
        near |= ((middle_mm >= low) & (middle_mm <= high)).all(axis=1)
    near &= (tool < len(materials)) & (beads.line < line)
    if not near.any():
        return ""
    laid_mm3 = np.bincount(tool[near], volume_mm3[near], minlength=len(materials))
    kinds = sorted(set(materials))
    missing = max(kinds, key=lambda kind: laid_mm3[np.array(materials) == kind].sum())
    held = materials[now] if now < len(materials) else missing
    return "" if held == missing else f"{held} (T{now}), not {missing}"


@functools.lru_cache(maxsize=1)
def materials_of(text: str) -> tuple[str, ...]:
    """The material of each of a job's filaments, in their slicer's words; empty where untold.

    Where they go to nozzles of several widths these are told, too: none lays another's bead.
    """
    settings = read_settings("job", text)
    values = {} if settings is None else settings[1].values
    told, nozzles = values.get("filament_type", ""), values.get("nozzle_diameter", "").split(",")
    names = tuple(name.strip().strip('"') for name in told.split(";")) if told else ()
    if len(set(nozzles)) < 2 or len(nozzles) != len(names):
        return names
    return tuple(f"{name} by {mm.strip()} mm" for name, mm in zip(names, nozzles, strict=True))
