"""A photograph finds its place in a map whose truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mastd3r.mapping.gaussians import GaussianMap
from mastd3r.mapping.placing import FARTHEST_PX, _pixel_by_pose, placed
from mastd3r.mapping.seed import seed_gaussians
from mastd3r.mapping.splat import Splat
from test_mapping_mapper import CAMERA, pose, wall

CAM = CAMERA.resized(192, 144)


@pytest.fixture(scope="module")
def truth() -> GaussianMap:
    gaussians = seed_gaussians(wall(6000, 0.0), 6000, 0)
    gaussians.opacity_logits.data += 3
    return gaussians


def wrong(world_from_cam: np.ndarray, turn_deg: float, shift: float) -> np.ndarray:
    out = world_from_cam.copy()
    out[:3, :3] = out[:3, :3] @ Rotation.from_euler("xyz", [turn_deg, -turn_deg, turn_deg], degrees=True).as_matrix()
    out[:3, 3] += [shift, -shift, shift]
    return out


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY)


def off_px(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance of the wall's points between two cameras' pictures."""
    points = wall(200, 0.0).points_world.astype(float)
    px = [CAM.project((points - p[:3, 3]) @ p[:3, :3]) for p in (a, b)]
    return float(np.linalg.norm(px[0] - px[1], axis=1).mean())


def scene(truth: GaussianMap, i: int, start: np.ndarray) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    splat = Splat(truth.arrays(), 0.05)
    color, depth, alpha = splat.render(start, CAM)
    return (grey(color), depth, alpha), grey(splat.render(pose(i), CAM)[0])


@pytest.mark.parametrize("i", range(4))
@pytest.mark.parametrize("gain", [1.0, 0.8])
def test_a_pose_that_is_off_by_a_pixel_is_found(truth: GaussianMap, i: int, gain: float) -> None:
    """Under another exposure too."""
    start = wrong(pose(i), 0.2, 0.01)
    drawn, photo = scene(truth, i, start)
    found = placed(drawn, CAM, np.float32(gain) * photo + np.float32(0.05), np.ones_like(photo), start)
    assert off_px(start, pose(i)) > 0.8
    assert found.accepted and off_px(found.world_from_cam, pose(i)) < 0.05
    assert found.moved_px == pytest.approx(off_px(start, pose(i)), rel=0.3)


def test_what_moves_does_not_pull_under_its_mask(truth: GaussianMap) -> None:
    start = wrong(pose(1), 0.1, 0.01)
    drawn, photo = scene(truth, 1, start)
    weight = np.ones_like(photo)
    photo[40:100, 60:130], weight[40:100, 60:130] = np.roll(photo, 3, 1)[40:100, 60:130], 0
    assert off_px(placed(drawn, CAM, photo, weight, start).world_from_cam, pose(1)) < 0.1


def test_another_place_and_a_blank_picture_leave_the_pose(truth: GaussianMap) -> None:
    start = pose(0)
    drawn, photo = scene(truth, 0, start)
    for other in (np.full_like(photo, 0.5), np.ascontiguousarray(photo[::-1, ::-1])):
        found = placed(drawn, CAM, other, np.ones_like(photo), start)
        assert not found.accepted and np.array_equal(found.world_from_cam, start)
    nothing = placed(drawn, CAM, photo, np.zeros_like(photo), start)
    assert not nothing.accepted
    far = wrong(start, 3, 0.0)
    assert off_px(far, start) > FARTHEST_PX
    assert off_px(placed(scene(truth, 0, far)[0], CAM, photo, np.ones_like(photo), far).world_from_cam, far) < 4.5


def test_the_jacobian_is_that_of_the_projection() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (20, 3))
    got, step = _pixel_by_pose(points, CAM), 1e-6
    for k in range(6):
        moved = []
        for sign in (1, -1):
            xi = np.zeros(6)
            xi[k] = sign * step
            moved.append(CAM.project(points + xi[:3] + np.cross(xi[3:], points)))
        assert np.allclose((moved[0] - moved[1]) / (2 * step), got[:, :, k], atol=1e-4)
