"""The CPU rasteriser against the dense float64 reference: values, every gradient, conventions."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from gaussian_scenes import HEIGHT, KINDS, NAMES, WIDTH, random_scene, weighted_loss, with_grads
from mastd3r.concurrency import one_torch_thread
from mastd3r.errors import InputError, MissingPackage
from mastd3r.mapping import rasterise
from mastd3r.mapping.rasterise import map_device, rasterization
from mastd3r.mapping.rasterise_gsplat import rasterise_gsplat
from mastd3r.mapping.rasterise_reference import rasterise_reference
from mastd3r.mapping.screen import ScreenStats


@pytest.fixture(autouse=True)
def _one_torch_thread() -> Iterator[None]:
    with one_torch_thread():
        yield


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, 1])
def test_values_and_gradients_match_the_reference(kind: str, seed: int) -> None:
    scene, K = random_scene(kind, seed)
    ours, our_grads = with_grads(rasterization, scene, K)
    reference, reference_grads = with_grads(rasterise_reference, scene, K)
    for name, a, b in zip(("color", "depth", "alpha"), ours, reference, strict=True):
        assert (a - b).abs().max() <= 2e-5 * max(1.0, float(b.detach().abs().max())), name
    for name, a, b in zip(NAMES, our_grads, reference_grads, strict=True):
        assert b.abs().max() > 0, name
        assert (a - b).norm() <= 1e-4 * b.norm(), name
        assert (a - b).abs().max() <= 1e-4 * b.abs().max(), name


def test_gradients_match_where_opaque_pixels_end_the_lists() -> None:
    """Many Gaussians a tile: several looks at what is opaque, and pairs that only one of the passes counts."""
    scene, K = random_scene("plain", 7, count=1500)
    for ours, reference in zip(
        with_grads(rasterization, scene, K)[1], with_grads(rasterise_reference, scene, K)[1], strict=True
    ):
        assert (ours - reference).norm() <= 1e-4 * reference.norm()


def test_reference_gradients_match_finite_differences() -> None:
    scene, K = random_scene("plain", 3, count=30)
    _, grads = with_grads(rasterise_reference, scene, K)
    rng = np.random.default_rng(0)
    for name, grad in zip(NAMES, grads, strict=True):
        # a step over a 1/255 cut is a jump, not a slope: few of many are allowed to be off
        errors = []
        for at in rng.permutation(grad.numel() if name != "viewmats" else 12)[:20]:
            values = []
            for step in (1e-6, -1e-6):
                moved = {k: v.clone() for k, v in scene.items()}
                moved[name].view(-1)[int(at)] += step
                values.append(weighted_loss(rasterise_reference(*(moved[n] for n in NAMES), K, WIDTH, HEIGHT)))
            difference = float(values[0] - values[1]) / 2e-6
            errors.append(abs(difference - float(grad.reshape(-1)[int(at)])) / float(grad.abs().max()))
        assert np.quantile(errors, 0.7) < 1e-6, name


def test_an_integer_pixel_is_the_pixel_centre() -> None:
    """A Gaussian on the optical axis, principal point on pixel (20, 11), peaks there, symmetrically."""
    K = torch.tensor([[40.0, 0, 20], [0, 40, 11], [0, 0, 1]])
    one = torch.ones(1)
    args = (torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1), 0.8 * one)
    for function in (rasterization, rasterise_reference):
        _color, depth, alpha = function(*args, torch.ones(1, 3), torch.eye(4), K, 41, 23)
        assert divmod(int(alpha.argmax()), 41) == (11, 20)
        assert torch.allclose(alpha[11, 19], alpha[11, 21]) and torch.allclose(alpha[10, 20], alpha[12, 20])
        assert float(alpha[11, 20]) == pytest.approx(0.8, abs=1e-5)
        assert float(depth[11, 20]) == pytest.approx(1.6, abs=1e-5)  # weight times z, not divided by alpha


def test_background_shows_where_nothing_is() -> None:
    scene, K = random_scene("plain", 0)
    args = [scene[n] for n in NAMES]
    background = torch.tensor([0.2, 0.5, 0.7])
    bare, _, alpha = rasterization(*args, K, WIDTH, HEIGHT)
    filled, _, _ = rasterization(*args, K, WIDTH, HEIGHT, background=background)
    assert torch.allclose(filled, bare + (1 - alpha)[..., None] * background)
    reference, _, _ = rasterise_reference(*args, K, WIDTH, HEIGHT, background=background.double())
    assert (filled - reference).abs().max() < 2e-5


def test_no_gaussian_gives_the_background() -> None:
    empty = [torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3)]
    color, depth, alpha = rasterization(*empty, torch.eye(4), torch.eye(3), 20, 9, background=torch.full((3,), 0.25))
    assert torch.all(color == 0.25) and torch.all(depth == 0) and torch.all(alpha == 0)


def test_same_bits_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, K = random_scene("plain", 4, count=400)
    results = []
    for threads in (1, 2, 3):
        monkeypatch.setattr("mastd3r.concurrency.thread_count", lambda n=threads: n)
        results.append(with_grads(rasterization, scene, K))
    for image, grads in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(image, results[0][0], strict=True))
        assert all(torch.equal(a, b) for a, b in zip(grads, results[0][1], strict=True))


def test_stats_give_radii_and_pixel_gradients() -> None:
    """d loss / d (pixel of a mean) is found again from the gradient of the principal point."""
    scene, K = random_scene("plain", 6)
    scene["means"][:, :2] *= 0.5  # none outside the image, where cx and cy also move the Jacobian's clamp
    stats = ScreenStats()
    with_grads(rasterization, scene, K, stats=stats)
    assert stats.radii_px is not None and stats.mean_grad_px is not None
    unseen = (stats.radii_px == 0).all(1)
    assert torch.all(stats.mean_grad_px[unseen] == 0)
    leaf = K.clone().requires_grad_()
    loss = weighted_loss(rasterise_reference(*(scene[n] for n in NAMES), leaf, WIDTH, HEIGHT))
    (grad,) = torch.autograd.grad(loss, leaf)
    assert torch.allclose(stats.mean_grad_px.sum(0).double(), grad[:2, 2], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("name", "shape"), [("quats", (5, 3)), ("opacities", (5, 1)), ("colors", (4, 3))])
def test_wrong_shapes_are_refused(name: str, shape: tuple[int, ...]) -> None:
    scene, K = random_scene("plain", 0, count=5)
    scene[name] = torch.zeros(shape)
    with pytest.raises(InputError, match=name):
        rasterization(*(scene[n] for n in NAMES), K, WIDTH, HEIGHT)


def test_gsplat_missing_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, K = random_scene("plain", 0, count=5)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingPackage, match="pip install"):
        rasterise_gsplat(*(scene[n] for n in NAMES), K, WIDTH, HEIGHT, 0.01, 0.3, None)


def test_gsplat_adapter_keeps_our_pixel_convention(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in with gsplat's signature and its +0.5 sampling must give our reference's image."""

    def rasterization_at_half(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d,
        packed, render_mode,
    ):  # type: ignore[no-untyped-def]  # fmt: skip
        assert render_mode == "RGB+D" and not packed
        centred = Ks[0].clone()
        centred[:2, 2] -= 0.5  # sampling pixel i at i + 0.5 is sampling at i with the centre moved
        color, depth, alpha = rasterise_reference(
            means, quats, scales, opacities, colors, viewmats[0], centred, width, height, near_plane, eps2d
        )
        return torch.cat([color, depth[..., None]], -1)[None], alpha[None, ..., None], {}

    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization_at_half))
    scene, K = random_scene("plain", 0)
    args = [scene[n] for n in NAMES]
    ours = rasterise_gsplat(*args, K, WIDTH, HEIGHT, 0.01, 0.3, None)
    for a, b in zip(ours, rasterise_reference(*args, K, WIDTH, HEIGHT), strict=True):
        assert a.shape == b.shape and torch.allclose(a.double(), b, atol=1e-5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device with gsplat")
@pytest.mark.parametrize("kind", KINDS)
def test_gsplat_on_a_device_matches_the_reference(kind: str) -> None:
    pytest.importorskip("gsplat")

    def on_device(*arguments: Any, **options: Any) -> tuple[torch.Tensor, ...]:
        moved = [a.to("cuda") if isinstance(a, torch.Tensor) else a for a in arguments]
        return tuple(t.cpu() for t in rasterization(*moved, **options))

    scene, K = random_scene(kind, 0)
    theirs, their_grads = with_grads(on_device, scene, K)
    reference, reference_grads = with_grads(rasterise_reference, scene, K)
    for a, b in zip(theirs, reference, strict=True):
        assert (a - b).abs().max() <= 1e-4 * max(1.0, float(b.detach().abs().max()))
    for name, a, b in zip(NAMES, their_grads, reference_grads, strict=True):
        assert (a - b).norm() <= 1e-3 * b.norm(), name


def test_where_the_map_lives(monkeypatch: pytest.MonkeyPatch) -> None:
    """auto never fails and says why; a device asked for by name that cannot draw is refused in one line."""
    assert map_device("cpu") == ("cpu", "")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert map_device("auto") == ("cpu", "torch finds no accelerator")
    with pytest.raises(InputError, match=r"mapping\.device cuda: expected an accelerator"):
        map_device("cuda")


def test_an_accelerator_is_believed_when_it_has_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch says that there is one; what counts is the picture."""
    monkeypatch.setattr(rasterise, "torch_device", lambda: "cpu:0")  # a device that every machine has
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a card")
    assert map_device("auto") == ("cuda", "gsplat draws on a card")
    black = torch.zeros(4, 4, 3), torch.zeros(4, 4), torch.zeros(4, 4)
    monkeypatch.setattr(rasterise, "rasterization", lambda *_: black)
    assert map_device("auto") == ("cpu", "gsplat drew 0 where 0.5 was expected")

    def fail(*_: Any) -> None:
        raise MissingPackage("no gsplat here")

    monkeypatch.setattr(rasterise, "rasterization", fail)
    assert map_device("auto") == ("cpu", "no gsplat here")
