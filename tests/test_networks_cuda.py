"""What only a CUDA device can show: recorded layers and matching are those launched one by one, in two threads too."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from known_pair import decoded, look
from mastd3r.networks.mast3r import Mast3rConfig, random_mast3r
from mastd3r.networks.matching import RecordedMatching, match_pixels
from mastd3r.networks.pair import NetworkPair, PairNetwork
from mastd3r.networks.record import Recorder
from mastd3r.pointmap.matching import MatchOptions
from mastd3r.pointmap.matching import match_pixels as match_on_host

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
SIZES = [(96, 64), (96, 64), (64, 96), (96, 64)]


def photograph(width: int, height: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)


def pairs_of(network: PairNetwork, symmetric: bool) -> list[NetworkPair]:
    frames = [network.encode(network.prepare(photograph(*size, n))) for n, size in enumerate(SIZES)]
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda n: network.pair(frames[n], frames[n + 1], symmetric).numpy(), range(3)))


@pytest.mark.parametrize("dtype", ["float32", "bfloat16", "float16"])
@pytest.mark.parametrize("symmetric", [False, True])
def test_recorded_is_the_same_network(dtype: str, symmetric: bool) -> None:
    plain, recorded = (
        pairs_of(PairNetwork(random_mast3r(Mast3rConfig.tiny()), "cuda", dtype, how, 96), symmetric)
        for how in ("eager", "graph")
    )
    for a, b in zip(plain, recorded, strict=True):
        np.testing.assert_allclose(b.first.points, a.first.points, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(b.second.descriptors, a.second.descriptors, rtol=1e-4, atol=1e-5)
        if a.reverse and b.reverse:
            np.testing.assert_allclose(b.reverse.second.points, a.reverse.second.points, rtol=1e-4, atol=1e-5)


def test_float32_is_that_of_the_host() -> None:
    for a, b in zip(
        pairs_of(PairNetwork(random_mast3r(Mast3rConfig.tiny()), long_side_px=96), False),
        pairs_of(PairNetwork(random_mast3r(Mast3rConfig.tiny()), "cuda", execution="graph", long_side_px=96), False),
        strict=True,
    ):
        np.testing.assert_allclose(b.second.points, a.second.points, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(b.second.confidence, a.second.confidence, rtol=1e-3)


def test_matching_there_is_matching_here() -> None:
    first, second = decoded(look(0.0), look(0.4), 0.05)
    px = np.stack(np.meshgrid(np.arange(2, 190, 7), np.arange(2, 140, 7)), -1).reshape(-1, 2).astype(float)
    options = MatchOptions()
    host = match_on_host(first, second, px, None, options)
    for found in (
        match_pixels(first, second, px, None, options, "cuda"),
        RecordedMatching(Recorder(torch.device("cuda")))(first, second, px, None, options),
    ):
        both = found[1] & host.valid
        assert both.sum() > 0.95 * host.valid.sum()
        assert np.quantile(np.linalg.norm(found[0] - host.px, axis=1)[both], 0.98) < 0.05
