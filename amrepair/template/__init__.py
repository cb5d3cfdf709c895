"""Templates: the part as it should be, as a signed distance field.

Exact on an adaptive grid (`GridSdf`), that grid taught by sound scans (`LearnedSdf`), the published
network (`PaperSdf`), exact and slow (`MeshSdf`), planned from the job's beads (`PlannedSdf`); a
layer's cut of any of them, and copies as they stand on the bed (`StoodTemplate`). It does not know
scans' poses, nor what is done about a difference. torch is imported only by `PaperSdf`, and while
one is fitted.
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
