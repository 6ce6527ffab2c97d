"""A depth sensor beside the camera: metres instead of map units, and a pose from the second frame on.

usage: python examples/05_sensor_depth.py TUM_SEQUENCE OUT
"""

import sys
from pathlib import Path

import numpy as np

import mastd3r
from mastd3r.config import with_override
from mastd3r.sources import open_source


def main(sequence: str, out: str) -> None:
    config = with_override(mastd3r.Config(pointmaps="depth"), "mapping.enabled=false")
    source = open_source(Path(sequence), config.source, want_depth=True)
    slam = mastd3r.Slam(config, source.size)
    for frame in source.frames():  # here your camera's images (h, w, 3) uint8 and its depth (h, w) in metres
        result = slam.track(frame.image, frame.timestamp_s, depth_m=frame.depth_m)
        if result.is_keyframe:
            print(f"{result.timestamp_s:.2f} s: keyframe {result.keyframe_id}, {result.state}")
    rec = slam.finish()
    path_m = np.linalg.norm(np.diff(rec.poses[:, :3, 3], axis=0), axis=1).sum()
    print(f"the camera went {path_m:.2f} m; saved in {rec.save(out)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
