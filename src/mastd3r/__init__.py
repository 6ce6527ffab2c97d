"""Any video with moving things in it: the camera's trajectory, a dense static map and a clean Gaussian splat.

    import mastd3r
    rec = mastd3r.reconstruct("my.mp4")             # a Reconstruction: everything, in memory and on disk
    slam = mastd3r.Slam(mastd3r.Config(), size=(640, 480))
    result = slam.track(image, timestamp_s)         # (h, w, 3) uint8 RGB, seconds
    rec = slam.finish()

Names are loaded when they are first used, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .config import Config
    from .errors import ConfigError, InputError, MissingPackage, OutputError, SlamError
    from .live.loop import LiveFrame, LiveLoop
    from .live.run import run_live
    from .offline.reconstruction import Reconstruction
    from .pipeline import evaluate_trajectory, finish_live, load, reconstruct
    from .slam import Slam, TrackResult
    from .sources.camera import CameraOptions, open_camera
    from .tracking.state import Status

__version__ = "0.1.0"
__all__ = [
    "CameraOptions",
    "Config",
    "ConfigError",
    "InputError",
    "LiveFrame",
    "LiveLoop",
    "MissingPackage",
    "OutputError",
    "Reconstruction",
    "Slam",
    "SlamError",
    "Status",
    "TrackResult",
    "__version__",
    "evaluate_trajectory",
    "finish_live",
    "load",
    "open_camera",
    "reconstruct",
    "run_live",
]
_HOME = {
    "CameraOptions": "sources.camera",
    "Config": "config",
    "ConfigError": "errors",
    "InputError": "errors",
    "LiveFrame": "live.loop",
    "LiveLoop": "live.loop",
    "MissingPackage": "errors",
    "OutputError": "errors",
    "Reconstruction": "offline.reconstruction",
    "Slam": "slam",
    "SlamError": "errors",
    "Status": "tracking.state",
    "TrackResult": "slam",
    "evaluate_trajectory": "pipeline",
    "finish_live": "pipeline",
    "load": "pipeline",
    "open_camera": "sources.camera",
    "reconstruct": "pipeline",
    "run_live": "live.run",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
