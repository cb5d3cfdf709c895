"""Fitting the paper recipe: PASDF's network, sampling, loss and schedule (section 3.2).

The released code's differences and the ablation without encoding are options by name. torch is
loaded on first use. On two CPU cores the released schedule (2.4 million steps of 16) takes more
than an hour: raise `batch` and `rate`, lower `epochs`, and say so beside any figure.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from amrepair.arrays import Points, Values, Vector
from amrepair.device import torch_device
from amrepair.errors import TemplateError
from amrepair.template.mesh_sdf import MeshSdf
from amrepair.template.network import Architecture, PaperSdf
from amrepair.template.surface import sample_surface
from gcode.progress import Progress, silent

if TYPE_CHECKING:
    import torch

NETWORK_HELD_OUT_POINTS = 20_000
CLOUD_POINTS = 200_000  # that stand for the surface where distances are taken from a cloud
DISTANCE_KINDS = ("mesh", "cloud")


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """Recipe of the paper; where it is silent, of the released code.

    Attributes
    ----------
    encoding, frequencies, max_exponent, layers, width, skip
        As in `Architecture`; `encoding=False` is the paper's ablation.
    dropout
        Share of units left out in training.
    norm_skip
        Whether the layer before the skip is weight-normalised like the others.
    surface, box, volume
        Queries on the surface, in its box, in the unit volume [−1, 1]³.
    box_ratio
        The box is the part's own, so much larger.
    distances
        `mesh`: exact; `cloud`: to the nearest of 200,000 surface points, sign of the offset
        against its normal (supplement, eq. 1).
    clamp
        d_max of the clamped L1 loss, in radii.
    epochs, batch, rate
        Of Adam.
    decay, patience
        The rate falls by the factor when the validation loss has not fallen for so many epochs.
    validation
        Share of the queries held back; the weights that do best on them are kept.
    """

    encoding: bool = True
    frequencies: int = 10
    max_exponent: float = 4.0
    layers: int = 8
    width: int = 256
    skip: int = 4
    dropout: float = 0.2
    norm_skip: bool = True
    surface: int = 10_000
    box: int = 10_000
    volume: int = 3_000
    box_ratio: float = 1.3
    distances: str = "mesh"
    clamp: float = 0.1
    epochs: int = 2_000
    batch: int = 16
    rate: float = 1e-5
    decay: float = 0.9
    patience: int = 20
    validation: float = 0.15

    def __post_init__(self) -> None:
        if self.distances not in DISTANCE_KINDS:
            raise TemplateError(
                f"distances from '{self.distances}' are unknown; choose {', '.join(DISTANCE_KINDS)}"
            )
        if self.epochs < 1 or self.batch < 1 or self.surface + self.box + self.volume < 100:
            raise TemplateError(
                f"the paper recipe needs an epoch, a batch and 100 queries at least; got "
                f"{self.epochs}, {self.batch} and {self.surface + self.box + self.volume}"
            )
        if not (0 <= self.dropout < 1 and 0 < self.validation < 1 and self.rate > 0):
            raise TemplateError(
                f"dropout {self.dropout}, validation {self.validation} and rate {self.rate} must "
                "be in [0, 1), (0, 1) and above 0"
            )

    @property
    def architecture(self) -> Architecture:
        """Shape of the network."""
        return Architecture(
            encoding=self.encoding,
            frequencies=self.frequencies,
            max_exponent=self.max_exponent,
            layers=self.layers,
            width=self.width,
            skip=self.skip,
        )


PUBLISHED_NETWORK = PaperOptions()
# The released code: no dropout, the plain box, the skip layer without weight norm.
RELEASED_NETWORK = replace(PUBLISHED_NETWORK, dropout=0.0, box_ratio=1.0, norm_skip=False)
NETWORK_VARIANTS = {"paper": PUBLISHED_NETWORK, "code": RELEASED_NETWORK}


def fit_paper(
    exact: MeshSdf,
    *,
    options: PaperOptions = PUBLISHED_NETWORK,
    device: str = "auto",
    seed: int = 0,
    metadata: dict[str, str] | None = None,
    progress: Progress = silent,
) -> PaperSdf:
    """Fit a network to an exact field.

    Parameters
    ----------
    exact
        The closed mesh's own field.
    seed
        Of the queries, the initial weights, dropout and the order of training.
    """
    rng = np.random.default_rng(seed)
    vertices, faces = np.asarray(exact.mesh.vertices), np.asarray(exact.mesh.faces)
    cloud, normals, _ = sample_surface(vertices, faces, count=CLOUD_POINTS)
    centre_mm = cloud.mean(axis=0)
    radius_mm = float(np.linalg.norm(vertices - centre_mm, axis=1).max())
    points_mm = _queries(exact, centre_mm, radius_mm, options, rng)
    if options.distances == "cloud":
        distance_mm = _from_cloud(points_mm, cloud, normals)
    else:
        distance_mm = exact.distance(points_mm)
    local = ((points_mm - centre_mm) / radius_mm).astype(np.float32)
    target = np.clip(distance_mm / radius_mm, -options.clamp, options.clamp).astype(np.float32)
    weights, biases, steps = _train(local, target, options, device, seed, progress)
    said = {"settings": json.dumps(asdict(options)), **(metadata or {}), "steps": str(steps)}
    made = PaperSdf(
        architecture=options.architecture,
        weights=weights,
        biases=biases,
        centre_mm=centre_mm,
        radius_mm=radius_mm,
        mesh=exact.mesh,
        bias_mm=0.0,
        metadata=said,
    )
    held = sample_surface(
        vertices, faces, count=NETWORK_HELD_OUT_POINTS, offset=float(rng.random())
    )[0]
    return replace(made, bias_mm=float(np.quantile(np.abs(made.distance(held)), 0.99)))


def _queries(
    exact: MeshSdf,
    centre_mm: Vector,
    radius_mm: float,
    options: PaperOptions,
    rng: np.random.Generator,
) -> Points:
    """(n, 3) where the network is taught: surface, box, unit volume."""
    vertices, faces = np.asarray(exact.mesh.vertices), np.asarray(exact.mesh.faces)
    on = sample_surface(vertices, faces, count=max(options.surface, 1), offset=rng.random())[0]
    low, high = exact.bounds_mm
    middle, half = (low + high) / 2, (high - low) / 2 * options.box_ratio
    around = rng.uniform(middle - half, middle + half, (options.box, 3))
    anywhere = centre_mm + radius_mm * rng.uniform(-1, 1, (options.volume, 3))
    return np.concatenate([on[: options.surface], around, anywhere])


def _from_cloud(
    points_mm: Points, cloud_mm: Float[np.ndarray, "m 3"], normals: Float[np.ndarray, "m 3"]
) -> Values:
    """Supplement, eq. (1): nearest surface point; sign of the offset against its normal."""
    distance, index = cKDTree(cloud_mm).query(points_mm, workers=-1)
    side = ((points_mm - cloud_mm[index]) * normals[index]).sum(axis=1)
    return np.asarray(np.where(side < 0, -distance, distance))


def _network(options: PaperOptions) -> Any:
    """Layers in training form: weight norm and dropout."""
    import torch
    from torch.nn.utils.parametrizations import weight_norm

    layers = []
    sizes = options.architecture.sizes
    for k, (into, out) in enumerate(sizes):
        layer = torch.nn.Linear(into, out)
        is_plain = k == len(sizes) - 1 or (k == options.skip - 1 and not options.norm_skip)
        layers.append(layer if is_plain else weight_norm(layer))
    return torch.nn.ModuleList(layers)


def _forward(layers: Any, inputs: torch.Tensor, options: PaperOptions, training: bool) -> Any:
    import torch

    x = inputs
    for k, layer in enumerate(layers):
        if k == len(layers) - 1:
            return torch.tanh(layer(x)).squeeze(1)
        x = torch.nn.functional.dropout(torch.relu(layer(x)), options.dropout, training)
        if k == options.skip - 1:
            x = torch.cat([x, inputs], dim=1)
    return x


def _train(
    local: Points, target: Values, options: PaperOptions, device: str, seed: int, progress: Progress
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...], int]:
    """Weights and biases that did best on the validation queries, and the steps taken."""
    import torch

    where = torch_device(device)
    order = np.random.default_rng([seed, 3]).permutation(len(local))
    held = max(1, round(options.validation * len(local)))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        layers = _network(options).to(where)
        optimiser = torch.optim.Adam(layers.parameters(), lr=options.rate)
        schedule = torch.optim.lr_scheduler.ReduceLROnPlateau(
            optimiser, factor=options.decay, patience=options.patience
        )
        x = options.architecture.encode(torch.from_numpy(local[order]).to(where))
        y = torch.from_numpy(target[order]).to(where)
        best, kept, steps = np.inf, _folded(layers), 0
        batch = min(options.batch, len(local) - held)
        for epoch in range(options.epochs):
            draw = held + torch.randperm(len(local) - held).to(where)
            for first in range(0, len(draw) - batch + 1, batch):
                pick = draw[first : first + batch]
                loss = _clamped(_forward(layers, x[pick], options, True), y[pick], options)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                steps += 1
            with torch.no_grad():
                judged = float(
                    _clamped(_forward(layers, x[:held], options, False), y[:held], options)
                )
            schedule.step(judged)
            if judged < best:
                best, kept = judged, _folded(layers)
            progress("fit", float(epoch + 1), float(options.epochs))
    return (*kept, steps)


def _clamped(found: torch.Tensor, wanted: torch.Tensor, options: PaperOptions) -> Any:
    """Clamped L1; the wanted distances are clamped already."""
    import torch

    return torch.abs(torch.clamp(found, -options.clamp, options.clamp) - wanted).mean()


def _folded(layers: Any) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Plain float32 arrays, weight norm multiplied out."""
    return (
        tuple(layer.weight.detach().cpu().numpy().astype(np.float32) for layer in layers),
        tuple(layer.bias.detach().cpu().numpy().copy() for layer in layers),
    )
