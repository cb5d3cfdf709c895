"""The folder of a run: `result.json`, programs, scans, deficits, report; whole files or none."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import trimesh

from amrepair.errors import InputError
from amrepair.loop import Look
from amrepair.loop.tape import scan_name
from amrepair.scans import Scan, write_ply
from gcode.meshes import mesh_of
from gcode.whole import put_in_place


class RunFolder:
    """Writes the files of a run.

    Parameters
    ----------
    path
        Made with its first file, where it is not there.

    Raises
    ------
    InputError
        If it cannot be made or written, before anything else happens.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._kept: set[int] = set()
        new = [p for p in (path.absolute(), *path.absolute().parents) if not p.exists()]
        probe = path / f".write-test-{os.getpid()}"
        try:  # permissions alone do not tell: a file system may refuse root, too
            path.mkdir(parents=True, exist_ok=True)
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise InputError(
                f"the output folder {path} cannot be written ({error.strerror}); name another one"
            ) from error
        finally:
            for folder in new:
                if folder.is_dir():
                    folder.rmdir()

    def file(self, name: str) -> Path:
        """Path of a file in the folder, which is there from now on."""
        self._make()
        return self.path / name

    def _make(self) -> None:
        self.path.mkdir(parents=True, exist_ok=True)

    def write_text(self, name: str, text: str) -> Path:
        """Write a text whole or not at all."""
        return self._whole(name, lambda path: path.write_text(text, encoding="utf-8"))

    def write_json(self, name: str, content: Mapping[str, Any]) -> Path:
        """Write an object, keys in their order."""
        return self.write_text(name, json.dumps(content, indent=2, ensure_ascii=False) + "\n")

    def keep_scan(self, number: int, scan: Scan) -> None:
        """Write the scan of a look, before anything is known of it."""
        self._whole(scan_name(number), lambda path: write_ply(scan, path))
        self._kept.add(number)

    def record(self, look: Look) -> None:
        """Write scan, deficit and program of one look."""
        n, plan = look.number, look.plan
        if n not in self._kept:
            self.keep_scan(n, look.scan)
        if not plan.deficit.missing.is_empty():
            self.write_solid(f"deficit-{n}.stl", plan.deficit.missing)
        if plan.checked is not None and look.printed:
            self.write_text(f"repair-{n}.gcode", plan.checked.program.text)

    def write_solid(self, name: str, solid: Any) -> Path:
        """Write a `manifold3d.Manifold` as binary STL."""
        vertices, faces = mesh_of(solid)
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return self._whole(name, lambda path: mesh.export(path, file_type="stl"))

    def _whole(self, name: str, write: Callable[[Path], object]) -> Path:
        self._make()
        target = self.path / name
        with put_in_place(target) as draft:
            write(draft)
        return target
