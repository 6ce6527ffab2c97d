"""A camera while it runs: every frame's pose and mask as it comes, and a run folder when it ends.

    from mastd3r.live import LiveLoop, open_camera
    with LiveLoop(open_camera("0")) as live:
        for seen in live:                           # .world_from_cam .state .moving .latency_s
            cloud = live.cloud()                    # the static points so far

``run_live`` is what ``mastd3r live`` does.
"""

from ..sources.camera import CameraOptions, open_camera
from .loop import LiveFrame, LiveLoop
from .run import LiveView, run_live

__all__ = ["CameraOptions", "LiveFrame", "LiveLoop", "LiveView", "open_camera", "run_live"]
