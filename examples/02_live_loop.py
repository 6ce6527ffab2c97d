"""A robot's loop: an image in, a pose and a mask out, frame by frame; everything else when the camera stops.

usage: python examples/02_live_loop.py CAMERA_NUMBER_OR_VIDEO OUT
"""

import sys

import cv2

import mastd3r
from mastd3r.config import with_override


def main(camera: str, out: str) -> None:
    video = cv2.VideoCapture(int(camera) if camera.isdigit() else camera)
    size = (int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    slam = mastd3r.Slam(with_override(mastd3r.Config(), "mapping.enabled=false"), size)
    n = 0
    while True:
        there, image = video.read()
        if not there:
            break
        result = slam.track(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), n / rate)
        n += 1
        if result.world_from_cam is None:
            print(f"{result.timestamp_s:7.2f} s  {result.state}  {result.reason}")
        else:
            x, y, z = result.world_from_cam[:3, 3]
            print(f"{result.timestamp_s:7.2f} s  {x:+.3f} {y:+.3f} {z:+.3f}  moving {result.moving.mean():.2f}")
    rec = slam.finish()  # every frame's pose once more, with all that was seen
    print(f"{len(rec.poses)} poses in {rec.save(out)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
