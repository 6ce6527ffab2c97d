"""What views may share by their poses: predicted overlap, and who is near enough to be asked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mastd3r.graph import covisibility
from mastd3r.graph.covisibility import covisible, nearby, nearest_keyframe, overlap, overlaps
from test_loop_closure import VIEWS, drifted


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.15)


def test_overlaps_are_those_of_each_view(scene: Any) -> None:
    graph, _ = drifted(scene, scale=1.0)
    poses = np.stack([graph.variables[k].cam_from_world for k in range(VIEWS)])
    behind = poses[3].copy()
    behind[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ behind[:3, :3]
    behind[:3, 3] = np.diag([-1.0, 1.0, -1.0]) @ behind[:3, 3]
    share, motion = overlaps(graph, 3, np.concatenate([poses, behind[None]]))
    assert share[3] == 1.0 and motion[3] < 1e-6
    assert share[-1] == 0.0 and np.isinf(motion[-1])
    for k in range(VIEWS):
        assert (share[k], motion[k]) == pytest.approx(overlap(graph, 3, poses[k]))
    assert (np.diff(motion[3:]) > 0).all()


def test_in_a_long_video_only_those_that_are_near_are_looked_at(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """By distance in units of their depth; what is found among all is found among them."""
    graph, _ = drifted(scene, scale=1.0)
    pose, ids = graph.variables[6].cam_from_world, graph.members()
    assert nearby(graph, ids, pose) == ids  # few are all looked at
    whole = covisible(graph, VIEWS - 1, VIEWS - 2, 4, 0.5), nearest_keyframe(graph, pose, 6, 0.3, 1.0)
    monkeypatch.setattr(covisibility, "FEW", 4)
    assert nearby(graph, ids, pose) == ids  # all within a few depths
    assert whole == (covisible(graph, VIEWS - 1, VIEWS - 2, 4, 0.5), nearest_keyframe(graph, pose, 6, 0.3, 1.0))
    far = graph.variables[2].cam_from_world.copy()
    far[:3, 3] += [0.0, 0.0, 20 / float(graph.variables[2].inv_depth.mean())]
    graph.set_keyframe_pose(2, far)
    assert nearby(graph, ids, pose) == [k for k in ids if k != 2]
    assert nearby(graph, ids, far) == [2]
