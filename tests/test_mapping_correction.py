"""A graph correction that bends the world, on random Gaussians: who follows whom."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mastd3r.geometry.se3 import se3_exp
from mastd3r.geometry.sim3 import Sim3
from mastd3r.mapping.correction import Visibility, changes_of, deformation, fitted_pose, followed, visibility
from mastd3r.mapping.gaussians import quaternion_product
from test_mapping_gaussians import random_map

K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], dtype=torch.float64)
CENTRES = {0: (-0.5, 0.0, 0.0), 1: (0.0, 0.1, 0.0), 2: (0.5, 0.0, 0.1)}


def motion(turn: tuple[float, float, float], shift: tuple[float, float, float], scale: float = 1.0) -> Sim3:
    return Sim3(Rotation.from_rotvec(turn).as_matrix(), np.array(shift, float), scale)


def camera(kf: int) -> torch.Tensor:
    return torch.from_numpy(motion((0, 0.1 * (1 - kf), 0), CENTRES[kf]).inverse().rigid)


def seen_from(change: Sim3, centre: tuple[float, float, float], weight_px: torch.Tensor) -> Visibility:
    return Visibility(change, motion((0, 0, 0), centre).inverse().rigid, weight_px)


def test_weights_of_a_sight_are_shares_of_the_picture() -> None:
    """Weighted colours sum to the sum of the picture; pixels that do not count add nothing."""
    gaussians = random_map()
    color, _, alpha = gaussians.draw(camera(0), K, 64, 48, 0.1)
    change = motion((0, 0, 0.1), (1, 0, 0))
    seen = visibility(gaussians, change, camera(0), K, torch.ones(48, 64), 0.1)
    assert torch.allclose(seen.weight_px @ gaussians.colors, color.sum((0, 1)), rtol=1e-4)
    assert float(seen.weight_px.sum()) == pytest.approx(float(alpha.detach().sum()), rel=1e-4)
    assert seen.change is change and np.array_equal(seen.cam_from_world, camera(0).numpy())
    assert torch.all(visibility(gaussians, change, camera(0), K, torch.zeros(48, 64), 0.1).weight_px == 0)


@pytest.mark.parametrize("scale", [1.0, 1.3])
def test_a_rigid_correction_is_followed_exactly(scale: float) -> None:
    """All keyframes move alike: whatever the sights say, the map moves as by its anchors."""
    gaussians, change = random_map(), motion((0.2, -0.7, 2.4), (0.3, -2, 1), scale)
    changes = dict.fromkeys(CENTRES, change)
    by_anchor = gaussians.moved(changes)
    seen = [visibility(gaussians, change, camera(kf), K, torch.ones(48, 64), 0.1) for kf in CENTRES]
    by_sight = followed(gaussians, changes, seen)
    assert torch.allclose(by_sight.means, by_anchor.means, atol=1e-5)
    assert torch.allclose(by_sight.log_scales, by_anchor.log_scales, atol=1e-5)
    unit = [torch.nn.functional.normalize(m.quats, dim=1) for m in (by_sight, by_anchor)]
    assert torch.all((unit[0] * unit[1]).sum(1).abs() > 1 - 1e-6)


def test_what_one_keyframe_sees_follows_it_and_what_none_sees_its_anchor() -> None:
    gaussians = random_map()
    changes = {0: motion((0, 0, 0), (0.05, 0, 0)), 1: motion((0, 0, 0), (0, 0.05, 0))}  # 2 stands still
    weight_px = torch.where(torch.arange(200) % 2 == 0, 1e6, 0.0)
    after = followed(gaussians, changes, [seen_from(changes[1], (0, 0, 0), weight_px)])
    shift = (after.means - gaussians.means).detach()
    assert torch.allclose(shift[::2], torch.tensor([0, 0.05, 0]), atol=1e-5)
    unseen = torch.tensor([[0.05, 0, 0], [0, 0.05, 0], [0, 0, 0]])[gaussians.kf_id.long()]
    assert torch.allclose(shift[1::2], unseen[1::2], atol=1e-6)


def test_a_gaussian_stays_between_the_keyframes_that_see_it() -> None:
    """Two views from one place, one moves aside and the other does not: half way, in any direction but turned too."""
    gaussians = random_map()
    changes, seen = {0: motion((0, 0, 0.2), (0, 0, 0))}, torch.full((200,), 1e6)
    after = followed(gaussians, changes, [seen_from(c, (0, 0, 0), seen) for c in (changes[0], Sim3.identity())])
    turned = motion((0, 0, 0.2), (0, 0, 0)).rotation
    before = gaussians.means.detach().double().numpy()
    assert np.allclose(after.means.detach().numpy(), (before + before @ turned.T) / 2, atol=1e-5)
    half = torch.from_numpy(Rotation.from_rotvec([0, 0, 0.1]).as_quat()[[3, 0, 1, 2]])
    one = [seen_from(c, (0, 0, 0), seen[:1]) for c in (changes[0], Sim3.identity())]
    turns = followed(gaussians.picked(torch.arange(1)), changes, one)
    expected = quaternion_product(half, gaussians.quats[:1].detach().double())
    cosine = torch.nn.functional.cosine_similarity(turns.quats.detach().double(), expected)
    assert float(cosine[0].abs()) == pytest.approx(1, abs=1e-6)


def test_a_view_along_the_motion_says_little_of_it() -> None:
    """One keyframe moves along its ray, the other, which looks from the side, stands still: so does the Gaussian."""
    gaussians = random_map(3)
    with torch.no_grad():
        gaussians.means[:] = torch.tensor([0.0, 0, 3])
    changes, seen = {0: motion((0, 0, 0), (0, 0, 0.1))}, torch.full((3,), 1e6)
    along, side = seen_from(changes[0], (0, 0, 0), seen), seen_from(Sim3.identity(), (3, 0, 3), seen)
    after = followed(gaussians, changes, [along, side])
    assert torch.all((after.means - gaussians.means)[:, 2] < 0.02)


def test_bend_is_nothing_for_a_rigid_correction_and_the_distance_otherwise() -> None:
    turned = motion((0.2, 0, 1), (1, 2, 3))
    assert deformation([turned] * 4, np.array([1.0, 2, 3])) < 1e-12
    assert deformation([Sim3.identity(), motion((0, 0, 0), (0.1, 0, 0))], np.ones(3)) == pytest.approx(0.05)
    old, new = {0: motion((0, 0, 1), (1, 0, 0)).rigid, 5: np.eye(4)}, {0: turned.rigid, 6: np.eye(4)}
    (found,) = changes_of(old, new).items()
    assert found[0] == 0 and np.allclose(found[1].matrix @ old[0], turned.matrix)


def test_a_fitted_pose_shows_the_moved_points_where_they_were() -> None:
    """Points go aside by 2 cm and the camera is turned: in the image nearly nothing is left of either."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 1.5], [1, 1, 4], (500, 3))
    moved, weight = motion((0, 0.01, -0.005), (0.02, 0, 0)).apply(points), rng.uniform(0, 9, 500)
    shift, turn = fitted_pose(points, moved, weight, depth=2.5)
    back = se3_exp(np.concatenate([shift * 2.5, turn]))
    again = moved @ back[:3, :3].T + back[:3, 3]
    error = [np.linalg.norm(p[:, :2] / p[:, 2:] - points[:, :2] / points[:, 2:], axis=1).mean() for p in (moved, again)]
    assert error[0] > 0.01 and error[1] < 0.25 * error[0]


def test_a_fitted_pose_is_none_where_nothing_moved_or_nothing_is_seen() -> None:
    points, seen = np.random.default_rng(0).uniform([-1, -1, 1.5], [1, 1, 4], (50, 3)), np.ones(50)
    behind = points * [1, 1, -1]
    for before, after, weight in ((points, points, seen), (behind, points, seen), (points, points + 0.1, 0 * seen)):
        assert np.abs(fitted_pose(before, after, weight, 2.5)).max() < 1e-12
