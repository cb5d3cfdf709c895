# mypy: disable-error-code="no-untyped-def"
"""Beads onto voxels, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numba import njit
from scipy import ndimage

from tests.judge.head import MK3S_HEAD, HeadSlice, Reaching, grown, reachable, tip_under
from tests.judge.text import Steps, read_steps
from tests.judge.voxels import Voxels, column_tops, occupancy

FINE_MM = (0.1, 0.1, 0.05)
STEP_MM = 0.1
MARGIN_MM = 3.0
SHARP_MM = 0.02
# What falls farther than this below the tip hangs, or was blown: it is laid at the tip instead.
MOST_GAP_MM = 0.55
HANGING_MM = 0.2
# The head may stand beside the part and touch it.
BESIDE_MM = 40.0


@dataclass
class Verdict:
    """What the judge saw; volumes in mm³, lengths in mm."""

    missing_mm3: float
    reachable_mm3: float
    filled_mm3: float
    filled_reachable_mm3: float
    laid_mm3: float
    outside_mm3: float
    in_air_mm3: float
    widest_mm: float
    deepest_contact_mm: float
    contact_line: int
    # the same with the tip a whole layer over what it covers
    reachable_high_mm3: float
    filled_high_mm3: float
    # the same, whether anything holds it or not: what the head alone allows
    reachable_open_mm3: float
    filled_open_mm3: float

    @property
    def open_ratio(self) -> float:
        """Of what is missing, the share that the head alone allows."""
        return self.reachable_open_mm3 / max(self.missing_mm3, 1e-9)

    @property
    def filled_open_ratio(self) -> float:
        """Of what the head alone allows."""
        return self.filled_open_mm3 / max(self.reachable_open_mm3, 1e-9)

    @property
    def filled_high_ratio(self) -> float:
        """Of what the head reaches from a whole layer up."""
        return self.filled_high_mm3 / max(self.reachable_high_mm3, 1e-9)

    @property
    def filled_ratio(self) -> float:
        """Of what the judge's own head reaches."""
        return self.filled_reachable_mm3 / max(self.reachable_mm3, 1e-9)

    @property
    def reachable_ratio(self) -> float:
        """Of what is missing."""
        return self.reachable_mm3 / max(self.missing_mm3, 1e-9)

    @property
    def outside_ratio(self) -> float:
        """Of what was laid, the share outside the intended part."""
        return self.outside_mm3 / max(self.laid_mm3, 1e-9)


def judge(
    text: str,
    stands: trimesh.Trimesh,
    wanted: trimesh.Trimesh,
    piece_box_mm: np.ndarray,
    *,
    head: tuple[HeadSlice, ...] = MK3S_HEAD,
    nozzle_mm: float = 0.4,
    bead_mm: float = 0.45,
) -> Verdict:
    """Lay a program's beads onto what stands there and hold the result against what is wanted.

    `piece_box_mm` (2, 3) is the box of what is missing; meshes and text share the build frame.
    """
    steps = read_steps(text)
    scene = _Scene.of(stands, wanted, piece_box_mm)
    box, before, missing = scene.box, scene.before, scene.aim & ~scene.before
    over_mm = tuple(grown(scene.tops_mm, FINE_MM[0], part) for part in head)
    reaching = Reaching(
        least_mm=tip_under(over_mm, head, scene.window),
        cell_mm=FINE_MM[0], low_z_mm=float(box.low_mm[2]), size_z_mm=FINE_MM[2],
        bead_mm=bead_mm, layer_mm=HANGING_MM, allowed_mm=0.1,
    )  # fmt: skip
    reach, high_reach, open_reach = (
        reachable(missing, before, reaching, tip_layers=layers, held=held)
        for layers, held in ((0.5, True), (1.0, True), (1.0, False))
    )
    contact, line = _contact(steps, over_mm, scene.field_low_mm, FINE_MM[0], head)
    state = before.astype(np.uint8)
    lost, widest = _lay(
        steps.start_mm, steps.end_mm, steps.pushed_mm3, state, box.low_mm, box.size_mm,
        *_disc(nozzle_mm, FINE_MM[0]), MOST_GAP_MM, HANGING_MM,
    )  # fmt: skip
    welled = lost.sum()
    laid = state >= 2
    v = box.volume_mm3
    return Verdict(
        missing_mm3=missing.sum() * v,
        reachable_mm3=reach.sum() * v,
        filled_mm3=(laid & missing).sum() * v,
        filled_reachable_mm3=(laid & reach).sum() * v,
        laid_mm3=laid.sum() * v + welled,
        outside_mm3=(laid & ~scene.aim).sum() * v + welled,
        in_air_mm3=_in_air(state, before, bead_mm).sum() * v,
        widest_mm=widest,
        deepest_contact_mm=contact,
        contact_line=line,
        reachable_high_mm3=high_reach.sum() * v,
        filled_high_mm3=(laid & high_reach).sum() * v,
        reachable_open_mm3=open_reach.sum() * v,
        filled_open_mm3=(laid & open_reach).sum() * v,
    )


