"""A video file from frames."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OutputError

CODECS = ("libx264", "libopenh264", "mpeg4")  # the first that this build of PyAV has
QUALITY = {"libx264": {"crf": "18", "preset": "veryfast"}}
BITS_PER_PIXEL = 0.3  # for the codecs that take a rate instead


def write_video(path: Path, frames: Iterable[NDArray[Any]], fps: int) -> str:
    """Write (h, w, 3) images, uint8 or float in 0..1, as an .mp4; the codec's name. Raises OutputError.

    An odd row or column at the end is cut: the colours of video are at half size.
    """
    import av

    codec = next((c for c in CODECS if c in av.codecs_available), None)
    if codec is None:
        raise OutputError(f"{path}: expected a PyAV with one of {', '.join(CODECS)}, got none of them")
    stream = None
    try:
        with av.open(str(path), "w") as container:
            for image in frames:
                picture = image if image.dtype == np.uint8 else np.rint(image.clip(0, 1) * 255).astype(np.uint8)
                height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
                if stream is None:
                    stream = container.add_stream(codec, rate=Fraction(fps), options=QUALITY.get(codec, {}))
                    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                    if codec not in QUALITY:
                        stream.bit_rate = int(BITS_PER_PIXEL * width * height * fps)
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), format="rgb24")
                container.mux(stream.encode(frame))
            if stream is not None:
                container.mux(stream.encode())
    except (OSError, av.FFmpegError) as e:
        path.unlink(missing_ok=True)
        raise OutputError(f"{path}: expected to write a video with {codec}, got {' '.join(str(e).split())}") from e
    return codec
