"""Cameras, streams and pipes: what comes is what was sent, and whatever fails is a line and no crash."""

from __future__ import annotations

import io
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from helpers import blobs, write_video
from local_server import file_server
from mastd3r.concurrency import Newest
from mastd3r.config import SourceConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.sources.camera import WORDS, CameraFrame, CameraOptions, open_camera
from mastd3r.sources.paced import paced
from mastd3r.sources.raw_frames import standard_input
from rtsp_server import rtsp_server

Array = NDArray[Any]
FAST = CameraOptions(timeout_s=0.4)


def sent(path: Path, count: int = 12, size: tuple[int, int] = (64, 48)) -> list[Array]:
    """Images in an MPEG transport stream of 30 frames a second."""
    images = blobs(count, *size)
    write_video(path, images, codec_options={"crf": "10", "tune": "zerolatency"}, gop=4)
    return images


def close(a: Array, b: Array) -> bool:
    return bool(np.abs(a.astype(int) - b.astype(int)).mean() < 8)


# -- the slot ------------------------------------------------------------------------------------------------


def test_the_newest_is_taken_and_the_others_are_counted() -> None:
    go, gone = threading.Event(), threading.Event()

    def items() -> Iterator[int]:
        yield 0
        go.wait(10)
        yield from range(1, 6)
        gone.set()
        raise InputError("the end of it")

    slot = Newest(items(), "test")
    assert slot.take(10) == 0 and slot.take(0.01) is None and not slot.over
    go.set()
    assert gone.wait(10)
    assert slot.take(10) == 5 and (slot.came, slot.dropped) == (6, 4)
    with pytest.raises(InputError, match="the end of it"):
        slot.take(10)
    assert slot.over and slot.take(0.01) is None


def test_a_slot_is_left_while_its_camera_says_nothing() -> None:
    never = threading.Event()

    def items() -> Iterator[int]:
        never.wait(60)
        yield 0

    slot = Newest(items(), "test")
    began = time.monotonic()
    slot.close(timeout_s=0.05)
    assert time.monotonic() - began < 5
    never.set()


# -- a pipe --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bgr24", "rgb24", "gray8"])
def test_raw_frames_are_what_was_piped(kind: str) -> None:
    images = blobs(3, 10, 7)
    as_sent = {
        "bgr24": lambda i: i[..., ::-1],
        "rgb24": lambda i: i,
        "gray8": lambda i: cv2.cvtColor(i, cv2.COLOR_RGB2GRAY),
    }[kind]
    pipe = io.BytesIO(b"".join(as_sent(i).tobytes() for i in images) + b"half")
    camera = standard_input(CameraOptions(size=(10, 7), pixel_format=kind, fps=20.0), pipe)
    frames = list(camera.frames())
    assert [f.timestamp_s for f in frames] == [0.0, 0.05, 0.1]
    for frame, image in zip(frames, images, strict=True):
        grey = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, 2)
        assert np.array_equal(frame.image, grey if kind == "gray8" else image) and frame.image.flags.writeable
    assert camera.said == [f"the pipe ended within frame 3: 4 of {70 * (1 if kind == 'gray8' else 3)} bytes, left out"]


@pytest.mark.parametrize("colours", ["420jpeg", "mono"])
def test_y4m_says_itself_what_it_is(colours: str) -> None:
    image = blobs(1, 64, 48)[0]
    planes = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420 if colours != "mono" else cv2.COLOR_RGB2GRAY)
    frame = b"FRAME\n" + planes.tobytes()
    pipe = io.BytesIO(f"YUV4MPEG2 W64 H48 F25:1 Ip A1:1 C{colours}\n".encode() + frame + frame)
    camera = standard_input(CameraOptions(), pipe)
    frames = list(camera.frames())
    assert camera.size == (64, 48) and [f.timestamp_s for f in frames] == [0.0, 0.04]
    expected = image if colours != "mono" else np.repeat(planes[..., None], 3, 2)
    assert all(close(f.image, expected) for f in frames)
    lost = standard_input(CameraOptions(), io.BytesIO(b"YUV4MPEG2 W64 H48 F25:1 Cmono\n" + frame[6:] * 2))
    with pytest.raises(InputError, match="expected FRAME before frame 0"):
        next(lost.frames())


