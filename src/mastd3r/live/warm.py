"""Before a camera is read: the whole loop once, on pictures that are made here, so that its first frames do not wait.

Kernels are compiled, or loaded, by their first call; networks record themselves. With a camera running that would be
frames that are dropped, and a start from views far apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..config import Config
from ..slam import Slam
from ..sources.passing import MadeSource
from ..tracking.state import Status
from ..tracking.two_view import far_matches
from ..types import Frame

Array = NDArray[Any]
MOST, AFTER = 40, 4  # frames at most; and once there is a map
STEP_RATIO = 0.012  # of the width, by which the nearest layer moves from frame to frame
NEAR = (0.3, 0.6, 1.0)  # inverse depths of the layers
LARGEST_SIDE_PX = 1280  # up to which pictures are made as large as the camera's
STARTS_WITH = 3  # keyframes


def warm_up(config: Config, size: tuple[int, int]) -> bool:
    """Track pictures of ``size`` (width, height) with these options; True where that came as far as a map."""
    width, height = size
    config = replace(
        config,
        camera=replace(config.camera, intrinsics=(width, width, (width - 1) / 2, (height - 1) / 2)),
        graph=replace(config.graph, bootstrap_keyframes=STARTS_WITH),
        mapping=replace(config.mapping, enabled=False),
    )
    slam = Slam(config, size, source=MadeSource(size))
    tracked = 0
    try:
        for frame in _pictures(width, height):
            result = slam.track(frame)
            result.moving  # noqa: B018  it is made in a thread, and asked for here
            tracked += result.state is Status.TRACKING
            if tracked > AFTER:
                break
        anchor, last = slam.state.anchor, slam.state.last
        if anchor is not None and last is not None:  # a camera that is nearly lost cannot wait for these to be read
            far_matches(slam.parts, anchor, last.work, last.moving.get())
    finally:
        slam.masks.close()
        slam.keyframes.close()
    return tracked > 0


def _pictures(width: int, height: int) -> Iterator[Frame]:
    """Textured layers one behind the other, past which the camera moves."""
    full_px = (width, height)
    share = min(1.0, LARGEST_SIDE_PX / max(full_px))  # large ones are enlarged: noise for them takes minutes
    width, height = (max(1, round(share * side)) for side in full_px)
    rng = np.random.default_rng(0)
    wide = width + int(STEP_RATIO * width * MOST) + 1
    layers = [(_noise(rng, wide, height, 3, 1.5), _noise(rng, wide, height, 1, width / 16) > 128) for _ in NEAR]
    for n in range(MOST):
        image = np.zeros((height, width, 3), np.uint8)
        for k, (near, (texture, opaque)) in enumerate(zip(NEAR, layers, strict=True)):
            shift = np.array([[1, 0, -n * STEP_RATIO * width * near], [0, 1, 0]])
            moved = cv2.warpAffine(texture, shift, (width, height), flags=cv2.INTER_LINEAR)
            there = cv2.warpAffine(opaque.astype(np.uint8), shift, (width, height)) > 0
            image = moved if k == 0 else np.where(there[..., None], moved, image)
        yield Frame(n, n / 10, np.ascontiguousarray(image if share == 1 else cv2.resize(image, full_px)))


def _noise(rng: np.random.Generator, width: int, height: int, channels: int, blur_px: float) -> Array:
    """(h, w[, 3]) uint8 smooth noise over all levels."""
    noise = cv2.GaussianBlur(rng.normal(size=(height, width, channels)), (0, 0), blur_px)
    noise = (noise - noise.mean()) / noise.std()
    return np.asarray(np.clip(128 + 50 * noise, 0, 255).astype(np.uint8))
