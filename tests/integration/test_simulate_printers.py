"""Each shipped printer prints, loses and mends a small block in the simulated world (-m slow)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from gcode.profiles import list_profiles


@pytest.mark.slow
@pytest.mark.parametrize("printer", list_profiles("printers"))
def test_a_small_block_is_mended(printer: str, tmp_path: Path) -> None:
    """regression: Voron 2.4 and generic Klipper ended at once, by their own prime line."""
    mesh = m3.Manifold.cube((20.0, 20.0, 4.0)).to_mesh()
    block = tmp_path / "block.stl"
    trimesh.Trimesh(np.asarray(mesh.vert_properties), np.asarray(mesh.tri_verts)).export(block)
    done = subprocess.run(
        [sys.executable, "-m", "amrepair", "simulate", str(block), "--printer", printer,
         "--defect", "void:diameter=6,layers=4", "--out", str(tmp_path / "run"), "--json"],
        capture_output=True, text=True, check=False, env=dict(os.environ), timeout=280,
    )  # fmt: skip
    assert done.returncode in {0, 3}, done.stderr[-2000:]
    result = json.loads(done.stdout)
    assert result["missing_mm3_before"] > 5.0
    assert result["repaired_ratio"] > 0.85
