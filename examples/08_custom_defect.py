"""A defect that amrepair does not simulate: a scratch across the top of a finished part.

python examples/08_custom_defect.py        prints how much of the scratch came back

A defect is any solid that breaks off (`removed`) or is added, or ellipses in which the flow
changes. It is handed to a prepared run; the loop that mends it knows nothing of it.
"""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
from _shared import mesh_of, out_folder

import gcode
from amrepair.loop import plan_stops
from amrepair.report.folder import RunFolder
from amrepair.simulate.defects import PlacedDefect
from amrepair.simulate.run import prepare_run, simulate_run
from amrepair.template import MeshSdf


def scratch(part: m3.Manifold, *, width_mm: float, depth_mm: float) -> PlacedDefect:
    """A trough along the diagonal of the top, in the build frame like `part`."""
    x0, y0, _, x1, y1, top = part.bounding_box()
    ends = [(x0 + 4, y0 + 4), (x1 - 4, y1 - 4)]
    stylus = m3.Manifold.cube((width_mm, width_mm, 2 * depth_mm), True)
    trough = m3.Manifold.batch_hull([stylus.translate((x, y, top)) for x, y in ends])
    box = np.array(trough.bounding_box()).reshape(2, 3)
    return PlacedDefect(
        kind="chip",  # the nearest name for reports
        layers=(),  # it happens to the finished part
        flow_regions=np.zeros((0, 9)),
        removed=trough,
        added=None,
        box_mm=box,
    )


def main() -> None:
    out = out_folder(__doc__)
    setup = gcode.load_setup("prusa_mk3s", "pla", "repair_0.20")
    plate = MeshSdf.from_mesh(mesh_of(m3.Manifold.cube((22.0, 16.0, 2.0))))
    whole = prepare_run(plate, setup, [], title="plate", seed=1)
    mine = scratch(whole.part, width_mm=3.5, depth_mm=0.8)
    run = simulate_run(
        replace(whole, defects=(mine,), stops=plan_stops(whole.job, [])),
        record=RunFolder(out).record,
    )
    (truth,) = run.truth
    print(f"scratched out {truth.missing_mm3:.1f} mm³, filled {truth.filled_mm3:.1f} mm³")
    print(f"ratio {run.repaired_ratio or 0:.2f} in {len(run.report.repair_prints)} repairs")


if __name__ == "__main__":
    main()
