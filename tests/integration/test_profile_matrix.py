"""Every shipped printer, material and process together: a small box is sliced and checked."""

from __future__ import annotations

import itertools

import manifold3d as m3
import pytest

from gcode.check import find_refusals
from gcode.profiles import list_profiles, load_setup
from gcode.slicing.job import slice_part
from gcode.writer import write
from tests.draws import draws

# One of each maker and kind of firmware; the others are of a kind with one of these.
EACH_RUN = (
    "generic_marlin", "generic_klipper", "generic_reprap", "anycubic_kobra", "creality_k1",
    "ender_3", "ender_3_v3_ke", "prusa_mini", "prusa_mk3s", "prusa_xl_2t", "voron_2_4",
)  # fmt: skip
SIDE_MM, HIGH_MM = 8.0, 0.8  # infill and two layers after the first


@pytest.mark.parametrize("printer", draws(list_profiles("printers"), *EACH_RUN))
def test_every_material_and_process_slices_and_passes(printer: str) -> None:
    """regression: 125 of 300 were refused for their own prime line, and ASA on a Mini."""
    box = m3.Manifold.cube((SIDE_MM, SIDE_MM, HIGH_MM)).translate((90.0, 90.0, 0.0))
    wrong = {}
    measured = load_setup(printer).printer.envelope
    # the others are only sliced for: one process of each kind; all 600 together passed once
    processes = list_profiles("processes") if measured else ("repair_0.20", "standard_0.20")
    for material, process in itertools.product(list_profiles("materials"), processes):
        setup = load_setup(printer, material, process)
        toolpath = slice_part(box, setup)
        assert 0.97 < toolpath.volume_mm3 / box.volume() < 2.0  # with its skirt
        refusals = find_refusals(write(toolpath, setup, title="box"), setup)
        if refusals:
            wrong[material, process] = str(refusals[0])
    assert wrong == {}
