"""Fitting the fast recipe: exact distances on a coarse grid, a learned residual where it bends.

The grid's trilinear interpolation is exact on planes; what it misses at edges and curves is learned
by hashed multi-resolution features and a small network (T. Müller et al., "Instant Neural Graphics
Primitives", 2022), trained on exact distances, most often where the grid is most wrong.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from amrepair.device import torch_device
from amrepair.template.learned import LearnedSdf, Tables
from amrepair.template.learned_kernels import FEATURES, HIDDEN, PRIMES
from amrepair.template.mesh_sdf import MeshSdf
from amrepair.template.surface import sample_surface
from gcode.progress import Progress, silent

GRID_CELLS = 128  # along the longest side
MARGIN_CELLS = 6.0
LEVEL_RATIOS = (1.0, 0.5, 0.25)  # of the coarse cell
TABLE_SIZE = 1 << 17
SAMPLES = 400_000
HELD_OUT = 40_000
BAND_CELLS = 1.5  # the residual is learned this far around the surface
STEPS, BATCH = 220, 1 << 14
RATE = 8e-3
LEAST_RESIDUAL_MM = 0.004  # cells where the grid is better than this need no network


def fit_fast(
    exact: MeshSdf,
    *,
    device: str = "auto",
    seed: int = 0,
    metadata: dict[str, str] | None = None,
    progress: Progress = silent,
) -> LearnedSdf:
    """Fit a template to an exact field.

    Parameters
    ----------
    exact
        The closed mesh's own field.
    seed
        Of the samples, the initial weights and the order of training.
    """
    rng = np.random.default_rng(seed)
    low, high = exact.bounds_mm
    cell = float((high - low).max()) / GRID_CELLS
    origin = low - MARGIN_CELLS * cell
    shape = np.ceil((high - low) / cell + 2 * MARGIN_CELLS).astype(int) + 1
    base = _grid(exact, origin, cell, shape, progress)
    points = _samples(exact, SAMPLES, BAND_CELLS * cell, rng)
    bare = Tables.bare(origin, cell, base, LEVEL_RATIOS, TABLE_SIZE)
    truth = exact.distance(points)
    progress("fit", 0.3, 1.0)
    residual = truth - bare.distance(points)
    active = _active(bare, points, residual)
    asked = active[tuple(bare.cell_of(points).T)]
    tables = _train(bare, points[asked], residual[asked], device, seed, progress)
    tables.active[...] = active
    held = _on_surface(exact, HELD_OUT, rng)
    bias_mm = float(np.quantile(np.abs(tables.distance(held)), 0.99))
    progress("fit", 1.0, 1.0)
    return LearnedSdf(tables=tables, mesh=exact.mesh, bias_mm=bias_mm, metadata=metadata or {})


def _grid(
    exact: MeshSdf,
    origin: Float[np.ndarray, " 3"],
    cell: float,
    shape: np.ndarray,
    progress: Progress,
) -> Float[np.ndarray, "x y z"]:
    """(x, y, z) exact distances at the nodes, float32."""
    axes = [origin[a] + cell * np.arange(shape[a]) for a in range(3)]
    base = np.empty(tuple(shape), dtype=np.float32)
    plane = np.stack(np.meshgrid(axes[1], axes[2], indexing="ij"), axis=-1).reshape(-1, 2)
    step = max(1, 400_000 // len(plane))
    for first in range(0, shape[0], step):
        xs = axes[0][first : first + step]
        nodes = np.column_stack([np.repeat(xs, len(plane)), np.tile(plane, (len(xs), 1))])
        base[first : first + step] = exact.distance(nodes).reshape(len(xs), shape[1], shape[2])
        progress("fit", 0.25 * min(first + step, shape[0]) / shape[0], 1.0)
    return base


def _on_surface(exact: MeshSdf, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    vertices, faces = np.asarray(exact.mesh.vertices), np.asarray(exact.mesh.faces)
    points, _, _ = sample_surface(vertices, faces, count=count, offset=float(rng.random()))
    return points


def _samples(
    exact: MeshSdf, count: int, band_mm: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Points around the surface, half of them close to it."""
    points = _on_surface(exact, count, rng)
    spread = np.where(rng.random(len(points)) < 0.5, 0.25, 1.0) * band_mm
    return points + rng.normal(size=points.shape) * (spread / np.sqrt(3.0))[:, None]


