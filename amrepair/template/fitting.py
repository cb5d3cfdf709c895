"""`fit_template` and `load_or_fit`: from a mesh to a template, or from the cache."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import amrepair
from amrepair.errors import TemplateError
from amrepair.template.file import FORMAT_VERSION, read_template
from amrepair.template.fit import FIT_VERSION, fit_fast
from amrepair.template.grid import GridSdf
from amrepair.template.learned import LEARNED_KIND as LEARNED
from amrepair.template.learned import LearnedSdf
from amrepair.template.mesh_file import file_sha256, load_mesh, require_mesh
from amrepair.template.mesh_sdf import MeshSdf
from amrepair.template.network import NETWORK_KIND as NETWORK
from amrepair.template.network import PaperSdf
from amrepair.template.options import DEFAULT_FIT, FitOptions
from amrepair.template.paper import PUBLISHED_NETWORK, PaperOptions, fit_paper
from gcode.progress import Progress, silent
from gcode.surfaces.sizes import in_words

if TYPE_CHECKING:
    import trimesh

RECIPES = ("fast", "paper")
_log = logging.getLogger(__name__)


def fit_template(
    source: Path | str | trimesh.Trimesh | Sequence[Path],
    *,
    recipe: str = "fast",
    fast: FitOptions = DEFAULT_FIT,
    paper: PaperOptions = PUBLISHED_NETWORK,
    device: str = "auto",
    seed: int = 0,
    progress: Progress = silent,
) -> GridSdf | PaperSdf:
    """Fit a template to a part.

    Parameters
    ----------
    source
        A mesh or its file, mm; made watertight where that leaves the shape in no doubt.
    fast, paper
        Settings of the recipes.
    device
        Where the recipe `paper` trains; the fast one needs no torch.

    Raises
    ------
    TemplateError
        If the recipe is unknown, or the mesh bounds no volume.

    Examples
    --------
    >>> from pathlib import Path
    >>> from amrepair import fit_template
    >>> template = fit_template(Path("part.stl"))
    >>> template.save(Path("part.safetensors"))
    >>> template.bias_mm < 0.1  # error on the surface, 99 %
    True
    """
    if recipe not in RECIPES:
        raise TemplateError(f"the recipe '{recipe}' is unknown; choose {', '.join(RECIPES)}")
    if isinstance(source, Sequence) and not isinstance(source, str):
        if len(source) != 1:
            raise TemplateError(
                f"a template is fitted to one mesh, {len(source)} inputs were given"
            )
        source = source[0]
    closed = _closed(source, progress)
    metadata = made_from(closed, recipe, seed)
    exact = MeshSdf.from_mesh(closed)
    if recipe == "paper":
        return fit_paper(
            exact, options=paper, device=device, seed=seed, metadata=metadata, progress=progress
        )
    return fit_fast(exact, seed=seed, metadata=metadata, options=fast, progress=progress)


def _closed(source: Path | str | trimesh.Trimesh, progress: Progress) -> trimesh.Trimesh:
    progress("read mesh", 0.0, 1.0)
    mesh = load_mesh(source) if isinstance(source, (str, Path)) else source
    closed = require_mesh(mesh, source=str(mesh.metadata.get("source", "mesh")))
    progress("read mesh", 1.0, 1.0)
    return closed


def made_from(closed: trimesh.Trimesh, recipe: str, seed: int) -> dict[str, str]:
    """What a template's file says of how it was made."""
    return {
        "recipe": recipe,
        "seed": str(seed),
        "part_sha256": mesh_sha256(closed),
        "version": amrepair.__version__,
        "notes": "; ".join(closed.metadata.get("notes", ())),
    }


def load_template(path: Path) -> GridSdf | PaperSdf:
    """Open a template's file, whatever its recipe.

    Raises
    ------
    TemplateError
        If it is missing, truncated, or no template of ours.
    """
    path = Path(path)
    arrays, head = read_template(path)
    try:
        if head.get("kind") == NETWORK:
            return PaperSdf.unpacked(path, arrays, head)
        if head.get("kind") == LEARNED:
            return LearnedSdf.unpacked(path, arrays, head)
        return GridSdf.unpacked(path, arrays, head)
    except (KeyError, TypeError, ValueError) as error:
        raise TemplateError(
            f"the template {path} is damaged ({in_words(error)}); fit it again"
        ) from error


def load_or_fit(
    source: Path | str | trimesh.Trimesh,
    *,
    cache_dir: Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> GridSdf:
    """The fast template of a part: from the cache, keyed by its hash, or fitted and kept there.

    A file's hash is that of its bytes, so that one that is known is not read as a mesh again; what
    was mended of it is logged each time.

    Parameters
    ----------
    cache_dir
        Default: `$XDG_CACHE_HOME/amrepair/templates`, or `~/.cache/amrepair/templates`.
    """
    folder = cache_dir or default_cache_dir()
    file = Path(source) if isinstance(source, (str, Path)) else None
    if file is not None and file.is_file():
        closed, part = None, [file.suffix.lower(), file_sha256(file)]
    else:
        closed = _closed(source, progress)
        part = ["mesh", mesh_sha256(closed)]
    key = json.dumps([*part, "fast", seed, FIT_VERSION, FORMAT_VERSION, amrepair.__version__])
    path = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.safetensors"
    if path.is_file():
        try:
            kept = GridSdf.load(path)
        except TemplateError:
            path.unlink(missing_ok=True)  # a crash while it was written, or another version
        else:
            if file is not None and (notes := kept.metadata.get("notes")):
                _log.warning("%s: %s", file.name, notes)
            return kept
    closed = _closed(source, progress) if closed is None else closed
    template = fit_fast(
        MeshSdf.from_mesh(closed),
        seed=seed,
        metadata=made_from(closed, "fast", seed),
        progress=progress,
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        template.save(path)
    except (OSError, TemplateError):
        return template  # a cache that cannot be written is no reason to stop
    return template


def default_cache_dir() -> Path:
    """Where fitted templates are kept."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "amrepair" / "templates"


def mesh_sha256(mesh: trimesh.Trimesh) -> str:
    """SHA-256 of a mesh's vertices and faces, hexadecimal."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(mesh.vertices, dtype=np.float64).tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype=np.int64).tobytes())
    return digest.hexdigest()
