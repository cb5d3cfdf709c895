"""Point-MAE and Point-BERT as feature extractors, from a user's checkpoint; none is included.

The forward pass is written on the checkpoint's own tensors: group the cloud by farthest points,
embed each group, twelve transformer blocks, and the normalised outputs of blocks 4, 8 and 12 side
by side (1,152 numbers a group), as M3DM and Real3D-AD take them. Differences from that code: the
cloud is scaled to the unit sphere, on which the weights were trained, and has 1,024 groups
instead of 16,384, whose attention no CPU can pay for.

References
----------
Pang et al., Masked Autoencoders for Point Cloud Self-supervised Learning (Point-MAE), ECCV 2022.
Yu et al., Point-BERT, CVPR 2022. Wang et al., M3DM, CVPR 2023, section 3.1.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Points
from amrepair.bench.coreset_kernels import farthest_first
from amrepair.device import torch_device
from amrepair.errors import InputError

if TYPE_CHECKING:
    import torch

GROUPS, GROUP_SIZE = 1024, 128
TOKEN_WIDTH, HEADS, DEPTH = 384, 6, 12
TAKEN_BLOCKS = (3, 7, 11)
NORM_EPSILON = 1e-5
PREFIXES = ("module.", "base_model.", "MAE_encoder.", "transformer_q.")
POINT_BERT_EXTRA = ("cls_token", "cls_pos", "reduce_dim.weight", "reduce_dim.bias")


@dataclass(frozen=True, slots=True)
class PointTransformer:
    """A pretrained point transformer.

    Attributes
    ----------
    weights
        Tensors by the names of the published code, without prefixes.
    has_class_token
        Point-BERT has one, Point-MAE has none.
    """

    weights: dict[str, torch.Tensor]
    has_class_token: bool

    def extract(
        self, points_mm: Points
    ) -> tuple[Float[np.ndarray, "g 1152"], Int[np.ndarray, " g"]]:
        """(g, 1152) features of groups, and the (g,) points that the groups are about."""
        import torch

        unit = points_mm - points_mm.mean(axis=0)
        unit = np.ascontiguousarray(unit / np.linalg.norm(unit, axis=1).max(), dtype=np.float32)
        centre = np.asarray(farthest_first(unit, min(GROUPS, len(unit)), 0))
        size = min(GROUP_SIZE, len(unit))
        index = cKDTree(unit).query(unit[centre], k=[*range(1, size + 1)])[1]
        groups = unit[index] - unit[centre][:, None, :]
        device = next(iter(self.weights.values())).device
        with torch.inference_mode():
            features = self.forward(
                torch.from_numpy(groups).to(device), torch.from_numpy(unit[centre]).to(device)
            )
        return features.cpu().numpy(), centre

    def forward(self, groups: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
        """(g, 1152) from (g, m, 3) neighbourhoods about (g, 3) centres."""
        import torch
        from torch.nn import functional as nn

        w = self.weights
        tokens = self._embed(groups)
        position = nn.linear(centres, w["pos_embed.0.weight"], w["pos_embed.0.bias"])
        position = nn.linear(nn.gelu(position), w["pos_embed.2.weight"], w["pos_embed.2.bias"])
        if self.has_class_token:
            tokens = nn.linear(tokens, w["reduce_dim.weight"], w["reduce_dim.bias"])
            tokens = torch.cat([w["cls_token"].reshape(1, TOKEN_WIDTH), tokens])
            position = torch.cat([w["cls_pos"].reshape(1, TOKEN_WIDTH), position])
        taken = []
        for i in range(DEPTH):
            tokens = self._block(tokens + position, f"blocks.blocks.{i}.")
            if i in TAKEN_BLOCKS:
                taken.append(self._norm(tokens, "norm."))
        found = torch.cat(taken, dim=1)
        return found[1:] if self.has_class_token else found

    def _embed(self, groups: torch.Tensor) -> torch.Tensor:
        """A small PointNet: per point, pooled, per point with the pool, pooled."""
        import torch

        hidden = self._convolve(groups, "encoder.first_conv.")
        pooled = hidden.amax(dim=1, keepdim=True).expand(-1, hidden.shape[1], -1)
        hidden = self._convolve(torch.cat([pooled, hidden], dim=2), "encoder.second_conv.")
        return hidden.amax(dim=1)

    def _convolve(self, x: torch.Tensor, name: str) -> torch.Tensor:
        """Convolution of width one, batch norm at rest, ReLU, convolution."""
        import torch
        from torch.nn import functional as nn

        w = self.weights
        x = nn.linear(x, w[name + "0.weight"].squeeze(-1), w[name + "0.bias"])
        spread = torch.sqrt(w[name + "1.running_var"] + NORM_EPSILON)
        x = (x - w[name + "1.running_mean"]) / spread * w[name + "1.weight"] + w[name + "1.bias"]
        return nn.linear(nn.relu(x), w[name + "3.weight"].squeeze(-1), w[name + "3.bias"])

    def _norm(self, x: torch.Tensor, name: str) -> torch.Tensor:
        from torch.nn import functional as nn

        w = self.weights
        return nn.layer_norm(x, (TOKEN_WIDTH,), w[name + "weight"], w[name + "bias"], NORM_EPSILON)

    def _block(self, x: torch.Tensor, name: str) -> torch.Tensor:
        """Pre-norm attention and MLP, each with its residual."""
        from torch.nn import functional as nn

        w = self.weights
        qkv = nn.linear(self._norm(x, name + "norm1."), w[name + "attn.qkv.weight"])
        q, k, v = qkv.reshape(len(x), 3, HEADS, TOKEN_WIDTH // HEADS).permute(1, 2, 0, 3)
        mixed = nn.scaled_dot_product_attention(q[None], k[None], v[None])[0]
        mixed = mixed.transpose(0, 1).reshape(len(x), TOKEN_WIDTH)
        x = x + nn.linear(mixed, w[name + "attn.proj.weight"], w[name + "attn.proj.bias"])
        hidden = nn.linear(
            self._norm(x, name + "norm2."), w[name + "mlp.fc1.weight"], w[name + "mlp.fc1.bias"]
        )
        return x + nn.linear(nn.gelu(hidden), w[name + "mlp.fc2.weight"], w[name + "mlp.fc2.bias"])


def load_checkpoint(path: Path | None, kind: str) -> PointTransformer:
    """Read published weights.

    Parameters
    ----------
    path
        The user's file: `.pth` as published (read without running any code in it) or
        `.safetensors`.
    kind
        `pointmae` or `pointbert`.

    Raises
    ------
    InputError
        If there is no file, it cannot be read safely, or tensors are missing or misshapen.
    """
    published = "pretrain.pth" if kind == "pointmae" else "Point-BERT.pth"
    if path is None:
        raise InputError(
            f"patchcore-{kind} needs pretrained weights and none are included; give the "
            f"checkpoint published with the method ({published}) with --checkpoint"
        )
    if not path.is_file():
        raise InputError(f"{path}: there is no such checkpoint; give the path of {published}")
    weights = {_bare(name): value for name, value in _read(path).items()}
    extra = POINT_BERT_EXTRA if kind == "pointbert" else ()
    wanted = _shapes(256 if kind == "pointbert" else TOKEN_WIDTH)
    for name, shape in wanted.items():
        if name not in weights or tuple(weights[name].shape) != shape:
            got = tuple(weights[name].shape) if name in weights else "nothing"
            raise InputError(
                f"{path}: not a {kind} checkpoint: {name} should be {shape}, there is {got}"
            )
    for name in extra:
        if name not in weights:
            raise InputError(f"{path}: not a {kind} checkpoint: {name} is missing")
    device = torch_device("auto")
    kept = {name: weights[name].float().to(device) for name in (*wanted, *extra)}
    return PointTransformer(kept, has_class_token=kind == "pointbert")


def _read(path: Path) -> dict[str, torch.Tensor]:
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return dict(load_file(path))
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, ValueError, EOFError, OSError, KeyError) as e:
        raise InputError(
            f"{path} cannot be read as a checkpoint without running code in it; if it is one, save "
            "its tensors as .safetensors"
        ) from e
    table = stored.get("base_model", stored) if isinstance(stored, dict) else {}
    return {name: value for name, value in table.items() if isinstance(value, torch.Tensor)}


def _bare(name: str) -> str:
    """The name without the wrappers that training put around the model."""
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return name


def _shapes(channels: int) -> dict[str, tuple[int, ...]]:
    """Every tensor that the forward pass uses."""
    shapes: dict[str, tuple[int, ...]] = {
        "pos_embed.0.weight": (128, 3),
        "pos_embed.0.bias": (128,),
        "pos_embed.2.weight": (TOKEN_WIDTH, 128),
        "pos_embed.2.bias": (TOKEN_WIDTH,),
        "norm.weight": (TOKEN_WIDTH,),
        "norm.bias": (TOKEN_WIDTH,),
    }
    for name, sizes in (("first", (3, 128, 256)), ("second", (512, 512, channels))):
        stem = f"encoder.{name}_conv."
        shapes |= {f"{stem}0.weight": (sizes[1], sizes[0], 1), f"{stem}0.bias": (sizes[1],)}
        shapes |= {f"{stem}3.weight": (sizes[2], sizes[1], 1), f"{stem}3.bias": (sizes[2],)}
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{stem}1.{part}"] = (sizes[1],)
    for i in range(DEPTH):
        stem = f"blocks.blocks.{i}."
        shapes |= {f"{stem}norm{k}.{p}": (TOKEN_WIDTH,) for k in (1, 2) for p in ("weight", "bias")}
        shapes |= {
            f"{stem}attn.qkv.weight": (3 * TOKEN_WIDTH, TOKEN_WIDTH),
            f"{stem}attn.proj.weight": (TOKEN_WIDTH, TOKEN_WIDTH),
            f"{stem}attn.proj.bias": (TOKEN_WIDTH,),
            f"{stem}mlp.fc1.weight": (4 * TOKEN_WIDTH, TOKEN_WIDTH),
            f"{stem}mlp.fc1.bias": (4 * TOKEN_WIDTH,),
            f"{stem}mlp.fc2.weight": (TOKEN_WIDTH, 4 * TOKEN_WIDTH),
            f"{stem}mlp.fc2.bias": (TOKEN_WIDTH,),
        }
    return shapes
