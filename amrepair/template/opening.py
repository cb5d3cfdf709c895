"""`open_template`: a template from whatever file the user has."""

from __future__ import annotations

from pathlib import Path

from amrepair.errors import InputError
from amrepair.template.fitting import load_or_fit, load_template
from amrepair.template.port import Template
from gcode.progress import Progress, silent
from gcode.solids import SOLID_SUFFIXES

TEMPLATE_SUFFIX = ".safetensors"


def open_template(path: Path, *, progress: Progress = silent) -> Template:
    """A fitted template, or a mesh that is fitted now (or taken from the cache).

    Raises
    ------
    InputError
        If it is neither.

    Examples
    --------
    >>> from pathlib import Path
    >>> from amrepair import open_template
    >>> template = open_template(Path("part.safetensors"))
    >>> template.bounds_mm.round(1)  # corners of the part, mm
    array([[ 0.,  0.,  0.],
           [30., 20.,  9.]])
    """
    suffix = path.suffix.lower()
    if suffix == TEMPLATE_SUFFIX:
        return load_template(path)
    if suffix in SOLID_SUFFIXES:
        return load_or_fit(path, progress=progress)
    raise InputError(
        f"the template {path} is neither a {TEMPLATE_SUFFIX} file nor a mesh "
        f"({', '.join(SOLID_SUFFIXES)}); fit one with 'amrepair template fit'"
    )
