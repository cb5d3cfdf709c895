"""Where installed slicers keep their presets, and which there are. Nothing is read but names.

PrusaSlicer and SuperSlicer: `printer/`, `filament/` and `print/*.ini` in the configuration folder,
and bundles of vendors in `vendor/*.ini`. OrcaSlicer and Bambu Studio: `user/ACCOUNT/{machine,
filament,process}/*.json`, and those of vendors in `system/VENDOR/`.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from gcode.profiles.names import Kind

PRUSA_LIKE = ("PrusaSlicer", "PrusaSlicer-beta", "PrusaSlicer-alpha", "SuperSlicer")
ORCA_LIKE = ("OrcaSlicer", "BambuStudio", "BambuStudioBeta", "CrealityPrint", "Creality Print")
# Where flatpaks keep what others keep in ~/.config.
FLATPAKS = {
    "PrusaSlicer": "com.prusa3d.PrusaSlicer",
    "OrcaSlicer": "io.github.softfever.OrcaSlicer",
    "BambuStudio": "com.bambulab.BambuStudio",
}
BUNDLES = ("/usr/share/PrusaSlicer/profiles", "/usr/share/slic3r/profiles")  # of Debian's packages
_PRUSA_FOLDERS: dict[str, Kind] = {
    "printer": "printers",
    "filament": "materials",
    "print": "processes",
}
_ORCA_FOLDERS: dict[str, Kind] = {
    "machine": "printers",
    "filament": "materials",
    "process": "processes",
}
_SECTION = re.compile(r"^\[(printer|filament|print):([^*\]]+)\]", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class FoundPreset:
    """A preset that `gcode profiles import` reads.

    Attributes
    ----------
    preset
        Its name within a bundle, for `--preset`; None where the file is the preset.
    own
        Whether the user made it; else it came with the slicer.
    """

    slicer: str
    kind: Kind
    name: str
    path: Path
    preset: str | None
    own: bool


def configuration_folders(
    home: Path | None = None, environment: Mapping[str, str] = os.environ
) -> tuple[tuple[str, Path], ...]:
    """The configuration folders of installed slicers that exist, with the slicer's name."""
    home = home or Path.home()
    bases = [Path(environment.get("XDG_CONFIG_HOME") or home / ".config")]
    if sys.platform == "darwin":
        bases = [home / "Library" / "Application Support"]
    elif environment.get("APPDATA"):
        bases = [Path(environment["APPDATA"])]
    places = [(name, base / name) for base in bases for name in PRUSA_LIKE + ORCA_LIKE]
    places += [
        (name, home / ".var" / "app" / package / "config" / name)
        for name, package in FLATPAKS.items()
    ]
    return tuple((name, path) for name, path in places if path.is_dir())


def find_presets(
    home: Path | None = None, environment: Mapping[str, str] = os.environ
) -> tuple[FoundPreset, ...]:
    """All presets of installed slicers: the user's own first, by kind and name."""
    found: list[FoundPreset] = []
    for name, folder in configuration_folders(home, environment):
        found += _of_orca(name, folder) if name in ORCA_LIKE else _of_prusa(name, folder)
    for bundles in map(Path, BUNDLES):
        found += _in_bundles("PrusaSlicer", bundles)
    order: tuple[Kind, ...] = ("printers", "materials", "processes")
    return tuple(
        sorted(found, key=lambda p: (not p.own, p.slicer, order.index(p.kind), p.name, str(p.path)))
    )


def _of_prusa(slicer: str, folder: Path) -> Iterator[FoundPreset]:
    for inner, kind in _PRUSA_FOLDERS.items():
        for path in sorted((folder / inner).glob("*.ini")):
            yield FoundPreset(slicer, kind, path.stem, path, None, own=True)
    yield from _in_bundles(slicer, folder / "vendor")


def _in_bundles(slicer: str, folder: Path) -> Iterator[FoundPreset]:
    for path in sorted(folder.glob("*.ini")):
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue  # another user's; there is nothing to list
        for kind, name in _SECTION.findall(text):
            yield FoundPreset(slicer, _PRUSA_FOLDERS[kind], name, path, f"{kind}:{name}", own=False)


def _of_orca(slicer: str, folder: Path) -> Iterator[FoundPreset]:
    for top, own in (("user", True), ("system", False)):
        for inner, kind in _ORCA_FOLDERS.items():
            for path in sorted((folder / top).glob(f"*/{inner}/**/*.json")):
                yield FoundPreset(slicer, kind, path.stem, path, None, own=own)
