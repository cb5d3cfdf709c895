"""The point transformers out of torch's own modules, and weights for them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from amrepair.bench.pointmae import DEPTH, HEADS, TOKEN_WIDTH, _shapes


def random_weights(kind: str) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = _shapes(256 if kind == "pointbert" else TOKEN_WIDTH)
    if kind == "pointbert":
        shapes |= {"cls_token": (1, 1, TOKEN_WIDTH), "cls_pos": (1, 1, TOKEN_WIDTH)}
        shapes |= {"reduce_dim.weight": (TOKEN_WIDTH, 256), "reduce_dim.bias": (TOKEN_WIDTH,)}
    weights = {n: 0.05 * torch.randn(s, generator=generator) for n, s in shapes.items()}
    return {n: v.abs() + 0.5 if n.endswith("running_var") else v for n, v in weights.items()}


def save(path: Path, kind: str, weights: dict[str, torch.Tensor]) -> Path:
    """As the training scripts do: wrapped twice, with bookkeeping beside the model."""
    prefix = "module.MAE_encoder." if kind == "pointmae" else "module.transformer_q."
    table = {prefix + name: value for name, value in weights.items()}
    table["module.other.head"] = torch.zeros(3)
    torch.save({"base_model": table, "epoch": 300, "metrics": {}}, path)
    return path


class Reference(nn.Module):
    """The published architecture out of torch's own modules."""

    def __init__(self, kind: str, weights: dict[str, torch.Tensor]) -> None:
        super().__init__()
        self.kind, self.w = kind, weights
        channels = 256 if kind == "pointbert" else TOKEN_WIDTH
        self.first = self.pair(3, 128, 256, "encoder.first_conv.")
        self.second = self.pair(512, 512, channels, "encoder.second_conv.")
        self.blocks = [self.block(i) for i in range(DEPTH)]

    def pair(self, a: int, b: int, c: int, name: str) -> nn.Sequential:
        made = nn.Sequential(nn.Conv1d(a, b, 1), nn.BatchNorm1d(b), nn.ReLU(), nn.Conv1d(b, c, 1))
        own = {k[len(name) :]: v for k, v in self.w.items() if k.startswith(name)}
        own["1.num_batches_tracked"] = torch.tensor(0)
        made.load_state_dict(own)
        return made.eval()

    def block(self, i: int) -> nn.TransformerEncoderLayer:
        layer = nn.TransformerEncoderLayer(
            TOKEN_WIDTH, HEADS, 4 * TOKEN_WIDTH, 0.0, "gelu", batch_first=True, norm_first=True
        )
        name = f"blocks.blocks.{i}."
        layer.load_state_dict(
            {
                "self_attn.in_proj_weight": self.w[name + "attn.qkv.weight"],
                "self_attn.in_proj_bias": torch.zeros(3 * TOKEN_WIDTH),
                "self_attn.out_proj.weight": self.w[name + "attn.proj.weight"],
                "self_attn.out_proj.bias": self.w[name + "attn.proj.bias"],
                "linear1.weight": self.w[name + "mlp.fc1.weight"],
                "linear1.bias": self.w[name + "mlp.fc1.bias"],
                "linear2.weight": self.w[name + "mlp.fc2.weight"],
                "linear2.bias": self.w[name + "mlp.fc2.bias"],
                **{f"norm{k}.{p}": self.w[f"{name}norm{k}.{p}"]
                   for k in (1, 2) for p in ("weight", "bias")},
            }
        )  # fmt: skip
        return layer.train()  # no dropout; keeps torch off its fused path

    def forward(self, groups: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
        hidden = self.first(groups.transpose(1, 2))
        pooled = hidden.max(dim=2, keepdim=True).values.expand_as(hidden)
        tokens = self.second(torch.cat([pooled, hidden], dim=1)).max(dim=2).values
        w = self.w
        position = centres @ w["pos_embed.0.weight"].T + w["pos_embed.0.bias"]
        position = nn.GELU()(position) @ w["pos_embed.2.weight"].T + w["pos_embed.2.bias"]
        if self.kind == "pointbert":
            tokens = tokens @ w["reduce_dim.weight"].T + w["reduce_dim.bias"]
            tokens = torch.cat([w["cls_token"][0], tokens])
            position = torch.cat([w["cls_pos"][0], position])
        taken, x = [], tokens
        for i, layer in enumerate(self.blocks):
            x = layer((x + position)[None])[0]
            if i in (3, 7, 11):
                taken.append(
                    nn.functional.layer_norm(x, (TOKEN_WIDTH,), w["norm.weight"], w["norm.bias"])
                )
        out = torch.cat(taken, dim=1)
        return out[1:] if self.kind == "pointbert" else out
