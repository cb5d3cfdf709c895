"""Where a program first touches what stands on the bed, and a picture of it.

The sweep names the line; here that line is walked in small steps to find the place.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from gcode.check.findings import Moves, Refusal
from gcode.check.sweep import deepest_along
from gcode.profiles import PrinterProfile
from gcode.surfaces import HeightField

MOVE_STEPS = 200  # along the move
MOST_PICTURE_PIXELS = 1200  # on a side of the picture
NEAR_MOVES = 400  # before the contact, that the picture shows
PICTURE_MARGIN_MM = 10.0


@dataclass(frozen=True, slots=True)
class Contact:
    """The first place where the head touches what stands there.

    Attributes
    ----------
    line
        The line of the program, counted from 1.
    place_mm
        Where the nozzle's tip is at that moment, build frame.
    what
        Which part of the head touches, in the words of the refusal.
    """

    line: int
    place_mm: tuple[float, float, float]
    what: str
    depth: str

    def __str__(self) -> str:
        x, y, z = self.place_mm
        return f"at X {x:.1f}, Y {y:.1f}, Z {z:.2f} mm (line {self.line}) {self.what}, {self.depth}"


def contact_of(
    refusal: Refusal, moves: Moves, printer: PrinterProfile, as_built: HeightField
) -> Contact:
    """Find the place to which a refusal of the sweep belongs.

    Parameters
    ----------
    moves
        The moves of the whole program.
    """
    own = np.flatnonzero(moves.line == refusal.line)
    starts, ends = moves.start_mm[own], moves.end_mm[own]
    shares = (np.arange(MOVE_STEPS + 1) / MOVE_STEPS)[:, None]
    places = np.concatenate(
        [start + shares * (end - start) for start, end in zip(starts, ends, strict=True)]
    )
    depth_mm = deepest_along(places, printer, as_built)
    # What the job itself has laid is not in the field; the middle of the move stands for it.
    at = int(np.argmax(depth_mm > 0)) if (depth_mm > 0).any() else len(places) // 2
    x, y, z = places[at]
    return Contact(refusal.line, (float(x), float(y), float(z)), refusal.what, refusal.value)


def draw(
    contact: Contact, moves: Moves, printer: PrinterProfile, as_built: HeightField, path: Path
) -> None:
    """Write a picture (SVG) of the bed from above: what stands there, the way, the contact."""
    bed_x0, _, _, bed_y1 = printer.bed_box_mm
    width_mm, depth_mm = printer.bed_size_mm
    x, y, z = contact.place_mm
    last = int(np.searchsorted(moves.line, contact.line, side="right"))
    first = max(0, last - NEAR_MOVES)
    way = " ".join(f"{v[0] - bed_x0:.2f},{bed_y1 - v[1]:.2f}" for v in moves.end_mm[first:last])
    x0, y0, x1, y1 = as_built.box_mm
    image = base64.b64encode(_png(_shaded(as_built))).decode()
    radius = max(width_mm, depth_mm) / 60.0
    font = max(width_mm, depth_mm) / 35.0
    margin = PICTURE_MARGIN_MM
    text = f"X {x:.1f} Y {y:.1f} Z {z:.2f} mm, line {contact.line}: {contact.depth}"
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{-margin:g} {-margin:g} '
        f'{width_mm + 2 * margin:g} {depth_mm + 2 * margin + 2 * font:g}" font-family="sans-serif" '
        f'font-size="{font:.2f}">'
        f'<rect x="0" y="0" width="{width_mm:g}" height="{depth_mm:g}" fill="#f4f4f0" '
        'stroke="#666" stroke-width="0.5"/>'
        f'<image x="{x0 - bed_x0:.3f}" y="{bed_y1 - y1:.3f}" width="{x1 - x0:.3f}" '
        f'height="{y1 - y0:.3f}" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{image}"/>'
        f'<polyline points="{way}" fill="none" stroke="#33658a" stroke-width="0.3"/>'
        f'<circle cx="{x - bed_x0:.3f}" cy="{bed_y1 - y:.3f}" r="{radius:.2f}" fill="none" '
        'stroke="#c1121f" stroke-width="1"/>'
        f'<text x="0" y="{depth_mm + margin + font:.2f}">{text}</text></svg>\n',
        encoding="utf-8",
    )


def _shaded(field: HeightField) -> UInt8[np.ndarray, "ny nx 4"]:
    """Heights as shades, the bed clear; what nobody saw is striped darker."""
    step = max(1, -(-max(field.shape) // MOST_PICTURE_PIXELS))
    z_mm: Float[np.ndarray, "ny nx"] = field.z_mm[::step, ::step]
    seen = field.seen[::step, ::step]
    share = np.clip(z_mm / max(field.top_mm, 1e-6), 0.0, 1.0)
    grey = (200.0 - 140.0 * share).astype(np.uint8)
    alpha = np.where(z_mm > 0.3, 255, 0).astype(np.uint8)
    unseen = ~seen & (z_mm > 0.3)
    red = np.where(unseen, np.minimum(grey.astype(int) + 40, 255), grey).astype(np.uint8)
    return np.stack([red, grey, grey, alpha], axis=2)[::-1]


def _png(pixels: UInt8[np.ndarray, "ny nx 4"]) -> bytes:
    """An image as PNG, with alpha."""
    from PIL import Image

    packed = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(packed, "PNG")
    return packed.getvalue()
