"""Seeding, keyframe corrections and densification rounds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mastd3r.errors import InputError
from mastd3r.geometry.sim3 import Sim3
from mastd3r.mapping.adam import RowAdam, _update_cpu, _update_torch
from mastd3r.mapping.correction import changes_of
from mastd3r.mapping.densify import DensifyPolicy, DensifySettings
from mastd3r.mapping.gaussians import GaussianMap
from mastd3r.mapping.screen import ScreenStats
from mastd3r.mapping.seed import seed_gaussians
from mastd3r.types import StaticCloud

K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])


def cloud(count: int = 300, keyframes: int = 3) -> StaticCloud:
    rng = np.random.default_rng(0)
    return StaticCloud(
        points_world=rng.uniform([-1, -1, 2], [1, 1, 4], (count, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        confidence=np.ones(count, np.float32),
        spacing=rng.uniform(0.02, 0.1, count).astype(np.float32),
        kf_id=(np.arange(count) * keyframes // count).astype(np.int32),
    )


def random_map(count: int = 200) -> GaussianMap:
    gaussians = seed_gaussians(cloud(count), count, 0)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        gaussians.quats += torch.randn(count, 4, generator=generator)
        gaussians.log_scales += 0.5 * torch.randn(count, 3, generator=generator)
        gaussians.opacity_logits += torch.randn(count, generator=generator)
    return gaussians


def draw(gaussians: GaussianMap, cam_from_world: np.ndarray) -> torch.Tensor:
    with torch.no_grad():
        return gaussians.draw(torch.from_numpy(cam_from_world), K, 64, 48, 0.05)[0]


def motion(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return pose


def test_seeds_carry_the_cloud() -> None:
    source = cloud()
    arrays = seed_gaussians(source, 1000, 0).arrays()
    assert np.array_equal(arrays.means, source.points_world)
    assert np.allclose(arrays.colors, source.colors / 255, atol=1e-6)
    assert np.allclose(arrays.scales, 0.5 * source.spacing[:, None], rtol=1e-5)
    assert np.allclose(arrays.opacities, 0.5) and np.array_equal(arrays.kf_id, source.kf_id)


def test_thinning_is_fair_to_keyframes_and_keeps_the_covered_area() -> None:
    source = cloud(3000, keyframes=6)
    arrays = seed_gaussians(source, 1000, 0).arrays()
    assert len(arrays.means) == 1000
    assert np.ptp(np.bincount(arrays.kf_id)) <= 1
    area = (np.square(arrays.scales[:, 0]).sum(), np.square(0.5 * source.spacing).sum())
    assert area[0] == pytest.approx(area[1], rel=0.1)


def test_unusable_points_are_left_out_and_none_left_is_an_error() -> None:
    source = cloud(10)
    source.points_world[3] = np.nan
    source.spacing[5] = 0
    assert len(seed_gaussians(source, 100, 0)) == 8
    source.spacing[:] = -1
    with pytest.raises(InputError, match="static points"):
        seed_gaussians(source, 100, 0)


def test_a_keyframe_correction_moves_map_and_view_together() -> None:
    """One keyframe, moved: the image from the equally moved camera stays the same."""
    gaussians = random_map()
    gaussians.kf_id[:] = 7
    old, new = motion((0.1, 0, 0.2), (0.5, 0, 0)), motion((-0.3, 0.5, 0.1), (0.1, 2, -1))
    moved = gaussians.moved(changes_of({7: old}, {7: new}))
    world_from_cam = motion((0, 0.05, 0), (0.02, 0, 0))
    before = draw(gaussians, np.linalg.inv(world_from_cam))
    after = draw(moved, np.linalg.inv(new @ np.linalg.inv(old) @ world_from_cam))
    assert float(before.std()) > 0.05
    assert (before - after).abs().max() < 1e-4


def test_only_the_corrected_keyframes_gaussians_move() -> None:
    gaussians = random_map()
    moved = gaussians.moved({1: Sim3(np.eye(3), np.array([0.05, 0, 0]))})
    change = (moved.means - gaussians.means).detach().norm(dim=1)
    assert torch.allclose(change[gaussians.kf_id == 1], torch.tensor(0.05), atol=1e-6)
    assert torch.all(change[gaussians.kf_id != 1] == 0)


def test_a_correction_with_scale_scales_the_gaussians() -> None:
    gaussians = random_map()
    gaussians.kf_id[:] = 0
    moved = gaussians.moved({0: Sim3.identity().in_lengths(1.7)})
    assert torch.allclose(moved.means, 1.7 * gaussians.means, atol=1e-5)
    assert torch.allclose(moved.log_scales.exp(), 1.7 * gaussians.log_scales.exp(), rtol=1e-4)


def observed(gaussians: GaussianMap, grad: torch.Tensor, radius: int, **settings: float) -> DensifyPolicy:
    policy = DensifyPolicy(260, 0, DensifySettings(**settings))  # type: ignore[arg-type]
    size = torch.full((len(gaussians), 2), radius, dtype=torch.int32)
    policy.observe(gaussians, ScreenStats(size, torch.stack([grad, torch.zeros_like(grad)], 1)), 64)
    return policy


def test_growth_takes_the_largest_gradients_and_respects_the_limit() -> None:
    gaussians = random_map(200)
    grad = torch.linspace(0, 1, 200)
    policy = observed(gaussians, grad, radius=3)
    after = policy.round(gaussians, RowAdam(gaussians.parameters()), 64, 0.6)
    assert len(after) == 260
    assert torch.equal(after.means[200:].detach().sort(0)[0], gaussians.means[140:].detach().sort(0)[0])
    assert torch.equal(after.kf_id[200:].sort()[0], gaussians.kf_id[140:].sort()[0])


def test_the_number_of_gaussians_grows_with_the_training() -> None:
    policy = DensifyPolicy(1000, 0, DensifySettings(start_ratio=0.1, full_ratio=0.5))
    assert [policy.allowed(200, done) for done in (0.1, 0.3, 0.5, 0.7)] == [200, 600, 1000, 1000]


def test_clones_hide_as_much_as_their_parent() -> None:
    gaussians = random_map(5)
    policy = observed(gaussians, torch.tensor([0.0, 0, 9, 0, 0]), radius=3)
    after = policy.round(gaussians, RowAdam(gaussians.parameters()), 64, 0.6)
    parent, child = after.opacity_logits[[2, 5]].detach().sigmoid()
    assert float(1 - (1 - parent) * (1 - child)) == pytest.approx(
        float(gaussians.opacity_logits[2].detach().sigmoid()), abs=1e-5
    )


def test_large_gaussians_are_split_and_shrink() -> None:
    gaussians = random_map(5)
    policy = observed(gaussians, torch.tensor([0.0, 0, 9, 0, 0]), radius=15)
    after = policy.round(gaussians, RowAdam(gaussians.parameters()), 64, 0.6)
    assert len(after) == 6
    for row in (2, 5):
        assert torch.all(after.log_scales[row] < gaussians.log_scales[2])
        assert not torch.equal(after.means[row], gaussians.means[2])
    assert not torch.equal(after.means[2], after.means[5])


def test_transparent_and_veiling_gaussians_are_pruned() -> None:
    gaussians = random_map(50)
    with torch.no_grad():
        gaussians.opacity_logits[:10] = -6
    policy = observed(gaussians, torch.zeros(50), radius=3)
    assert len(policy.round(gaussians, RowAdam(gaussians.parameters()), 64, 0.6)) == 40
    policy = observed(gaussians, torch.zeros(50), radius=200)
    assert len(policy.round(gaussians, RowAdam(gaussians.parameters()), 64, 0.6)) >= 1  # never an empty map


@pytest.mark.parametrize("count", [0, 7, 30_000])
def test_the_kernel_of_adam_does_what_its_torch_twin_does(count: int) -> None:
    """The same numbers to rounding, over steps whose gradients differ by orders of magnitude and may be zero."""
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(count, 3, generator=generator), torch.zeros(count, 3), torch.zeros(count, 3)]
    ours, theirs = [t.clone() for t in start], [t.clone() for t in start]
    for step in range(1, 6):
        grad = torch.randn(count, 3, generator=generator) * 10.0 ** (2 * step - 8)
        grad[::3] = 0
        for update, (value, first, second) in ((_update_cpu, ours), (_update_torch, theirs)):
            update(value, grad, first, second, 0.01 / (1 - 0.9**step), 1 - 0.999**step)
    for a, b in zip(ours, theirs, strict=True):
        assert torch.allclose(a, b, rtol=1e-6, atol=1e-7)
        assert torch.equal(a[::3], b[::3])


def test_adam_is_torchs_adam_and_follows_rows() -> None:
    start = torch.randn(6, 3, generator=torch.Generator().manual_seed(0))
    ours, theirs = start.clone().requires_grad_(), start.clone().requires_grad_()
    adam, reference = RowAdam({"p": ours}), torch.optim.Adam([theirs], lr=0.02, eps=1e-15)
    for _ in range(5):
        for p in (ours, theirs):
            p.grad = None
            (p.sin() * torch.arange(18).view(6, 3)).sum().backward()
        adam.step({"p": ours}, {"p": 0.02})
        reference.step()
    assert torch.allclose(ours, theirs, atol=1e-6)
    adam.pick(torch.tensor([4, 4, 0]), torch.tensor([False, True, False]))
    moments = adam._first["p"]
    assert moments.shape == (3, 3) and torch.all(moments[1] == 0) and torch.any(moments[0] != 0)
