"""The pictures of the examples: each is run, and what it wrote is drawn. Run: `make pictures`.

Drawn by a small painter of our own (far things first, light from the upper left): it needs neither
a browser nor a GPU, and the same numbers give the same picture.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image, ImageDraw, ImageFont

import amrepair
import gcode

ROOT = Path(__file__).parents[1]
IMAGES = Path(__file__).parent / "images"
SIZE_PX = (900, 560)
FINER = 2  # drawn so many times larger, then scaled down
MARGIN = 0.06
PAPER, INK = (250, 250, 248), (40, 44, 52)
GREY, BLUE, GREEN, ORANGE = (176, 178, 182), (0, 90, 200), (34, 150, 84), (224, 120, 20)
LIGHT = np.array([-0.45, -0.35, 0.82])
BEAD_MM = 0.45
Colour = tuple[int, int, int]


class Painter:
    """Things in space, put on paper in the order of their depth.

    Parameters
    ----------
    turn_deg, tilt_deg
        Where one looks from: round the part, and up from the bed.
    """

    def __init__(self, turn_deg: float = 35.0, tilt_deg: float = 38.0) -> None:
        turn, tilt = np.deg2rad((turn_deg, tilt_deg))
        right = np.array([np.cos(turn), np.sin(turn), 0.0])
        away = np.array([-np.sin(turn), np.cos(turn), 0.0])
        self._up = away * np.sin(tilt) + np.array([0.0, 0.0, np.cos(tilt)])
        self._away = away * np.cos(tilt) - np.array([0.0, 0.0, np.sin(tilt)])
        self._right = right
        self._shapes: list[tuple[float, str, np.ndarray, Colour, float]] = []

    def _flat(self, points: np.ndarray) -> np.ndarray:
        axes = np.stack([self._right, self._up, self._away], axis=1)
        return np.asarray(points, dtype=np.float64) @ axes

    def mesh(self, mesh: Any, colour: Colour) -> None:
        """A solid, lit."""
        corners = self._flat(np.asarray(mesh.triangles).reshape(-1, 3)).reshape(-1, 3, 3)
        shine = 0.62 + 0.38 * np.clip(np.asarray(mesh.face_normals) @ LIGHT, -1.0, 1.0)
        facing = np.asarray(mesh.face_normals) @ self._away < 0.0
        for face, light in zip(corners[facing], shine[facing], strict=True):
            shade = tuple(int(min(255, c * light * 1.1)) for c in colour)
            self._shapes.append((face[:, 2].mean(), "face", face[:, :2], shade, 0.0))  # type: ignore[arg-type]

    def points(
        self, points_mm: np.ndarray, colours: np.ndarray | Colour, most: int = 60_000
    ) -> None:
        """A cloud."""
        step = max(1, len(points_mm) // most)
        flat = self._flat(points_mm[::step])
        shades = np.broadcast_to(np.asarray(colours), (len(points_mm), 3))[::step]
        for spot, shade in zip(flat, shades.tolist(), strict=True):
            self._shapes.append((spot[2], "point", spot[None, :2], tuple(shade), 0.14))

    def beads(self, beads: Any, chosen: np.ndarray, colour: Colour, nearer_mm: float = 0.0) -> None:
        """Beads of a program, some of them; drawn after what lies within `nearer_mm` of them."""
        start, end = self._flat(beads.start_mm[chosen]), self._flat(beads.end_mm[chosen])
        along = beads.end_mm[chosen] - beads.start_mm[chosen]
        turned = np.abs(np.arctan2(along[:, 1], along[:, 0])) / np.pi
        for a, b, light in zip(start, end, 0.8 + 0.3 * turned, strict=True):
            shade = tuple(int(min(255, c * light)) for c in colour)
            line = np.stack([a[:2], b[:2]])
            self._shapes.append(((a[2] + b[2]) / 2 - nearer_mm, "line", line, shade, BEAD_MM))  # type: ignore[arg-type]

    def save(self, path: Path) -> None:
        """Put it on paper."""
        every = np.concatenate([shape[2] for shape in self._shapes])
        low, high = every.min(axis=0), every.max(axis=0)
        size = np.array(SIZE_PX) * FINER
        scale = float(((1.0 - 2.0 * MARGIN) * size / np.maximum(high - low, 1e-9)).min())
        middle = (low + high) / 2.0
        image = Image.new("RGB", tuple(size.tolist()), PAPER)
        draw = ImageDraw.Draw(image)
        for _, kind, corners, colour, width_mm in sorted(self._shapes, key=lambda s: -s[0]):
            spots = (corners - middle) * (scale, -scale) + size / 2.0
            if kind == "face":
                draw.polygon([tuple(spot) for spot in spots], fill=colour, outline=colour)
            elif kind == "line":
                draw.line(
                    [tuple(spot) for spot in spots],
                    fill=colour,
                    width=max(2, int(width_mm * scale)),
                )
            else:
                x, y, r = *spots[0], max(1.0, width_mm * scale)
                draw.rectangle((x - r, y - r, x + r, y + r), fill=colour)
        _store(image, path)


def _store(image: Image.Image, path: Path) -> None:
    image.resize(SIZE_PX, Image.Resampling.LANCZOS).save(path, quality=80, method=6)


def _lit(scan: amrepair.Scan) -> np.ndarray:
    """Grey by the light that falls on a scan's points."""
    if scan.normals is None:
        return np.tile(np.array(GREY), (len(scan.points_mm), 1))
    light = 0.7 + 0.4 * np.clip(scan.normals @ LIGHT, -1.0, 1.0)
    return np.clip(light[:, None] * np.array(GREY), 0, 255).astype(int)


