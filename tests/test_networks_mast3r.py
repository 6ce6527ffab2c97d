"""MASt3R in our own PyTorch: names and sizes, the reference's stored outputs, and a plain twin of every part."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mastd3r.errors import ConfigError
from mastd3r.networks.dpt import Fusion, HeadOutput, points_from_raw
from mastd3r.networks.layers import CrossAttention, SelfAttention
from mastd3r.networks.mast3r import (
    Encoded,
    Mast3r,
    Mast3rConfig,
    in_both_orders,
    random_mast3r,
    seeded_weights,
    stacked,
)
from mastd3r.networks.pair import NetworkPair, PairNetwork
from mastd3r.networks.rope import rope_table, rotate

OUTPUTS = ("points", "confidence", "descriptors", "descriptor_confidence")
STORED = Path(__file__).parent / "data" / "mast3r_small.npz"  # written by benchmarks/compare_reference.py --store
STORED_SIZES = {"landscape": ((64, 48), (64, 48)), "odd": ((80, 48), (80, 48)), "mixed": ((48, 80), (64, 48))}


@pytest.fixture(autouse=True, scope="module")
def _no_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


@pytest.fixture(scope="module")
def tiny() -> Mast3r:
    return random_mast3r(Mast3rConfig.tiny(), seed=3)


def noise_image(width: int, height: int, seed: int) -> Tensor:
    """The image that the stored outputs were made from."""
    rng = np.random.RandomState(seed)
    coarse = np.kron(rng.uniform(-0.7, 0.7, (3, height // 16, width // 16)), np.ones((1, 16, 16)))
    return torch.from_numpy((coarse + rng.uniform(-0.3, 0.3, (3, height, width))).astype(np.float32)[None])


def photograph(width: int, height: int, seed: int = 0) -> np.ndarray:
    return np.random.RandomState(seed).randint(0, 256, (height, width, 3)).astype(np.uint8)


def relative_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    if ours.ndim > 1:
        return float((np.linalg.norm(ours - theirs, axis=-1) / np.linalg.norm(theirs, axis=-1)).max())
    return float((np.abs(ours - theirs) / np.abs(theirs)).max())


def same(one: HeadOutput, two: HeadOutput, atol: float = 2e-5) -> None:
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(one, name), getattr(two, name), rtol=1e-4, atol=atol)


# --- names and sizes -------------------------------------------------------------------------------------------------


def _linear(name: str, dim_out: int, dim_in: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield f"{name}.weight", (dim_out, dim_in)
    yield f"{name}.bias", (dim_out,)


def _conv(name: str, c_out: int, c_in: int, k: int, bias: int | None = None) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield f"{name}.weight", (c_out, c_in, k, k)
    yield f"{name}.bias", (c_out if bias is None else bias,)


def _norm(name: str, dim: int) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield f"{name}.weight", (dim,)
    yield f"{name}.bias", (dim,)


def _released_head(head: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    dims = (96, 192, 384, 768)
    for i, dim in enumerate(dims):
        for name in (f"layer{i + 1}_rn", f"layer_rn.{i}"):
            yield f"{head}.dpt.scratch.{name}.weight", (256, dim, 3, 3)
        fusion = f"{head}.dpt.scratch.refinenet{i + 1}"
        yield from _conv(f"{fusion}.out_conv", 256, 256, 1)
        for unit in ("resConfUnit1.conv1", "resConfUnit1.conv2", "resConfUnit2.conv1", "resConfUnit2.conv2"):
            yield from _conv(f"{fusion}.{unit}", 256, 256, 3)
        yield from _conv(f"{head}.dpt.act_postprocess.{i}.0", dim, 768 if i else 1024, 1)
    yield from _conv(f"{head}.dpt.act_postprocess.0.1", 96, 96, 4)
    yield from _conv(f"{head}.dpt.act_postprocess.1.1", 192, 192, 2)
    yield from _conv(f"{head}.dpt.act_postprocess.3.1", 768, 768, 3)
    yield from _conv(f"{head}.dpt.head.0", 128, 256, 3)
    yield from _conv(f"{head}.dpt.head.2", 128, 128, 3)
    yield from _conv(f"{head}.dpt.head.4", 4, 128, 1)
    yield from _linear(f"{head}.head_local_features.fc1", 7168, 1792)
    yield from _linear(f"{head}.head_local_features.fc2", 6400, 7168)


def released_names() -> Iterator[tuple[str, tuple[int, ...]]]:
    """Every name and shape of the released checkpoint, written out from its description."""
    yield "mask_token", (1, 1, 768)
    yield from _conv("patch_embed.proj", 1024, 3, 16)
    for stack, depth, dim in (("enc_blocks", 24, 1024), ("dec_blocks", 12, 768), ("dec_blocks2", 12, 768)):
        for i in range(depth):
            block = f"{stack}.{i}"
            norms = ("norm1", "norm2") if dim == 1024 else ("norm1", "norm2", "norm3", "norm_y")
            for norm in norms:
                yield from _norm(f"{block}.{norm}", dim)
            yield from _linear(f"{block}.attn.qkv", 3 * dim, dim)
            yield from _linear(f"{block}.attn.proj", dim, dim)
            yield from _linear(f"{block}.mlp.fc1", 4 * dim, dim)
            yield from _linear(f"{block}.mlp.fc2", dim, 4 * dim)
            if dim == 768:
                for name in ("projq", "projk", "projv", "proj"):
                    yield from _linear(f"{block}.cross_attn.{name}", dim, dim)
    yield from _norm("enc_norm", 1024)
    yield from _norm("dec_norm", 768)
    yield from _linear("decoder_embed", 768, 1024)
    for head in ("downstream_head1", "downstream_head2"):
        yield from _released_head(head)


def test_names_shapes_and_count_are_those_of_the_released_checkpoint() -> None:
    with torch.device("meta"):
        model = Mast3r(Mast3rConfig.released())
    ours = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    assert len(ours) == 1017
    assert ours == dict(released_names())
    assert sum(p.numel() for p in model.parameters()) == 688_638_856
    assert model.config.hooks == (0, 6, 9, 12)
    assert {m.eps for m in model.modules() if isinstance(m, torch.nn.LayerNorm)} == {1e-6}


# --- against the reference -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", sorted(STORED_SIZES))
def test_outputs_are_those_of_the_reference(case: str) -> None:
    """Same random weights, fp32: landscape, a grid of odd rows, and a portrait beside a landscape."""
    model = random_mast3r(replace(Mast3rConfig.tiny(), dec_depth=12))
    one, two = (noise_image(*size, seed) for seed, size in enumerate(STORED_SIZES[case], 1))
    with np.load(STORED) as stored:
        for view, out in enumerate(model.decode(model.encode(one), model.encode(two)), 1):
            y, x = stored[f"{case}.{view}.pixels_yx"].T
            for name in OUTPUTS:
                theirs = stored[f"{case}.{view}.{name}"]
                assert theirs.std() > 0.01  # no agreement of zeros
                assert relative_error(getattr(out, name)[0].numpy()[y, x], theirs) < 1e-4, (view, name)


# --- parts against plain twins ---------------------------------------------------------------------------------------


def test_rotary_positions_are_rotations_of_pairs() -> None:
    """Twin: pairs (i, i + d/4) of each half as complex numbers, turned by position * 100^(-2i/(d/2))."""
    rows, cols, heads, d = 3, 5, 2, 16
    x = torch.randn(2, rows * cols, heads, d, dtype=torch.float32, generator=torch.Generator().manual_seed(0))
    turned = rotate(x, rope_table(rows, cols, d, torch.device("cpu")))
    for token in range(rows * cols):
        for half, position in enumerate(divmod(token, cols)):
            part = x[:, token, :, half * d // 2 : (half + 1) * d // 2].double().numpy()
            angle = position * 100.0 ** (-np.arange(d // 4) / (d // 4))
            plain = (part[..., : d // 4] + 1j * part[..., d // 4 :]) * np.exp(1j * angle)
            ours = turned[:, token, :, half * d // 2 : (half + 1) * d // 2].numpy()
            np.testing.assert_allclose(ours, np.concatenate([plain.real, plain.imag], -1), atol=1e-5)


def test_scores_depend_on_the_offset_only() -> None:
    rows, cols, d = 4, 6, 8
    table = rope_table(rows, cols, d, torch.device("cpu"))
    q, k = (torch.randn(d).expand(1, rows * cols, d).contiguous() for _ in range(2))
    scores = (rotate(q, table)[0] @ rotate(k, table)[0].T).view(rows, cols, rows, cols)
    torch.testing.assert_close(scores[0, 1, 2, 4], scores[1, 2, 3, 5])
    assert abs(float(scores[0, 1, 2, 4] - scores[1, 0, 2, 4])) > 1e-4
    with pytest.raises(ValueError, match="multiple of 4, got 6"):
        rope_table(2, 2, 6, torch.device("cpu"))


def plain_attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """softmax(q kᵀ / √d) v, head by head in float64: (b, n, heads, d)."""
    q, k, v = (t.double().movedim(2, 1) for t in (q, k, v))
    return ((q @ k.mT / q.shape[-1] ** 0.5).softmax(-1) @ v).movedim(1, 2).flatten(2)


def test_attention_equals_the_plain_formula() -> None:
    torch.manual_seed(1)
    dim, heads = 24, 3
    mine, other = rope_table(2, 3, 8, torch.device("cpu")), rope_table(4, 2, 8, torch.device("cpu"))
    x, memory = torch.randn(2, 6, dim), torch.randn(2, 8, dim)
    layer = SelfAttention(dim, heads)
    q, k, v = layer.qkv(x).view(2, 6, 3, heads, 8).unbind(2)
    plain = F.linear(plain_attention(rotate(q, mine), rotate(k, mine), v), layer.proj.weight.double())
    torch.testing.assert_close(layer(x, mine).double(), plain + layer.proj.bias, atol=1e-5, rtol=1e-5)
    cross = CrossAttention(dim, heads)
    q, k, v = (
        p(t).unflatten(-1, (heads, 8)) for p, t in ((cross.projq, x), (cross.projk, memory), (cross.projv, memory))
    )
    plain = F.linear(plain_attention(rotate(q, mine), rotate(k, other), v), cross.proj.weight.double())
    torch.testing.assert_close(cross(x, memory, mine, other).double(), plain + cross.proj.bias, atol=1e-5, rtol=1e-5)


def test_fusion_may_convolve_before_it_enlarges() -> None:
    torch.manual_seed(2)
    block, coarse, fine = Fusion(8), torch.randn(1, 8, 5, 7), torch.randn(1, 8, 5, 7)

    def unit(module: torch.nn.Module, x: Tensor) -> Tensor:
        return x + module.conv2(F.relu(module.conv1(F.relu(x))))

    summed = unit(block.resConfUnit2, coarse + unit(block.resConfUnit1, fine))
    plain = block.out_conv(F.interpolate(summed, (10, 14), mode="bilinear", align_corners=True))
    torch.testing.assert_close(block(coarse, fine), plain, atol=1e-5, rtol=1e-5)


def test_points_keep_their_direction_and_grow_exponentially() -> None:
    raw = torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]])
    points = points_from_raw(raw)
    torch.testing.assert_close(points[0], torch.tensor([0.6, 0.0, 0.8]) * np.expm1(5.0).astype(np.float32))
    assert not points[1].any() and float(points[2, 0]) == pytest.approx(np.expm1(1e-4), rel=1e-4)


# --- the whole network -----------------------------------------------------------------------------------------------


def test_outputs_have_their_shapes_and_ranges(tiny: Mast3r) -> None:
    encoded = tiny.encode(noise_image(64, 48, 1))
    assert encoded.grid == (3, 4) and encoded.tokens.shape == (1, 12, tiny.config.enc_dim)
    for out in tiny.decode(encoded, tiny.encode(noise_image(32, 80, 2))):
        h, w = out.confidence.shape[1:]
        assert out.points.shape == (1, h, w, 3) and out.descriptors.shape == (1, h, w, 24)
        assert out.descriptor_confidence.shape == (1, h, w)
        assert (out.confidence > 1).all() and (out.descriptor_confidence > 0).all()
        torch.testing.assert_close(out.descriptors.norm(dim=-1), torch.ones(1, h, w))
        assert {getattr(out, name).dtype for name in OUTPUTS} == {torch.float32}
        assert all(getattr(out, name).isfinite().all() for name in OUTPUTS)
    assert (h, w) == (80, 32)


def test_a_batch_is_its_rows(tiny: Mast3r) -> None:
    images = torch.cat([noise_image(48, 64, n) for n in range(4)])
    encoded = tiny.encode(images)
    rows = [tiny.encode(images[n : n + 1]) for n in range(4)]
    torch.testing.assert_close(encoded.tokens, stacked(rows).tokens, atol=1e-5, rtol=1e-4)
    outs = tiny.decode(stacked([rows[0], rows[1]]), stacked([rows[2], rows[3]]))
    for n in (0, 1):
        for out, alone in zip(outs, tiny.decode(rows[n], rows[n + 2]), strict=True):
            same(HeadOutput(*(getattr(out, name)[n : n + 1] for name in OUTPUTS)), alone)


@pytest.mark.parametrize("size", [(64, 48), (48, 64)])
def test_both_orders_at_once_are_each_order_alone(tiny: Mast3r, size: tuple[int, int]) -> None:
    a, b = tiny.encode(noise_image(64, 48, 1)), tiny.encode(noise_image(*size, 2))
    both = in_both_orders(tiny.decode, a, b)
    for pair, (first, second) in zip(both, ((a, b), (b, a)), strict=True):
        for out, alone in zip(pair, tiny.decode(first, second), strict=True):
            same(out, alone)
    assert (both[0][0].points - both[1][1].points).abs().max() > 0.01  # a as first is not a as second


def test_wrong_inputs_are_refused(tiny: Mast3r) -> None:
    with pytest.raises(ValueError, match=r"multiples of 16, got \(1, 3, 40, 64\)"):
        tiny.encode(torch.zeros(1, 3, 40, 64))
    one = tiny.encode(noise_image(32, 32, 1))
    with pytest.raises(ValueError, match="one size, got 1 and 2"):
        tiny.decode(one, Encoded(one.tokens.repeat(2, 1, 1), one.grid))
    with pytest.raises(ValueError, match="of one grid"):
        stacked([one, tiny.encode(noise_image(32, 48, 1))])


def test_random_weights_depend_on_name_and_seed_only() -> None:
    shapes = {"a.weight": (4, 6), "b.norm1.weight": (5,), "x.scratch.layer_rn.1.weight": (2, 2, 3, 3)}
    one = seeded_weights(shapes, 1)
    two = seeded_weights({**shapes, "0.bias": (3,), "x.scratch.layer2_rn.weight": (2, 2, 3, 3)}, 1)
    assert all(np.array_equal(one[n], two[n]) for n in shapes)
    assert np.array_equal(two["x.scratch.layer_rn.1.weight"], two["x.scratch.layer2_rn.weight"])
    assert not np.array_equal(one["a.weight"], seeded_weights(shapes, 2)["a.weight"])


# --- for callers without torch ---------------------------------------------------------------------------------------


def pair_of(network: PairNetwork, symmetric: bool = False) -> NetworkPair:
    a, b = (network.encode(network.prepare(photograph(96, 72, seed))) for seed in (1, 2))
    return network.pair(a, b, symmetric).numpy()


def test_pair_network_gives_arrays_and_both_orders() -> None:
    network = PairNetwork(random_mast3r(Mast3rConfig.tiny()), long_side_px=96)
    pair = pair_of(network, symmetric=True)
    assert isinstance(pair.first.points, np.ndarray) and pair.first.points.shape == (64, 96, 3)
    assert pair.reverse is not None and pair.reverse.second.descriptors.shape == (64, 96, 24)
    assert pair_of(network).reverse is None
    np.testing.assert_allclose(pair.second.points, pair_of(network).second.points, rtol=1e-4, atol=1e-5)
    frame = network.encode(network.prepare(photograph(96, 72)))
    assert frame.pooled.shape == (48,) and np.linalg.norm(frame.pooled) == pytest.approx(1, abs=1e-5)
    assert (frame.height, frame.width) == (64, 96) and network.pairs([]) == []
    many = network.pairs([(frame, frame)] * 3, symmetric=True)
    np.testing.assert_array_equal(many[2].first.points, many[0].first.points)


@pytest.mark.parametrize(("dtype", "angle_rad"), [("bfloat16", 0.1), ("float16", 0.015)])
def test_half_precision_is_near_and_heads_stay_whole(dtype: str, angle_rad: float) -> None:
    exact = pair_of(PairNetwork(random_mast3r(Mast3rConfig.tiny()), long_side_px=96))
    network = PairNetwork(random_mast3r(Mast3rConfig.tiny()), dtype=dtype, long_side_px=96)
    kinds = {n: p.dtype for n, p in network.model.named_parameters()}
    assert str(kinds["enc_blocks.0.mlp.fc1.weight"]) == str(kinds["patch_embed.proj.weight"]) == f"torch.{dtype}"
    assert {kinds["downstream_head2.dpt.head.4.weight"], kinds["enc_norm.weight"]} == {torch.float32}
    half = pair_of(network)
    for view in ("first", "second"):
        cosine = (getattr(exact, view).descriptors * getattr(half, view).descriptors).sum(-1)
        assert 0 < np.arccos(np.clip(cosine, -1, 1)).max() < angle_rad
        assert half.first.points.dtype == np.float32


def test_compiled_is_the_same_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Traced whole, without breaks; the code generator itself is torch's matter."""
    compiled: list[object] = []
    compiler = torch.compile

    def tracing(function: object, **options: object) -> object:
        compiled.append(function)
        return compiler(function, backend="eager", fullgraph=True, **options)

    monkeypatch.setattr(torch, "compile", tracing)
    model = random_mast3r(Mast3rConfig.tiny())
    plain = pair_of(PairNetwork(model, long_side_px=96), symmetric=True)
    traced = pair_of(PairNetwork(model, long_side_px=96, execution="compile"), symmetric=True)
    assert len(compiled) == 4
    np.testing.assert_allclose(traced.second.points, plain.second.points, rtol=1e-4, atol=1e-5)
    assert traced.reverse is not None and plain.reverse is not None
    np.testing.assert_allclose(traced.reverse.first.descriptors, plain.reverse.first.descriptors, atol=1e-5)


