"""A video to trajectory, masks, static cloud and splat.

usage: python examples/01_video.py VIDEO OUT [section.key=value ...]
"""

import sys

import mastd3r
from mastd3r.config import with_override


def main(video: str, out: str, *changes: str) -> None:
    config = mastd3r.Config()
    for change in changes:
        config = with_override(config, change)
    rec = mastd3r.reconstruct(video, out, config)
    print(f"{len(rec.poses)} poses, {int(rec.is_keyframe.sum())} keyframes, {len(rec.cloud.points_world)} points")
    print(f"focal length {rec.camera.fx_px:.1f} px of {rec.camera.width}x{rec.camera.height}")
    print(f"{len(rec.masks)} masks, mean P(moving) {sum(float(m.mean()) for m in rec.masks) / len(rec.masks):.3f}")
    print("no splat" if rec.gaussians is None else f"{len(rec.gaussians.means)} Gaussians")
    print(f"COLMAP model in {rec.export('colmap', rec.path / 'colmap')}; report in {rec.path / 'report.html'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