@dataclass
class _Scene:
    """What stands there and what is wanted: voxels round the piece, tops of columns farther out."""

    box: Voxels
    before: np.ndarray
    aim: np.ndarray
    tops_mm: np.ndarray
    field_low_mm: np.ndarray
    window: tuple[slice, slice]

    @classmethod
    def of(
        cls, stands: trimesh.Trimesh, wanted: trimesh.Trimesh, piece_box_mm: np.ndarray
    ) -> _Scene:
        """From meshes."""
        low = np.array([*(piece_box_mm[0, :2] - MARGIN_MM), piece_box_mm[0, 2] - 1.0])
        high = np.array([*(piece_box_mm[1, :2] + MARGIN_MM), piece_box_mm[1, 2] + 2.0])
        low[2] = max(low[2], 0.0)
        # the coarse field's cells are the fine ones', so that windows are slices
        cell = FINE_MM[0]
        field_low = np.floor((stands.bounds[0, :2] - BESIDE_MM) / cell) * cell
        low[:2] = field_low + np.round((low[:2] - field_low) / cell) * cell
        low[:2] = np.maximum(low[:2], field_low)
        box = Voxels.around(low, high, FINE_MM)
        tops = _tops(stands, field_low, stands.bounds[1, :2] + BESIDE_MM, cell)
        corner = np.round((low[:2] - field_low) / cell).astype(int)
        high_at = np.minimum(corner + np.array(box.shape[:2]), tops.shape)
        box.shape = (int(high_at[0] - corner[0]), int(high_at[1] - corner[1]), box.shape[2])
        window = (slice(corner[0], high_at[0]), slice(corner[1], high_at[1]))
        return cls(box, occupancy(stands, box), occupancy(wanted, box), tops, field_low, window)


def _in_air(state: np.ndarray, before: np.ndarray, bead_mm: float) -> np.ndarray:
    """Voxels that hang, held neither by what stands there nor by a bead that lies on something."""
    hanging = state == 3
    if not hanging.any():
        return hanging
    lies = before | (state == 2)
    return hanging & ~ndimage.binary_dilation(lies, iterations=round(bead_mm / FINE_MM[0]))


def _tops(mesh: trimesh.Trimesh, low, high, cell: float) -> np.ndarray:
    """(nx, ny) top of the mesh by column; 0 is the bed."""
    box = Voxels.around(np.array([*low, 0.0]), np.array([*high, 1.0]), (cell, cell, 1.0))
    return column_tops(mesh, box)


