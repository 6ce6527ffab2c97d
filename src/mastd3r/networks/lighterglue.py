"""LighterGlue, attention over the features of two images that says which belong together, written anew.

Lindenberger et al., "LightGlue: Local Feature Matching at Light Speed", ICCV 2023, in the small size that was trained
on XFeat: 6 layers, one head, 96 channels. Attribute names are those of the released checkpoint.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

Array = NDArray[Any]
LAYERS, DIM, DIM_IN = 6, 96, 64
LEAST_SCORE = 0.1  # of a pair
UNMATCHABLE = 0.05  # a feature that probably has no partner takes no further part


class _Rest(nn.Sequential):
    """What a message changes of a feature."""

    def __init__(self) -> None:
        super().__init__(nn.Linear(2 * DIM, 2 * DIM), nn.LayerNorm(2 * DIM), nn.GELU(), nn.Linear(2 * DIM, DIM))


class _Self(nn.Module):
    """Features of one image look at one another; where they are turns queries and keys."""

    def __init__(self) -> None:
        super().__init__()
        self.Wqkv, self.out_proj, self.ffn = nn.Linear(DIM, 3 * DIM), nn.Linear(DIM, DIM), _Rest()

    def forward(self, x: Tensor, turns: Tensor) -> Tensor:
        q, k, v = self.Wqkv(x).unflatten(-1, (DIM, 3)).unbind(-1)
        message = _attention(_turned(q, turns), _turned(k, turns), v)
        return x + self.ffn(torch.cat([x, self.out_proj(message)], -1))


class _Cross(nn.Module):
    """Features of one image look at those of the other, by one likeness for both ways."""

    def __init__(self) -> None:
        super().__init__()
        self.to_qk, self.to_v, self.to_out = (nn.Linear(DIM, DIM) for _ in range(3))
        self.ffn = _Rest()

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        qk_a, qk_b = self.to_qk(a), self.to_qk(b)
        to_a, to_b = _attention(qk_a, qk_b, self.to_v(b)), _attention(qk_b, qk_a, self.to_v(a))
        return self._changed(a, to_a), self._changed(b, to_b)

    def _changed(self, x: Tensor, message: Tensor) -> Tensor:
        return x + self.ffn(torch.cat([x, self.to_out(message)], -1))


class _Layer(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.self_attn, self.cross_attn = _Self(), _Cross()

    def attend(self, a: Tensor, b: Tensor, turns_a: Tensor, turns_b: Tensor) -> tuple[Tensor, Tensor]:
        return self.cross_attn(self.self_attn(a, turns_a), self.self_attn(b, turns_b))


class _Assignment(nn.Module):
    """Log-probability of every pair, and of having a partner at all."""

    def __init__(self) -> None:
        super().__init__()
        self.matchability, self.final_proj = nn.Linear(DIM, 1), nn.Linear(DIM, DIM)

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        alike = self.final_proj(a) @ self.final_proj(b).T / DIM**0.5
        partner = F.logsigmoid(self.matchability(a)) + F.logsigmoid(self.matchability(b)).T
        return alike.log_softmax(1) + alike.log_softmax(0) + partner

    def matchable(self, x: Tensor) -> Tensor:
        """(n,) bool."""
        return self.matchability(x)[:, 0].sigmoid() > UNMATCHABLE


class LighterGlueNetwork(nn.Module):
    """Pairs of features."""

    def __init__(self) -> None:
        super().__init__()
        self.input_proj = nn.Linear(DIM_IN, DIM)
        self.posenc = nn.ModuleDict({"Wr": nn.Linear(2, DIM // 2, bias=False)})
        self.transformers = nn.ModuleList([_Layer() for _ in range(LAYERS)])
        self.log_assignment = nn.ModuleList(_Assignment() for _ in range(LAYERS))

    def forward(self, places: tuple[Tensor, Tensor], described: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """(m, 2) rows of both images that belong together, and (m,) probability.

        places (n, 2): pixels in units of half the longer side, from the centre; described (n, 64).
        """
        a, b = (self.input_proj(d) for d in described)
        turns_a, turns_b = (_turns(self.posenc["Wr"](p)) for p in places)
        rows_a, rows_b = torch.arange(len(a)), torch.arange(len(b))
        stages: Any = zip(self.transformers, self.log_assignment, strict=True)
        for n, (layer, assignment) in enumerate(stages):
            a, b = layer.attend(a, b, turns_a, turns_b)
            if n == LAYERS - 1:
                break
            keep_a, keep_b = assignment.matchable(a), assignment.matchable(b)
            a, b, rows_a, rows_b = a[keep_a], b[keep_b], rows_a[keep_a], rows_b[keep_b]
            turns_a, turns_b = turns_a[:, keep_a], turns_b[:, keep_b]
            if len(a) == 0 or len(b) == 0:
                return torch.zeros((0, 2), dtype=torch.long), torch.zeros(0)
        score = self.log_assignment[LAYERS - 1](a, b)
        best, at = score.max(1)
        mutual = (score.argmax(0)[at] == torch.arange(len(a))) & (best > np.log(LEAST_SCORE))
        return torch.stack([rows_a[mutual], rows_b[at[mutual]]], 1), best[mutual].exp()


class LighterGlue:
    """The network with its weights."""

    def __init__(self, weights: dict[str, Tensor]) -> None:
        """``weights``: of the released checkpoint. Raises ValueError and RuntimeError where they do not fit."""
        self.network = LighterGlueNetwork().eval()
        own = {k.removeprefix("matcher."): v for k, v in weights.items() if k.startswith("matcher.")}
        self.network.load_state_dict({k: v for k, v in own.items() if not k.startswith("token_confidence")})
        if not all(bool(torch.isfinite(v).all()) for v in self.network.state_dict().values()):
            raise ValueError("weights that are not finite")

    @torch.inference_mode()
    def match(
        self, px: tuple[Array, Array], described: tuple[Array, Array], size: tuple[int, int]
    ) -> tuple[Array, Array]:
        """(m, 2) rows of two images' features that belong together, (m,) probability.

        px: (n, 2) pixels; described: (n, 64) unit length; size (width, height) of both images.
        """
        if min(len(px[0]), len(px[1])) == 0:
            return np.zeros((0, 2), int), np.zeros(0)
        centre, unit = np.array(size, np.float32) / 2, max(size) / 2
        places = tuple(torch.from_numpy(((p - centre) / unit).astype(np.float32)) for p in px)
        rows, score = self.network(places, tuple(torch.from_numpy(d) for d in described))
        return rows.numpy(), score.numpy().astype(float)


def _attention(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """(n, c) of (n, c), (m, c) and (m, c); torch's fast way wants a batch and a head."""
    return F.scaled_dot_product_attention(query[None, None], key[None, None], value[None, None])[0, 0]


def _turns(angles: Tensor) -> Tensor:
    """(2, n, 96) cosines and sines, each angle for two channels beside one another."""
    return torch.stack([angles.cos(), angles.sin()]).repeat_interleave(2, -1)


def _turned(x: Tensor, turns: Tensor) -> Tensor:
    quarter = torch.stack([-x[:, 1::2], x[:, ::2]], -1).flatten(-2)
    return x * turns[0] + quarter * turns[1]
