"""Each shipped printer prints, loses and mends a small block in the simulated world (-m slow).

Where nobody has measured a machine's tool head, it does so by a profile that says one.
"""

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

from gcode.errors import ProfileError
from gcode.profiles import list_profiles, load_printer

ROOT = Path(__file__).parents[2]


def with_a_head(printer: str, folder: Path) -> str:
    """The printer; where the shape of its head is not known, a profile that somebody measured."""
    if load_printer(printer).envelope:
        return printer
    with pytest.raises(ProfileError, match="write it into a profile of your own"):
        _ = load_printer(printer).head
    generic = (ROOT / "profiles" / "printers" / "generic_marlin.toml").read_text()
    path = folder / "mine.toml"
    head = generic[generic.index("[[envelope]]") :]
    path.write_text(f'inherits = "{printer}"\nname = "Mine"\n{head}')
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize("printer", list_profiles("printers"))
def test_a_small_block_is_mended(printer: str, tmp_path: Path) -> None:
    """regression: Voron 2.4 and generic Klipper ended at once, by their own prime line."""
    mesh = m3.Manifold.cube((20.0, 20.0, 4.0)).to_mesh()
    block = tmp_path / "block.stl"
    trimesh.Trimesh(np.asarray(mesh.vert_properties), np.asarray(mesh.tri_verts)).export(block)
    done = subprocess.run(
        [sys.executable, "-m", "amrepair", "simulate", str(block), "--printer",
         with_a_head(printer, tmp_path),
         "--defect", "void:diameter=6,layers=4", "--out", str(tmp_path / "run"), "--json"],
        capture_output=True, text=True, check=False, env=dict(os.environ), timeout=280,
    )  # fmt: skip
    assert done.returncode in {0, 3}, done.stderr[-2000:]
    result = json.loads(done.stdout)
    assert result["missing_mm3_before"] > 5.0
    assert result["repaired_ratio"] > 0.85
