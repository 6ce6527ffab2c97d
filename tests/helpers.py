"""Small helpers that several test files share."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

Array = NDArray[Any]
CAPABILITY_VERSION, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 0x20080522, 1, 2


def data_path(name: str) -> Path:
    """Folder of one real sequence; the test is skipped where the sequences are not at hand."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MASTD3R_DATA", default)) / name
    if not folder.is_dir():
        pytest.skip(f"real sequence {name} is not at hand (set MASTD3R_DATA to the folder that holds it)")
    return folder


def blobs(count: int, width: int = 64, height: int = 48, seed: int = 0) -> list[Array]:
    """Smooth coloured images, each unlike the others: (h, w, 3) uint8."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    images = []
    for _ in range(count):
        waves = [np.sin(2 * np.pi * (a * x + b * y + c)) for a, b, c in rng.uniform(-1.5, 1.5, (3, 3))]
        images.append(np.rint(127 + 110 * np.stack(waves, -1)).astype(np.uint8))
    return images


def write_video(
    path: Path,
    images: Sequence[Array],
    times_ms: Sequence[int] | None = None,
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    gop: int = 12,
    mux: dict[str, str] | None = None,
    codec_options: dict[str, str] | None = None,
) -> Path:
    """Write images as a video with the given presentation times (default 30 frames a second)."""
    if times_ms is None:
        times_ms = [round(1000 * i / 30) for i in range(len(images))]
    with av.open(str(path), "w", options=mux or {}) as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pix_fmt
        stream.options = codec_options if codec_options is not None else {"crf": "10"}
        stream.codec_context.gop_size = gop
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for image, t in zip(images, times_ms, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24" if image.ndim == 3 else "gray")
            frame.pts, frame.time_base = t, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def patch_display_matrix(path: Path, matrix: Sequence[int]) -> None:
    """Overwrite the linear part (a, b, c, d) of an mp4's display matrix: x' = a x + c y, y' = b x + d y."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 4 + 20 + 8 + 8  # version and flags, times and ids, reserved, layer … volume
    a, b, c, d = (v << 16 for v in matrix)
    data[at : at + 36] = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()
    path.write_bytes(data)


def give_up_rights() -> None:
    """Root may read and write everything by two capabilities, which this process has no more from here on (Linux)."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return
    system = ctypes.CDLL(None)
    head, sets = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    system.capget(head, sets)
    for which in range(3):  # effective, permitted, inheritable; of the lower 32
        sets[which] &= ~(1 << CAP_DAC_OVERRIDE | 1 << CAP_DAC_READ_SEARCH)
    if system.capset(head, sets):
        raise OSError("capset")
