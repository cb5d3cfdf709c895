"""Templates: the part as it should be, as a signed distance field.

All kinds answer the same questions (`port.Template`):

- `GridSdf`: distances from a mesh on a grid that is finer where the surface bends; the usual kind;
- `LearnedSdf`: such a grid, corrected by scans of sound parts;
- `MeshSdf`: exact distances to a mesh, without fitting, but slow;
- `PlannedSdf`: the solid that a job's own beads make;
- `PaperSdf`: the published neural network, for comparison; only this one imports torch;
- `CutTemplate`: any of them cut at a layer; `StoodTemplate`: those that stand on a bed.

The room does not know the poses of scans, nor what is done about a difference.
"""

from amrepair.template.cut import CutTemplate
from amrepair.template.extract import extract_mesh
from amrepair.template.fitting import default_cache_dir, fit_template, load_or_fit, load_template
from amrepair.template.grid import GridSdf
from amrepair.template.laid import KeptFills, LaidBeads, LaidOptions
from amrepair.template.learned import LearnedSdf
from amrepair.template.mesh_file import load_mesh
from amrepair.template.mesh_sdf import MeshSdf
from amrepair.template.network import PaperSdf
from amrepair.template.opening import open_template
from amrepair.template.planned import PlannedSdf
from amrepair.template.port import Template
from amrepair.template.stood import StoodTemplate

__all__ = [
    "CutTemplate",
    "GridSdf",
    "KeptFills",
    "LaidBeads",
    "LaidOptions",
    "LearnedSdf",
    "MeshSdf",
    "PaperSdf",
    "PlannedSdf",
    "StoodTemplate",
    "Template",
    "default_cache_dir",
    "extract_mesh",
    "fit_template",
    "load_mesh",
    "load_or_fit",
    "load_template",
    "open_template",
]