def _disc(nozzle_mm: float, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of the columns that one bead may cover, nearest first, and their distances."""
    n = int(np.ceil(nozzle_mm / cell)) + 1
    i, j = np.mgrid[-n : n + 1, -n : n + 1].reshape(2, -1)
    distance = np.hypot(i, j) * cell
    keep = distance <= nozzle_mm + 1e-9  # half of two nozzle widths
    order = np.argsort(distance[keep], kind="stable")
    return np.stack([i[keep][order], j[keep][order]], axis=1), distance[keep][order]


@njit(cache=True)
def _lay(starts, ends, pushed, state, low, size, disc, distance, most_gap, hanging):
    """Lay every bead: the nearest column first, from its surface up to the tip."""
    voxel = size[0] * size[1] * size[2]
    nx, ny, nz = state.shape
    lost, widest, carry = np.zeros(len(pushed)), 0.0, 0.0
    for m in range(len(pushed)):
        if pushed[m] <= 0:
            continue
        d = ends[m] - starts[m]
        length = np.sqrt((d * d).sum())
        if length < 1e-9:
            continue  # priming in place
        count = max(1, int(np.ceil(length / 0.1)))
        for s in range(count):
            p = starts[m] + d * ((s + 0.5) / count)
            carry += pushed[m] / count
            ci = int(np.floor((p[0] - low[0]) / size[0]))
            cj = int(np.floor((p[1] - low[1]) / size[1]))
            kz = int(np.floor((p[2] - low[2]) / size[2] + 0.5))
            if ci < -5 or cj < -5 or ci > nx + 5 or cj > ny + 5:
                carry = 0.0  # far away: the prime line
                continue
            for c in range(len(disc)):
                if carry < voxel:
                    break
                i, j = ci + disc[c, 0], cj + disc[c, 1]
                if i < 0 or j < 0 or i >= nx or j >= ny:
                    continue
                k = min(kz, nz)
                while k > 0 and state[i, j, k - 1] == 0:
                    k -= 1
                gap = (min(kz, nz) - k) * size[2]
                kind = 2
                if gap > most_gap:
                    k = min(kz, nz) - round(hanging / size[2])
                    kind = 3
                while k < min(kz, nz) and carry >= voxel:
                    state[i, j, k] = kind
                    carry -= voxel
                    k += 1
                    widest = max(widest, 2 * distance[c])
            if carry > 4 * voxel:
                lost[m] += carry - 4 * voxel  # no room within two nozzle widths: it wells up
                carry = 4 * voxel
    return lost, widest


def _contact(
    steps: Steps,
    over_mm: tuple[np.ndarray, ...],
    low: np.ndarray,
    cell: float,
    head: tuple[HeadSlice, ...],
) -> tuple[float, int]:
    """Deepest contact of the head with what stood there, mm, and its line."""
    worst, line = -np.inf, 0
    for over, part in zip(over_mm, head, strict=True):
        if not len(steps.line):
            break
        depth, at = _deepest(steps.start_mm, steps.end_mm, over, low, cell, part.above_mm)
        if depth > worst:
            worst, line = depth, int(steps.line[at])
    return float(worst), line


def cone_contact_mm(
    text: str, stands: trimesh.Trimesh, piece_box_mm: np.ndarray, head: tuple[HeadSlice, ...]
) -> float:
    """Deepest contact of the head's cones over the piece and beside it, −∞: there are none.

    The tip is where the text has it, and walls stand where they are to `SHARP_MM`; the verdict's
    own figure knows both by columns of 0.1 mm, and is off by up to half of one each.
    """
    steps = read_steps(text)
    low, high = piece_box_mm[0, :2] - MARGIN_MM, piece_box_mm[1, :2] + MARGIN_MM
    tops = _tops(stands, low, high, SHARP_MM)
    return max(
        (
            _deepest_cone(
                steps.start_mm, steps.end_mm, tops, low, SHARP_MM, part.above_mm, part.radius_mm,
                part.radius_to_mm,
                (part.to_mm - part.above_mm) / (part.radius_to_mm - part.radius_mm),
            )
            for part in head
            if part.radius_to_mm > 0
        ),
        default=-np.inf,
    )  # fmt: skip


@njit(cache=True)
def _deepest_cone(starts, ends, tops, low, cell, above, rim, rim_to, rise):
    worst, highest = -np.inf, tops.max()
    nx, ny = tops.shape
    for m in range(len(starts)):
        d = ends[m] - starts[m]
        count = max(1, int(np.ceil(np.sqrt((d * d).sum()) / STEP_MM)))
        for s in range(count + 1):
            p = starts[m] + d * (s / count)
            over = highest - p[2] - above - max(worst, 0.0)
            if over <= 0:
                continue
            far = min(rim_to, rim + over / rise)
            x, y = (p[0] - low[0]) / cell - 0.5, (p[1] - low[1]) / cell - 0.5
            n = far / cell
            for i in range(max(0, int(np.ceil(x - n))), min(nx, int(np.floor(x + n)) + 1)):
                wide = np.sqrt(n * n - (i - x) ** 2)
                for j in range(
                    max(0, int(np.ceil(y - wide))), min(ny, int(np.floor(y + wide)) + 1)
                ):
                    depth = tops[i, j] - p[2] - above
                    if depth > worst:
                        apart = np.sqrt((i - x) ** 2 + (j - y) ** 2) * cell
                        worst = max(worst, depth - rise * max(0.0, apart - rim))
    return worst


@njit(cache=True)
def _deepest(starts, ends, grown, low, cell, above):
    worst, at, highest = -1e9, 0, grown.max()
    nx, ny = grown.shape
    for m in range(len(starts)):
        d = ends[m] - starts[m]
        if highest - above < min(starts[m, 2], ends[m, 2]) + worst:
            continue
        count = max(1, int(np.ceil(np.sqrt((d * d).sum()) / 0.1)))
        for s in range(count + 1):
            p = starts[m] + d * (s / count)
            ci = int(np.floor((p[0] - low[0]) / cell))
            cj = int(np.floor((p[1] - low[1]) / cell))
            if ci < 0 or cj < 0 or ci >= nx or cj >= ny:
                continue
            depth = grown[ci, cj] - (p[2] + above)
            if depth > worst:
                worst, at = depth, m
    return worst, at
