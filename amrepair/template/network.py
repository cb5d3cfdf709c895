"""`PaperSdf`: a template as PASDF has it, one coordinate network for the whole field.

It answers with torch, loaded on first use, in batches and with exact gradients. Fitting is
`paper`'s business. It is 20 times slower than `GridSdf` and saturates at the training clamp.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Points, Values, Vector
from amrepair.errors import TemplateError
from amrepair.template.file import require_kind, stored_mesh, stored_metadata, write_template
from amrepair.template.shape import MeshShape

if TYPE_CHECKING:
    import torch
    import trimesh

NETWORK_KIND = "network"
CHUNK = 1 << 16  # bounds the memory of one pass
# The network was trained on [-1, 1]³; farther out it is asked at the nearest point of this cube.
CUBE = 1.05


@dataclass(frozen=True, slots=True)
class Architecture:
    """Shape of the network.

    Attributes
    ----------
    encoding, frequencies, max_exponent
        Whether coordinates are joined by sines and cosines at so many frequencies from 2⁰ to
        2^max_exponent, spaced evenly in the exponent.
    layers, width, skip
        Fully connected layers in all, their width, and after which one the input joins again.
    """

    encoding: bool = True
    frequencies: int = 10
    max_exponent: float = 4.0
    layers: int = 8
    width: int = 256
    skip: int = 4

    def __post_init__(self) -> None:
        if not 0 < self.skip < self.layers - 1 or self.width <= self.inputs:
            raise TemplateError(
                f"a network of {self.layers} layers of {self.width} cannot take its "
                f"{self.inputs} inputs again after layer {self.skip}; choose 1 to "
                f"{self.layers - 2}, and a width above {self.inputs}"
            )

    @property
    def inputs(self) -> int:
        """Numbers that stand for a point."""
        return 3 + 6 * self.frequencies if self.encoding else 3

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(in, out) of each layer."""
        out = [self.width] * (self.layers - 1) + [1]
        out[self.skip - 1] -= self.inputs
        into = [self.inputs] + [self.width] * (self.layers - 1)
        return list(zip(into, out, strict=True))

    def encode(self, points: torch.Tensor) -> torch.Tensor:
        """(n, inputs) of (n, 3)."""
        import torch

        if not self.encoding:
            return points
        exponents = torch.linspace(0.0, self.max_exponent, self.frequencies, device=points.device)
        scaled = points[:, None, :] * (2.0**exponents)[None, :, None]
        waves = torch.stack([torch.sin(scaled), torch.cos(scaled)], dim=2)
        return torch.cat([points, waves.reshape(len(points), -1)], dim=1)


@dataclass(frozen=True, slots=True)
class PaperSdf(MeshShape):
    """A fitted network (`Template`).

    Attributes
    ----------
    weights, biases
        Of each layer, (out, in) and (out,), float32, weight normalisation multiplied out.
    centre_mm, radius_mm
        The network's own frame: x = (p − centre) / radius, and so its distances.
    mesh
        The closed mesh that it was fitted to.
    bias_mm
        99th percentile of |f| on points of the surface that training never saw.
    """

    architecture: Architecture
    weights: tuple[Float[np.ndarray, "_o _i"], ...]
    biases: tuple[Float[np.ndarray, " _o"], ...]
    centre_mm: Vector
    radius_mm: float
    mesh: trimesh.Trimesh
    bias_mm: float
    metadata: dict[str, str] = field(default_factory=dict)

    def distance(self, points_mm: Points) -> Values:
        """(n,) signed distance, mm, negative inside."""
        import torch

        found = np.empty(len(points_mm))
        with torch.no_grad():
            for chunk, inside, beyond in self._chunks(points_mm):
                norm = np.linalg.norm(beyond, axis=1)
                found[chunk] = self._answer(inside).numpy() + norm
        return found * self.radius_mm

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        """(n,) signed distance and (n, 3) its gradient, by differentiating the network."""
        import torch

        found, gradient = np.empty(len(points_mm)), np.empty((len(points_mm), 3))
        for chunk, inside, beyond in self._chunks(points_mm):
            norm = np.linalg.norm(beyond, axis=1)
            inside.requires_grad_(True)
            answer = self._answer(inside)
            (slope,) = torch.autograd.grad(answer.sum(), inside)
            found[chunk] = answer.detach().numpy() + norm
            # Along clamped coordinates the network is constant and the distance to the cube grows.
            gradient[chunk] = np.where(beyond != 0, 0.0, slope.numpy())
            gradient[chunk] += beyond / np.maximum(norm, 1e-12)[:, None]
        return found * self.radius_mm, gradient

    def _chunks(
        self, points_mm: Points
    ) -> Iterator[tuple[slice, torch.Tensor, Float[np.ndarray, "k 3"]]]:
        """Slices, their points in the network's frame and cube, and what lies beyond it."""
        import torch

        for start in range(0, len(points_mm), CHUNK):
            chunk = slice(start, start + CHUNK)
            local = (points_mm[chunk] - self.centre_mm) / self.radius_mm
            clamped = np.clip(local, -CUBE, CUBE)
            yield chunk, torch.from_numpy(clamped.astype(np.float32)), local - clamped

    def _answer(self, local: torch.Tensor) -> torch.Tensor:
        """(k,) network's distance at (k, 3), both in radii."""
        import torch

        inputs = self.architecture.encode(local)
        x = inputs
        last = len(self.weights) - 1
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.nn.functional.linear(x, torch.from_numpy(weight), torch.from_numpy(bias))
            x = torch.tanh(x) if k == last else torch.relu(x)
            if k == self.architecture.skip - 1:
                x = torch.cat([x, inputs], dim=1)
        return x.squeeze(1)

    def save(self, path: Path) -> None:
        """Write the template's file, whole or not at all."""
        arrays: dict[str, np.ndarray] = {
            "vertices_mm": np.asarray(self.mesh.vertices, dtype=np.float64),
            "faces": np.asarray(self.mesh.faces, dtype=np.int32),
        }
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight_{k}"], arrays[f"bias_{k}"] = weight, bias
        head = {
            "kind": NETWORK_KIND,
            "architecture": asdict(self.architecture),
            "centre_mm": self.centre_mm.tolist(),
            "radius_mm": self.radius_mm,
            "bias_mm": self.bias_mm,
            **self.metadata,
        }
        write_template(path, arrays, head)

    @classmethod
    def unpacked(cls, path: Path, arrays: dict[str, np.ndarray], head: dict[str, Any]) -> PaperSdf:
        """The template in a file's arrays and head."""
        require_kind(path, head.get("kind"), NETWORK_KIND)
        known = {f.name for f in fields(Architecture)}
        said = head["architecture"]
        if not isinstance(said, dict) or set(said) != known:
            raise TemplateError(
                f"{path} describes its network by {json.dumps(said)[:80]}, which this version "
                "does not know; fit it again"
            )
        architecture = Architecture(**said)
        weights = tuple(arrays[f"weight_{k}"] for k in range(architecture.layers))
        biases = tuple(arrays[f"bias_{k}"] for k in range(architecture.layers))
        found = [(w.shape[1], w.shape[0]) for w in weights]
        if found != architecture.sizes:
            raise TemplateError(f"{path} has layers that do not fit each other; fit it again")
        return cls(
            architecture=architecture,
            weights=weights,
            biases=biases,
            centre_mm=np.array(head["centre_mm"], dtype=np.float64),
            radius_mm=float(head["radius_mm"]),
            mesh=stored_mesh(path, arrays),
            bias_mm=float(head["bias_mm"]),
            metadata=stored_metadata(head),
        )