def _beads(path: Path) -> Any:
    return gcode.read_job(gcode.Program(path.read_text(encoding="utf-8"), "prusa")).beads


def offline_repair(out: Path, image: Path) -> None:
    """The scan, and the beads in the place of what is missing."""
    painter = Painter(215.0)
    scan = amrepair.read_scan(out / "scan.ply", frame="build")
    painter.points(scan.points_mm, _lit(scan))
    beads = _beads(out / "repair.gcode")
    lowest = float(scan.points_mm[:, 2].max()) - 6.0
    painter.beads(beads, beads.start_mm[:, 2] > lowest, GREEN)
    painter.save(image)


def template_from_scans(out: Path, image: Path) -> None:
    """The template's surface, laid on its heavier side."""
    painter = Painter()
    mesh = trimesh.load_mesh(out / "template.stl")
    lying = np.linalg.svd(
        np.asarray(mesh.vertices) - mesh.vertices.mean(axis=0), full_matrices=False
    )
    turn = np.eye(4)
    turn[:3, :3] = lying[2] * np.sign(np.linalg.det(lying[2]))
    mesh.apply_transform(turn)
    if mesh.center_mass[2] > mesh.bounds[:, 2].mean():  # axes have no sign; a part has a foot
        mesh.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
    painter.mesh(mesh, (150, 170, 205))
    painter.save(image)


def run_in_simulation(out: Path, image: Path) -> None:
    """The job's beads up to the stop grey, where they are written; the deficit blue; the repair."""
    painter = Painter(28.0, 48.0)
    solid = trimesh.load_mesh(out / "deficit-1.stl")
    low, high = solid.bounds
    if (out / "job.gcode").is_file():
        beads = _beads(out / "job.gcode")
        laid = (beads.end_mm[:, 2] <= high[2] + 0.01) & (beads.layer >= 0)
        near = (np.abs(beads.end_mm - (low + high) / 2.0)[:, :2] < 14.0).all(axis=1)
        painter.beads(beads, laid & near, GREY)
    else:
        painter.mesh(solid, BLUE)
    beads = _beads(out / "repair-1.gcode")
    inside = ((beads.start_mm > low - 0.6) & (beads.start_mm < high + 0.6)).all(axis=1)
    painter.beads(beads, inside, GREEN, nearer_mm=0.6)
    painter.save(image)


def sent_program(out: Path, image: Path) -> None:
    """Job and repair as one program: what comes after the top was reached is the repair."""
    beads = _beads(out / "sent.gcode")
    layers = beads.end_mm[:, 2]
    inside = (np.abs(beads.end_mm[:, :2] - np.median(beads.end_mm[:, :2], axis=0)) < 60.0).all(
        axis=1
    )
    finished = int(np.flatnonzero(inside & (layers > layers[inside].max() - 1e-6))[-1])
    later = np.arange(len(layers)) > finished
    painter = Painter(-40.0, 45.0)
    painter.beads(beads, inside & ~later, GREY)
    painter.beads(beads, inside & later, GREEN)
    painter.save(image)


