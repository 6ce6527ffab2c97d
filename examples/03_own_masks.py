"""Your own P(movable) of every frame: a prior that is weighed against what is seen to move.

usage: python examples/03_own_masks.py SEQUENCE OUT
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import mastd3r
from mastd3r.config import with_override
from mastd3r.sources import open_source


def movable(image: np.ndarray) -> np.ndarray:
    """(h, w) float32 in 0..1: put your segmentation network here. This one calls vivid colours movable."""
    saturation = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)[..., 1].astype(np.float32) / 255
    return np.clip(2 * cv2.GaussianBlur(saturation, (0, 0), 2) - 0.8, 0, 1)


def main(sequence: str, out: str) -> None:
    config = with_override(mastd3r.Config(semantics="maps"), "mapping.enabled=false")
    source = open_source(Path(sequence), config.source)
    slam = mastd3r.Slam(config, source.size)
    for frame in source.frames():
        slam.track(frame.image, frame.timestamp_s, semantic=movable(frame.image))
    rec = slam.finish()
    print(f"mean P(moving) {sum(float(m.mean()) for m in rec.masks) / len(rec.masks):.3f}; saved in {rec.save(out)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
