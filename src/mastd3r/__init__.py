"""Any video with moving things in it: the camera's trajectory, a dense static map and a clean Gaussian splat.

    import mastd3r
    rec = mastd3r.reconstruct("my.mp4")             # a Reconstruction: everything, in memory and on disk
    slam = mastd3r.Slam(mastd3r.Config(), size=(640, 480))
    result = slam.track(image, timestamp_s)         # (h, w, 3) uint8 RGB, seconds
    rec = slam.finish()

Names are loaded when they are first used, so that importing the package costs nothing.
"""

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .config import Config
    from .errors import ConfigError, InputError, MissingPackage, OutputError, SlamError
    from .live.loop import LiveFrame, LiveLoop
    from .live.run import run_live
    from .offline.reconstruction import Reconstruction
    from .offline.saved_map import SavedMap
    from .pipeline import evaluate_trajectory, finish_live, load, load_map, reconstruct, save_map
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
    "SavedMap",
    "Slam",
    "SlamError",
    "Status",
    "TrackResult",
    "__version__",
    "evaluate_trajectory",
    "finish_live",
    "load",
    "load_map",
    "open_camera",
    "reconstruct",
    "run_live",
    "save_map",
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
    "SavedMap": "offline.saved_map",
    "Slam": "slam",
    "SlamError": "errors",
    "Status": "tracking.state",
    "TrackResult": "slam",
    "evaluate_trajectory": "pipeline",
    "finish_live": "pipeline",
    "load": "pipeline",
    "load_map": "pipeline",
    "open_camera": "sources.camera",
    "reconstruct": "pipeline",
    "run_live": "live.run",
    "save_map": "pipeline",
}


def _let_kernels_be_kept() -> None:
    """Numba compiles nothing where it can keep nothing: where the installation is read-only, and the user has no home.

    They are kept in the folder for temporary files then, if that is the user's alone.
    """
    package, home = Path(__file__).parent, Path(os.path.expanduser("~"))
    beside = package / "__pycache__" if (package / "__pycache__").is_dir() else package
    there = home / ".cache" if (home / ".cache").is_dir() else home
    if "NUMBA_CACHE_DIR" in os.environ or os.access(beside, os.W_OK) or os.access(there, os.W_OK):
        return
    import tempfile

    try:
        folder = Path(tempfile.gettempdir()) / f"mastd3r-kernels-{getattr(os, 'getuid', int)()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        info = folder.lstat()
        mine = not hasattr(os, "getuid") or (info.st_uid == os.getuid() and info.st_mode & 0o077 == 0)
        os.environ["NUMBA_CACHE_DIR"] = str(folder if mine and not folder.is_symlink() else tempfile.mkdtemp())
    except OSError:  # nothing can be written anywhere: whoever compiles says so
        return


_let_kernels_be_kept()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
