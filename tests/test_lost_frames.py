"""Frames that were lost while tracking are looked for once more after the last one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from mastd3r.config import config_from_dict
from mastd3r.geometry.se3 import inverse
from mastd3r.offline.final_solve import final_frames, finish_graph
from mastd3r.slam import Slam
from mastd3r.sources import synthetic
from mastd3r.tracking.lost_frames import find_lost
from mastd3r.tracking.observation import Observer
from mastd3r.types import Frame

FRAMES, BLACK = 40, 25


@pytest.fixture(scope="module")
def slam() -> Slam:
    """A short clip, tracked, of which two frames are lost afterwards; a third has no picture at all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CLIP_FPS", 4.0)
        images = [view.frame.image for view in synthetic.synthetic_frames(FRAMES, 320, 240)]
    images[BLACK] = np.zeros_like(images[BLACK])
    slam = Slam(config_from_dict({"mapping": {"enabled": False}, "semantics": "none"}), (320, 240))
    for n, image in enumerate(images):
        slam.track(image, n / 4)
    slam.end_tracking()
    finish_graph(slam.graph, slam.config)
    final_frames(slam.graph)
    return slam


def place_of(slam: Slam, n: int) -> np.ndarray:
    record = slam.graph.records[n]
    return np.asarray(inverse(record.cam_from_kf @ slam.graph.variables[record.kf_id].cam_from_world))


def test_what_keyframes_see_is_found_and_what_shows_nothing_is_not(slam: Slam) -> None:
    graph = slam.graph
    assert graph.initialised and graph.records[BLACK].state == "lost"
    tracked = [n for n, r in enumerate(graph.records) if r.state == "tracked" and not r.is_keyframe]
    lost = (tracked[len(tracked) // 3], tracked[-2])
    true = {n: place_of(slam, n) for n in lost}
    size = np.ptp([place_of(slam, n)[:3, 3] for n in tracked], axis=0).max()
    for n in lost:
        graph.set_record_state(graph.records[n], "lost")
        graph.set_record_pose(graph.records[n], np.eye(4))
    read: list[int] = []

    def frames() -> Iterator[Frame]:
        for frame in slam.source.frames():
            read.append(frame.index)
            yield frame

    assert find_lost(frames(), graph, Observer(slam.parts), slam.two_view) == len(lost)
    assert read == list(range(max(lost) + 1))  # nothing behind the last that was lost
    assert graph.records[BLACK].state == "lost"
    for n in lost:
        assert graph.records[n].state == "tracked" and len(graph.records[n].points) >= 60
    for n in lost:
        assert np.linalg.norm(place_of(slam, n)[:3, 3] - true[n][:3, 3]) < 0.02 * size


def test_nothing_is_read_again_where_nothing_was_lost(slam: Slam) -> None:
    graph = slam.graph
    before = graph.records[BLACK].state
    graph.set_record_state(graph.records[BLACK], "interpolated")

    def frames() -> Iterator[Frame]:
        raise AssertionError("no frame is wanted")
        yield

    assert find_lost(frames(), graph, Observer(slam.parts), slam.two_view) == 0
    graph.set_record_state(graph.records[BLACK], before)