def test_unknown_precision_and_device_are_refused(tiny: Mast3r) -> None:
    with pytest.raises(ConfigError, match="one of float32, bfloat16, float16, got 'int8'"):
        PairNetwork(tiny, dtype="int8")
    with pytest.raises(ConfigError, match="network device: expected one that torch has, got 'toaster'"):
        PairNetwork(tiny, device="toaster")
    with pytest.raises(ConfigError, match="one of eager, graph, compile, got 'magic'"):
        PairNetwork(tiny, execution="magic")
    with pytest.raises(ConfigError, match="'graph': expected a CUDA device, got 'cpu'"):
        PairNetwork(tiny, execution="graph")


@pytest.mark.parametrize(("dtype", "inside"), [("float32", ("highest", False)), ("bfloat16", ("high", True))])
def test_products_round_only_in_half_precision_and_only_inside(dtype: str, inside: tuple[str, bool]) -> None:
    """The heads of a network in half precision may take TF32; what else the process computes keeps its setting."""

    def setting() -> tuple[str, bool]:
        return torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32

    network = PairNetwork(random_mast3r(Mast3rConfig.tiny()), dtype=dtype, long_side_px=96)
    seen: list[tuple[str, bool]] = []
    network.model.downstream_head1.register_forward_hook(lambda *_: seen.append(setting()))
    network.model.enc_norm.register_forward_hook(lambda *_: seen.append(setting()))
    before = setting()
    pair_of(network, symmetric=True)
    assert seen == [inside] * 3 and setting() == before