@pytest.mark.parametrize(
    ("options", "data", "says"),
    [
        (CameraOptions(), b"", "expected raw frames with --size WxH, or a y4m stream, got an empty one"),
        (CameraOptions(), b"\x00\x01\x02", "got a stream beginning"),
        (CameraOptions(), b"YUV4MPEG2 W16 F25:1\n", "expected W, H and F"),
        (CameraOptions(), b"YUV4MPEG2 W16 H12 F25:1 C444\n", "expected y4m of C420 or Cmono"),
        (CameraOptions(pixel_format="rgb24"), b"", "expected --size WxH of raw frames"),
        (CameraOptions(size=(4, 4), pixel_format="nv12"), b"", "expected one of bgr24, rgb24, gray8"),
        (CameraOptions(size=(0, 4)), b"", "expected sides of 1 to"),
        (CameraOptions(size=(16000, 16000)), b"", "expected at most 80000000 pixels, got 16000x16000"),
        (CameraOptions(), b"YUV4MPEG2 W16000 H16000 F25:1\n", "expected at most 80000000 pixels"),
    ],
)
def test_a_pipe_of_something_else_is_refused(options: CameraOptions, data: bytes, says: str) -> None:
    with pytest.raises((InputError, ConfigError), match=says) as caught:
        standard_input(options, io.BytesIO(data))
    assert "\n" not in str(caught.value)


# -- streams -------------------------------------------------------------------------------------------------


def test_a_stream_over_http(tmp_path: Path) -> None:
    images = sent(tmp_path / "clip.ts")
    with file_server() as server:
        server.files["/clip.ts"] = (tmp_path / "clip.ts").read_bytes()
        camera = open_camera(f"{server.url}/clip.ts", FAST)
        frames = list(camera.frames())
    assert camera.size == (64, 48) and len(frames) == 12
    assert all(close(f.image, i) for f, i in zip(frames, images, strict=True))
    assert np.allclose([f.timestamp_s for f in frames], np.arange(12) / 30, atol=2e-3)
    assert camera.said == [f"{server.url}/clip.ts: the stream ended"]


def test_a_stream_over_rtsp(tmp_path: Path) -> None:
    images = sent(tmp_path / "clip.ts", 30)
    with rtsp_server((tmp_path / "clip.ts").read_bytes(), 0.6) as url:
        camera = open_camera(url.replace("rtsp://", "rtsp://somebody:secret@"), FAST)
        frames = list(camera.frames())
    assert len(frames) > 15 and any(close(frames[0].image, i) for i in images)
    assert np.all(np.diff([f.timestamp_s for f in frames]) > 0)
    assert "secret" not in camera.name and all("secret" not in line for line in camera.said)


@contextmanager
def silent_after(data: bytes) -> Iterator[str]:
    """A server that sends so much of a stream, and then nothing, and does not hang up."""
    server, over = socket.create_server(("127.0.0.1", 0)), threading.Event()

    def serve() -> None:
        connection, _ = server.accept()
        with connection:
            connection.recv(4096)
            connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: video/mp2t\r\n\r\n" + data)
            over.wait(20)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.getsockname()[1]}/live.ts"
    finally:
        over.set()
        thread.join()
        server.close()


def test_a_stream_that_says_nothing_more_is_lost(tmp_path: Path) -> None:
    sent(tmp_path / "clip.ts", 40)
    with silent_after((tmp_path / "clip.ts").read_bytes()) as url:
        camera = open_camera(url, FAST)
        frames = list(camera.frames())
    assert len(frames) > 20 and camera.said == [f"{url}: nothing for 0.4 s"]


def test_a_lost_stream_is_found_again(tmp_path: Path) -> None:
    sent(tmp_path / "clip.ts", 30)
    with file_server() as server:
        server.files["/clip.ts"] = (tmp_path / "clip.ts").read_bytes()
        server.drop_at = [0.6]
        camera = open_camera(f"{server.url}/clip.ts", CameraOptions(timeout_s=0.4, reconnect_s=0.7))
        frames: list[CameraFrame] = []
        for frame in camera.frames():
            frames.append(frame)
            if any("found again" in line for line in camera.said):
                server.files.clear()  # and then it is gone for good
    assert len(frames) > 35 and np.all(np.diff([f.timestamp_s for f in frames]) > 0)
    assert "looked for again for 0.7 s" in camera.said[0] and "found again after" in camera.said[1]
    assert camera.said[-1].endswith("not found again within 0.7 s") and camera.state == "open"


def test_a_video_file_on_a_server_ends_once(tmp_path: Path) -> None:
    sent(tmp_path / "clip.mp4", 20)
    with file_server() as server:
        server.files["/clip.mp4"] = (tmp_path / "clip.mp4").read_bytes()
        camera = open_camera(f"{server.url}/clip.mp4", CameraOptions(timeout_s=0.4, reconnect_s=5.0))
        frames = list(camera.frames())
    assert len(frames) == 20 and camera.said[0].endswith("s ended") and len(camera.said) == 1


