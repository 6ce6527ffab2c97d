"""The chain of keyframes: no weak links, and none for what only passes in front."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.geometry.se3 import se3_exp
from mastd3r.sources.room import camera_pose
from mastd3r.tracking import keyframes
from test_submaps import Room, play, views_of

Array = NDArray[Any]


def turning_fast(time_s: float) -> Array:
    """24 frames as ever, then 6 degrees more with every frame."""
    turn_deg = 6.0 * max(10 * time_s - 24, 0.0)
    return camera_pose(time_s) @ se3_exp(np.array([0, 0, 0, 0, np.deg2rad(turn_deg), 0]))


def test_the_chain_has_no_weak_link() -> None:
    """Where motion alone never asks for a keyframe, one is made before few matches are left."""
    graph = play(views_of(36, turning_fast), motion_ratio=2.0).slam.graph
    strength = []
    for ref, new in pairwise(graph.keyframes):
        usable = (ref.work.texture * ref.static > 0.05).sum()
        links = [(e.weight > 0.05).sum() for e in graph.edges if (e.i, e.j) == (ref.id, new.id)]
        strength.append(max(links, default=0) / usable)
    assert len(strength) >= 6 and min(strength) > 0.3


def test_what_passes_in_front_makes_no_keyframes() -> None:
    """The camera stands still while most of its view is hidden, by something else in every frame."""
    rng, frames = np.random.default_rng(0), views_of(16)
    last = frames[-1]
    for _ in range(8):
        image = last.frame.image.copy()
        hidden = rng.integers(0, 255, (9, 9, 3), np.uint8)
        image[:, :190] = cv2.resize(hidden, (190, Room.size[1]), interpolation=cv2.INTER_CUBIC)
        frames.append(replace(last, frame=replace(last.frame, image=image)))
    slam = play(frames).slam
    assert len(slam.graph.keyframes) >= 4
    assert max(r.index for r in slam.graph.records if r.is_keyframe) <= 16


def slow(time_s: float) -> Array:
    """A fifteenth of the usual pace."""
    return camera_pose(time_s / 15)


def test_a_slow_camera_starts_by_less_motion_once_it_has_waited(monkeypatch: pytest.MonkeyPatch) -> None:
    views = views_of(60, slow)
    found = [kf.work.index for kf in play(views).slam.graph.keyframes]
    assert len(found) == 3 and np.diff(found).max() >= keyframes.SLOW_FRAMES
    monkeypatch.setattr(keyframes, "SLOW_MOTION", 1.0)
    assert len(play(views).slam.graph.keyframes) < len(found)