def _active(
    bare: Tables, points: Float[np.ndarray, "n 3"], residual: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, "x y z"]:
    """Coarse cells where the grid alone is not good enough."""
    from scipy import ndimage

    active = np.zeros(bare.active.shape, dtype=bool)
    wrong = bare.cell_of(points)[np.abs(residual) > LEAST_RESIDUAL_MM]
    active[tuple(wrong.T)] = True
    return ndimage.binary_dilation(active)


def _train(
    bare: Tables,
    points: Float[np.ndarray, "n 3"],
    residual: Float[np.ndarray, " n"],
    device: str,
    seed: int,
    progress: Progress,
) -> Tables:
    """Learn the residual, in coarse cells."""
    import torch

    where = torch_device(device)
    torch.use_deterministic_algorithms(where.type == "cpu")  # the same fit, bit for bit
    generator = torch.Generator().manual_seed(seed)
    levels = len(bare.level_cells_mm)
    tables = torch.nn.Parameter(
        ((torch.rand((levels, TABLE_SIZE, FEATURES), generator=generator) - 0.5) * 2e-2).to(where)
    )
    layers = []
    for fan_in, fan_out in ((levels * FEATURES, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, 1)):
        bound = float(np.sqrt(6.0 / fan_in)) if fan_out > 1 else 0.05
        weight = (torch.rand((fan_out, fan_in), generator=generator) * 2 - 1) * bound
        layers.append(torch.nn.Parameter(weight.to(where)))
        layers.append(torch.nn.Parameter(torch.zeros(fan_out, device=where)))
    optimiser = torch.optim.Adam([tables, *layers], lr=RATE, betas=(0.9, 0.99), eps=1e-12)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS, eta_min=RATE * 0.02)
    slots, weights = _corners(bare, points)
    slots_t = torch.from_numpy(slots).to(where)
    weights_t = torch.from_numpy(weights).to(where)
    target = torch.from_numpy((residual / bare.cell_mm).astype(np.float32)).to(where)
    # where the grid is most wrong, most often; everywhere sometimes, so that planes stay planes
    odds = np.abs(residual) + 0.25 * np.abs(residual).mean() + 1e-9
    edges = np.cumsum(odds / odds.sum())
    rng = np.random.default_rng([seed, 7])
    for step in range(STEPS if len(points) else 0):
        draw = np.minimum(np.searchsorted(edges, rng.random(BATCH)), len(points) - 1)
        pick = torch.from_numpy(np.sort(draw)).to(where)
        features = []
        for level in range(levels):
            corner = tables[level][slots_t[level, pick]]
            features.append((corner * weights_t[level, pick].unsqueeze(-1)).sum(dim=1))
        x = torch.cat(features, dim=1)
        x = torch.relu(torch.nn.functional.linear(x, layers[0], layers[1]))
        x = torch.relu(torch.nn.functional.linear(x, layers[2], layers[3]))
        y = torch.nn.functional.linear(x, layers[4], layers[5]).squeeze(1)
        loss = torch.abs(y - target[pick]).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        progress("fit", 0.35 + 0.6 * (step + 1) / STEPS, 1.0)
    arrays = [p.detach().cpu().numpy().astype(np.float32) for p in (tables, *layers)]
    return bare.trained(*arrays)


def _corners(
    bare: Tables, points: Float[np.ndarray, "n 3"]
) -> tuple[np.ndarray, Float[np.ndarray, "l n 8"]]:
    """(levels, n, 8) table places of each point's corners, and their trilinear weights."""
    slots, weights = [], []
    for level_mm, shape in zip(bare.level_cells_mm, bare.level_shapes, strict=True):
        g = (points - bare.origin_mm) / level_mm
        j = np.clip(np.floor(g).astype(np.int64), 0, shape - 2)
        s = (g - j).astype(np.float32)
        place, share = [], []
        for c in range(8):
            d = np.array([c >> 2, (c >> 1) & 1, c & 1])
            place.append(_slot(j + d, shape))
            share.append(np.where(d, s, 1.0 - s).prod(axis=1))
        slots.append(np.stack(place, axis=1))
        weights.append(np.stack(share, axis=1).astype(np.float32))
    return np.stack(slots), np.stack(weights)


def _slot(node: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """As `learned_kernels.slot`."""
    if int(np.prod(shape)) <= TABLE_SIZE:
        return np.asarray((node[:, 0] * shape[1] + node[:, 1]) * shape[2] + node[:, 2])
    mixed = np.zeros(len(node), dtype=np.uint64)
    for axis in range(3):
        mixed ^= node[:, axis].astype(np.uint64) * np.uint64(PRIMES[axis])
    return np.asarray(mixed & np.uint64(TABLE_SIZE - 1)).astype(np.int64)