def test_frames_of_another_size_end_a_stream(tmp_path: Path) -> None:
    small, large = blobs(4, 64, 48), blobs(2, 96, 64)
    stream = b"".join(cv2.imencode(".jpg", i)[1].tobytes() for i in (*small, *large))
    with file_server() as server:
        server.files["/live.mjpeg"] = stream
        camera = open_camera(f"{server.url}/live.mjpeg", FAST)
        assert len(list(camera.frames())) == 4
    assert "frames changed from 64x48 to 96x64: another lens needs another run" in camera.said[-1]


# -- devices -------------------------------------------------------------------------------------------------


class _Plugged:
    """What OpenCV gives for a camera that is unplugged after five pictures."""

    def __init__(self, device: int | str) -> None:
        self.left = 5

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, Array | None]:
        self.left -= 1
        return (True, np.full((6, 8, 3), (1, 2, 3), np.uint8)) if self.left >= 0 else (False, None)

    def set(self, what: int, value: float) -> bool:
        return True

    def release(self) -> None:
        pass


def test_a_camera_that_is_unplugged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", _Plugged)
    camera = open_camera("0", FAST)
    frames = list(camera.frames())
    assert camera.size == (8, 6) and len(frames) == 4  # the first was taken to see whether there is one
    assert frames[0].image[0, 0].tolist() == [3, 2, 1] and frames[0].timestamp_s == 0.0
    assert camera.said == ["camera 0: it gives no more pictures"]


def test_a_camera_that_is_not_there(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        closed = server.getsockname()[1]
    for what in ("77", "/dev/video77", f"http://127.0.0.1:{closed}/x.ts", "nothing_of_the_kind", "9" * 200):
        with pytest.raises(InputError, match="expected") as caught:
            open_camera(what, FAST)
        assert "\n" not in str(caught.value)
    with file_server() as server:
        server.files["/page"] = b"<html>a page, no stream</html>"
        with pytest.raises(InputError, match="expected a stream of pictures"):
            open_camera(f"{server.url}/page", FAST)


@pytest.mark.parametrize(
    ("what", "options", "says"),
    [
        ("-", CameraOptions(topic="/x"), "--topic"),
        ("0", CameraOptions(size=(4, 4)), "--size"),
        ("rtsp://x", CameraOptions(pace_fps=3.0), "--pace"),
        ("clip.mp4", CameraOptions(reconnect_s=3.0), "--reconnect"),
    ],
)
def test_an_option_of_another_camera_is_refused(what: str, options: CameraOptions, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        open_camera(what, options)


@pytest.mark.parametrize("name", ["fps", "pace_fps", "timeout_s", "reconnect_s"])
def test_numbers_of_a_camera_have_a_range(name: str) -> None:
    for value in (float("nan"), float("inf"), -1.0, 1e300, *([] if name == "reconnect_s" else [0.0])):
        with pytest.raises(ConfigError, match=f"--{WORDS.get(name, name)}: expected"):
            CameraOptions(**{name: value})


# -- what is played ------------------------------------------------------------------------------------------


def test_a_folder_is_played_at_its_pace(tmp_path: Path) -> None:
    for n, image in enumerate(blobs(5)):
        cv2.imwrite(str(tmp_path / f"{n}.png"), image)
    (tmp_path / "rgb.txt").write_text("".join(f"{0.1 * n + 7:.6f} {n}.png\n" for n in range(5)))
    window = SourceConfig(end=4)
    own = list(open_camera(tmp_path, CameraOptions(), window).frames())
    fast = list(open_camera(tmp_path, CameraOptions(pace_fps=40.0), window).frames())
    for frames, gap_s in ((own, 0.1), (fast, 0.025)):
        assert [f.timestamp_s for f in frames] == [7.0, 7.1, 7.2, 7.3]
        gaps = np.diff([f.arrived_s for f in frames])
        assert frames[-1].arrived_s - frames[0].arrived_s >= 3 * gap_s - 1e-3 and gaps.min() >= 0
    assert np.array_equal(own[2].image, fast[2].image)


def test_a_clock_that_jumps_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("mastd3r.sources.paced.time.sleep", slept.append)
    monkeypatch.setattr("mastd3r.sources.paced.time.perf_counter", lambda: 100 + sum(slept))
    image = blobs(1)[0]
    frames = list(paced(iter([(0.0, image), (1.0, image), (2e9, image), (2e9 + 0.5, image)])))
    assert slept == [1.0, 5.0, 0.5] and [f.timestamp_s for f in frames] == [0.0, 1.0, 2e9, 2e9 + 0.5]