def serial_printer(out: Path, image: Path) -> None:
    """What went over the wire: the tile's lines, and where one was sent again."""
    said = (out / "wire.log").read_text(errors="replace").splitlines()
    _text(
        "wire.log: the garbled line is asked for, and sent again",
        _around(said, re.compile(r"resend", re.IGNORECASE), 17),
        image,
    )


def octoprint(out: Path, image: Path) -> None:
    """What was asked of the server, and what it told."""
    said = (out / "octoprint.log").read_text(errors="replace").splitlines()
    _text("octoprint.log: requests (>) and news (<)", said[:17], image)


def benchmark(out: Path, image: Path) -> None:
    """Object and point AUROC of the methods, as bars."""
    found = json.loads((out / "results" / "results.json").read_text())
    rows = [row for row in found["rows"] if row.get("o_auroc") is not None]
    picture, draw, font = _paper()
    draw.text((60, 40), "AUROC on four kinds of defect of the knob", fill=INK, font=font)
    for index, row in enumerate(rows):
        for place, (key, colour) in enumerate((("o_auroc", BLUE), ("p_auroc", ORANGE))):
            top = 150 + 200 * index + 76 * place
            share = float(row[key])
            share = share / 100.0 if share > 1.0 else share
            draw.rectangle((420, top, 420 + int(1150 * share), top + 54), fill=colour)
            draw.text((440, top + 6), f"{key[0]}: {share:.3f}", fill=PAPER, font=font)
        draw.text((60, 180 + 200 * index), str(row["method"]), fill=INK, font=font)
    draw.text((60, 1020), "blue: objects, orange: points", fill=INK, font=font)
    _store(picture, image)


def _around(lines: Sequence[str], wanted: re.Pattern[str], count: int) -> list[str]:
    index = max((i for i, line in enumerate(lines) if wanted.search(line)), default=0)
    first = max(0, index - count // 2)
    return list(lines[first : first + count])


def _paper() -> tuple[Image.Image, ImageDraw.ImageDraw, Any]:
    picture = Image.new("RGB", (SIZE_PX[0] * FINER, SIZE_PX[1] * FINER), PAPER)
    return picture, ImageDraw.Draw(picture), ImageFont.load_default(size=38)


def _text(title: str, lines: Sequence[str], path: Path) -> None:
    picture, draw, font = _paper()
    draw.text((50, 36), title, fill=BLUE, font=font)
    for index, line in enumerate(lines):
        short = re.sub(r"^(\d+\.\d{3})\d*", r"\1", line)[:84]
        colour = ORANGE if re.search(r"resend|error", line, re.IGNORECASE) else INK
        draw.text((50, 110 + 56 * index), short, fill=colour, font=font)
    _store(picture, path)


DRAWN: dict[str, Callable[[Path, Path], None]] = {
    "01_offline_repair": offline_repair,
    "02_template_from_scans": template_from_scans,
    "03_layerwise_loop": run_in_simulation,
    "04_real_printer_over_serial": serial_printer,
    "05_octoprint": octoprint,
    "06_benchmark": benchmark,
    "07_custom_scanner": sent_program,
    "08_custom_defect": run_in_simulation,
}


def main() -> None:
    """Run the examples named on the command line by number, or all, and draw them."""
    sys.path.insert(0, str(ROOT))
    from tests.integration.test_examples import serving

    for name, draw in DRAWN.items():
        if sys.argv[1:] and name[:2] not in sys.argv[1:]:
            continue
        with tempfile.TemporaryDirectory() as folder, serving(name) as (more, environment):
            words = [sys.executable, str(ROOT / "examples" / f"{name}.py"), "--out", folder, *more]
            subprocess.run(words, check=True, env={**os.environ, **environment}, cwd=ROOT)
            draw(Path(folder), IMAGES / f"example-{name[:2]}.webp")


if __name__ == "__main__":
    main()
