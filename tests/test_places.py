"""Where a frame, or a piece, may be found again, and where the camera cannot be."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mastd3r.concurrency import Future
from mastd3r.geometry.se3 import inverse, se3_exp
from mastd3r.tracking.joining import join_recognised
from mastd3r.tracking.places import TURN_AT_ONCE, plausible_turn
from mastd3r.tracking.recovery import Recovery
from test_loop_closure import VIEWS, drifted


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.15)


def test_a_camera_does_not_turn_round_from_one_frame_to_the_next(scene: Any) -> None:
    graph, _ = drifted(scene)
    index, pose = VIEWS, graph.records[-1].cam_from_kf @ graph.variables[VIEWS - 1].cam_from_world

    def seen(turn: float, kf: int) -> Any:
        found = se3_exp(np.array([0, 0, 0, 0, turn, 0])) @ pose @ inverse(graph.variables[kf].cam_from_world)
        return SimpleNamespace(anchor=graph.keyframes[kf], alignment=SimpleNamespace(new_from_ref=found))

    for kf in (2, VIEWS - 1):
        assert plausible_turn(graph, index, seen(0.9 * TURN_AT_ONCE, kf))
        assert not plausible_turn(graph, index, seen(2.5, kf))
        assert plausible_turn(graph, index + 30, seen(2.5, kf))  # after a while it may be anywhere
    graph.started.clear()
    assert plausible_turn(graph, index, seen(2.5, 2))  # no poses yet, nothing to tell


@pytest.mark.parametrize(
    ("turn", "sure", "walked", "found"),
    [
        (0.1, False, None, True),
        (2.5, False, 0.0, False),
        (2.5, True, 0.0, True),  # another keyframe sees the frame at the same place
        (2.5, True, 0.5, False),  # what both see has walked on in between
        (2.5, True, None, False),  # no other keyframe sees it
    ],
)
def test_a_lost_frame_is_not_found_where_the_camera_cannot_be(
    scene: Any, turn: float, sure: bool, walked: float | None, found: bool
) -> None:
    graph, _ = drifted(scene)
    pose = graph.records[-1].cam_from_kf @ graph.variables[VIEWS - 1].cam_from_world
    depth = 1 / float(np.median(graph.variables[2].inv_depth))

    def seen(kf: Any, *_: Any) -> Any:
        if kf.id != 2 and walked is None:
            return None
        there = se3_exp(np.array([0, 0, 0, 0, turn, 0])) @ pose @ inverse(graph.variables[kf.id].cam_from_world)
        if kf.id != 2:
            there[0, 3] += (walked or 0.0) * depth
        return SimpleNamespace(anchor=kf, alignment=SimpleNamespace(new_from_ref=there))

    eyes: Any = SimpleNamespace(graph=graph, relocalised=seen, beyond_doubt=lambda *_: sure)
    recovery = Recovery(None, graph, eyes, None)  # type: ignore[arg-type]
    work: Any = SimpleNamespace(index=VIEWS)
    view = recovery._relocalised([graph.keyframes[2]], work, Future.done(np.zeros(1)))
    assert (view is not None and view.anchor.id == 2) == found


def test_pieces_are_not_joined_by_a_view_in_doubt(scene: Any) -> None:
    graph, _ = drifted(scene)
    asked: list[int] = []

    def doubted(view: Any, work: Any, prior: Any) -> bool:
        asked.append(work.index)
        return False

    graph.started.add(1)
    graph.submap_of[VIEWS - 1] = 1
    parts = SimpleNamespace(features=SimpleNamespace(alike=lambda _, others: np.full(len(others), np.nan)))
    eyes: Any = SimpleNamespace(parts=parts, relocalised=lambda *_: SimpleNamespace(), beyond_doubt=doubted)
    places: Any = SimpleNamespace(best=lambda graph, work, ids: [graph.keyframes[ids[0]]])
    entry: Any = SimpleNamespace(view=lambda *_: None, open_to=lambda ids: ids)
    assert not join_recognised(graph, graph.latest, eyes, None, places, entry, [])  # type: ignore[arg-type]
    assert asked == [VIEWS - 1] and graph.submap_of[VIEWS - 1] == 1
