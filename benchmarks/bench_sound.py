"""What is learned from sound parts: sites of the surface beside a coordinate network, in one run.

    python benchmarks/bench_sound.py [--scans 5] [--points 60000] [--steps 1500] [--seed 0]

The part is a block of 60 × 40 × 20 mm that a printer leaves with an elephant's foot of 0.25 mm over
the first millimetre, edges along Z rounded to 0.6 mm, and 0.4 % shrinkage; a further sound part is
0.02 mm larger or smaller. The truth is the formula. Both learn from the same scans (noise 0.03 mm):
`sites` is `amrepair.template.sound.learn`; `network` a coordinate network of the kind of PASDF's
(sinusoidal encoding, 4 × 64, ReLU, L1) on the deviation over place and normal. Judged on what each
says of a further part's points: root mean square and 99 % of what is left, and seconds.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch
import trimesh

from amrepair.frames import unit_vectors
from amrepair.template import MeshSdf
from amrepair.template.fit import fit_fast
from amrepair.template.grid import GridSdf
from amrepair.template.sound import learn

SIZE_MM = np.array([60.0, 40.0, 20.0])
SIGMA_MM, PART_SIGMA_MM = 0.03, 0.02
FOOT_MM, FOOT_HIGH_MM, SHRINK, ROUND_MM = 0.25, 1.0, 0.004, 0.6
OCTAVES, WIDTH, LAYERS, BATCH, RATE = 6, 64, 4, 4_096, 2e-3
Offsets = Callable[[np.ndarray, np.ndarray], np.ndarray]  # places, outward normals: mm


def printed(seed: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """A noisy scan of one print, and where its surface truly is."""
    rng = np.random.default_rng(seed)
    box = trimesh.creation.box(extents=SIZE_MM)
    place, face = trimesh.sample.sample_surface(box, points, seed=seed)
    place, normal = np.array(place), np.array(box.face_normals[face])
    half = SIZE_MM / 2
    # a corner rounded to r lies inside the drawn one by r − √(r² − (r − u)²), u from the edge
    for axis in (0, 1):
        other = 1 - axis
        on = np.abs(normal[:, axis]) > 0.5
        u = np.clip(half[other] - np.abs(place[:, other]), 0.0, ROUND_MM)
        sink = ROUND_MM - np.sqrt(ROUND_MM**2 - (ROUND_MM - u) ** 2)
        place[on] -= sink[on, None] * normal[on]
    foot = (np.abs(normal[:, 2]) < 0.5) & (place[:, 2] < -half[2] + FOOT_HIGH_MM)
    place[foot] += FOOT_MM * normal[foot]
    place = (1 - SHRINK) * place + rng.normal(0, PART_SIGMA_MM) * normal
    return place + rng.normal(0, SIGMA_MM, place.shape), place


def by_network(template: GridSdf, scans: list[np.ndarray], steps: int, seed: int) -> Offsets:
    """A coordinate network fitted to every point's deviation."""
    torch.manual_seed(seed)
    points = np.concatenate(scans)
    f_mm, gradient = template.distance_and_gradient(points)
    near = np.abs(f_mm) < 2.0
    inputs = encoded(points[near] - f_mm[near, None] * (out := unit_vectors(gradient[near])), out)
    targets = torch.tensor(f_mm[near], dtype=torch.float32)
    sizes = [inputs.shape[1], *([WIDTH] * LAYERS)]
    layers: list[torch.nn.Module] = []
    for a, b in pairwise(sizes):
        layers += [torch.nn.Linear(a, b), torch.nn.ReLU()]
    net = torch.nn.Sequential(*layers, torch.nn.Linear(WIDTH, 1))
    optimizer = torch.optim.Adam(net.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        pick = torch.randint(len(targets), (BATCH,))
        loss = (net(inputs[pick])[:, 0] - targets[pick]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()

    def offsets(place_mm: np.ndarray, outward: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(net(encoded(place_mm, outward))[:, 0], dtype=np.float64)

    return offsets


def encoded(place_mm: np.ndarray, outward: np.ndarray) -> torch.Tensor:
    """Places in units of the part with sines and cosines of octaves, and normals as they are."""
    x = place_mm / SIZE_MM.max()
    angles = (2.0 ** np.arange(OCTAVES) * np.pi)[:, None, None] * x
    waves = np.concatenate([np.sin(angles), np.cos(angles)]).transpose(1, 0, 2)
    return torch.tensor(
        np.column_stack([x, outward, waves.reshape(len(x), -1)]), dtype=torch.float32
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=5)
    parser.add_argument("--points", type=int, default=60_000)
    parser.add_argument("--steps", type=int, default=1_500)
    parser.add_argument("--seed", type=int, default=0)
    said = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {said.scans} scans\n")
    template = fit_fast(MeshSdf.from_mesh(trimesh.creation.box(extents=SIZE_MM)), seed=said.seed)
    first = 1000 * said.seed
    scans = [printed(first + k, said.points)[0] for k in range(said.scans)]
    other = printed(first + said.scans, said.points)[1]
    f_mm, gradient = template.distance_and_gradient(other)
    outward = unit_vectors(gradient)
    feet = other - f_mm[:, None] * outward
    start = time.process_time()
    learned, _ = learn(template, scans)
    sites_s, start = time.process_time() - start, time.process_time()
    network = by_network(template, scans, said.steps, said.seed)
    network_s = time.process_time() - start
    left = {
        "the drawing alone": (f_mm, 0.0),
        "sites": (learned.distance(other), sites_s),
        f"network, {said.steps} steps": (f_mm - network(feet, outward), network_s),
        "what parts differ by": (np.full(1, PART_SIGMA_MM), 0.0),
    }
    print("| | left, rms mm | left, 99 % mm | processor s |\n|---|---|---|---|")
    for name, (off_mm, seconds) in left.items():
        rms, most = np.sqrt(np.mean(off_mm**2)), np.quantile(np.abs(off_mm), 0.99)
        print(f"| {name} | {rms:.3f} | {most:.3f} | {seconds:.1f} |")


if __name__ == "__main__":
    main()
