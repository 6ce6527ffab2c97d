"""Recorded layers: the bookkeeping around CUDA graphs, with recordings that are played on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from known_pair import decoded, look
from mastd3r.networks import pair as pair_module
from mastd3r.networks.dinov2 import Dinov2Features
from mastd3r.networks.mast3r import Mast3rConfig, random_mast3r
from mastd3r.networks.matching import RecordedMatching, match_pixels
from mastd3r.networks.pair import NetworkPair, PairNetwork
from mastd3r.networks.record import MOST_SHAPES, Recorder, _Recording
from mastd3r.pointmap.matching import MatchOptions


@dataclass
class OnHost:
    """A recording as CUDA has it: fixed memory in, fixed memory out, and nothing else is looked at."""

    call: Callable[..., Any]
    inputs: tuple[Tensor, ...]
    outputs: Any
    played: int = 0

    def replay(self) -> None:
        self.played += 1
        for kept, new in zip(tree_leaves(self.outputs), tree_leaves(self.call(*self.inputs)), strict=True):
            kept.copy_(new)


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> list[OnHost]:
    made: list[OnHost] = []

    def record(self: Recorder, call: Callable[..., Any], given: tuple[Tensor, ...]) -> _Recording:
        inputs = tuple(t.clone() for t in given)
        made.append(OnHost(call, inputs, call(*inputs)))
        return _Recording(made[-1], inputs, made[-1].outputs)

    monkeypatch.setattr(Recorder, "_record", record)
    monkeypatch.setattr(pair_module, "can_record", lambda _: True)
    return made


def photograph(width: int, height: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)


def pairs_of(network: PairNetwork, sizes: list[tuple[int, int]], symmetric: bool) -> list[NetworkPair]:
    frames = [network.encode(network.prepare(photograph(*size, n))) for n, size in enumerate(sizes)]
    return [network.pair(a, b, symmetric) for a, b in pairwise(frames)]


@pytest.mark.parametrize("symmetric", [False, True])
def test_recorded_is_the_same_network(recordings: list[OnHost], symmetric: bool) -> None:
    """Landscape, portrait with the same number of tokens, and both in one pair; earlier answers stay what they were."""
    sizes = [(96, 64), (96, 64), (64, 96), (96, 64), (96, 64)]
    plain, recorded = (
        pairs_of(PairNetwork(random_mast3r(Mast3rConfig.tiny()), execution=how, long_side_px=96), sizes, symmetric)
        for how in ("eager", "graph")
    )
    for a, b in zip(plain, recorded, strict=True):
        for name in ("points", "confidence", "descriptors", "descriptor_confidence"):
            for view in ("first", "second"):
                torch.testing.assert_close(getattr(getattr(b, view), name), getattr(getattr(a, view), name))
        assert (a.reverse is None) == (b.reverse is None)
        if a.reverse and b.reverse:
            torch.testing.assert_close(b.reverse.second.points, a.reverse.second.points)
    # the encoder for two shapes, the decoders for three pairs of grids
    assert len(recordings) == 5 and sum(r.played for r in recordings) == 5 + (6 if symmetric else 4)


def test_recorded_matching_is_the_same(recordings: list[OnHost]) -> None:
    first, second = decoded(look(0.0), look(0.4), 0.05)
    px = np.stack(np.meshgrid(np.arange(2, 190, 7), np.arange(2, 140, 7)), -1).reshape(-1, 2).astype(float)
    search, options = RecordedMatching(Recorder(torch.device("cpu"))), MatchOptions()
    for chosen in (px, px[:301], px[5:402]):
        for there, here in zip(
            search(first, second, chosen, None, options),
            match_pixels(first, second, chosen, None, options),
            strict=True,
        ):
            np.testing.assert_array_equal(there, here)
    assert len(recordings) == 2  # 540 pixels; 301 and 397 are one shape
    back = search(first, second, px, None, MatchOptions(reciprocal_px=1.0))
    assert len(recordings) == 3 and back[1].sum() < search(first, second, px, None, options)[1].sum()


def test_dinov2_is_recorded_too(recordings: list[OnHost], tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers", reason="DINOv2 needs pip install 'mastd3r-slam[networks]'")
    sizes = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "image_size": 98, "patch_size": 14}
    transformers.Dinov2Model(transformers.Dinov2Config(**sizes)).save_pretrained(tmp_path)
    plain, played = (Dinov2Features(tmp_path, recorded=how) for how in (False, True))
    for n in range(3):
        image = photograph(96, 64, n)
        np.testing.assert_array_equal(played.one(image).features, plain.one(image).features)
    assert [r.played for r in recordings] == [3]


def test_recordings_are_not_made_without_end(recordings: list[OnHost]) -> None:
    twice = Recorder(torch.device("cpu")).recorded(lambda t: 2 * t)
    for n in range(1, MOST_SHAPES + 4):
        assert twice(torch.full((n,), 3.0)).tolist() == [6.0] * n
    assert len(recordings) == MOST_SHAPES
