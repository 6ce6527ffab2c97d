"""The TUM RGB-D benchmark: the TUM layout, and which of its three cameras took the pictures.

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. groundtruth.txt is the pose of the
colour camera's optical frame at the rate of the motion capture; depth is registered to colour, 5000 units a metre. The
archives' rgb.txt names the recording in its head, for instance ``# file: 'rgbd_dataset_freiburg3_walking_xyz.bag'``:
that, and no folder's name, tells the camera.
"""

from __future__ import annotations

import re
from pathlib import Path

from ..reading.files import first_bytes, is_file

KIND = "tum"
EXPECTED = "the TUM layout (rgb.txt with 'timestamp_s filename' lines)"
# fx fy cx cy k1 k2 p1 p2 k3 of the colour cameras, pixels of 640x480: the benchmark's page on file formats, with the
# digits of the calibration files offered there. Pictures of freiburg3 are published without distortion.
CAMERAS: dict[str, tuple[float, ...]] = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
SIZE = (640, 480)
RECORDING = re.compile(r"rgbd_dataset_(freiburg[123])_\w+")
HEAD_LINES, HEAD_BYTES = 10, 2**14


def looks_like(folder: Path) -> str | None:
    """What makes a folder a TUM layout, or None."""
    return "rgb.txt is there" if is_file(folder / "rgb.txt") else None


def recording_of(folder: Path) -> tuple[str, str] | None:
    """The recording that rgb.txt names in its head and its camera, None where it names none of the benchmark's.

    Raises InputError.
    """
    head = first_bytes(folder / "rgb.txt", HEAD_BYTES, "a readable list of images")
    lines = head.decode("utf-8-sig", "replace").splitlines()[:HEAD_LINES]
    found = RECORDING.search("\n".join(line for line in lines if line.startswith("#")))
    return (found[0], found[1]) if found else None
