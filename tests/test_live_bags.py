"""ROS bags: what is played is what was recorded, and whatever is damaged is a line and no crash."""

from __future__ import annotations

import bz2
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import lz4.frame
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, storage_mcap
from rosbags.rosbag2 import reader as rosbag2_reader
from rosbags.typesys import Stores, get_typestore

from helpers import blobs
from mastd3r.errors import InputError, MissingPackage
from mastd3r.sources import bag_limits
from mastd3r.sources.camera import CameraOptions, open_camera

Array = NDArray[Any]


def bag(path: Path, write: Callable[[Any, Any], None]) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        write(writer, store)
    return path


def image_message(store: Any, time_ns: int, image: Array, encoding: str) -> tuple[Any, str]:
    """An image as ROS has it, its rows padded by 5 bytes."""
    types = store.types
    head = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(time_ns, 10**9)), "camera")
    if encoding in ("png", "jpeg"):
        data = cv2.imencode(f".{encoding}", image[..., ::-1])[1].ravel()
        return types["sensor_msgs/msg/CompressedImage"](head, encoding, data), "sensor_msgs/msg/CompressedImage"
    pixels = {"rgb8": image, "bgr8": image[..., ::-1], "mono8": image[..., :1]}[encoding]
    rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, 5)))
    height, width = image.shape[:2]
    message = types["sensor_msgs/msg/Image"](head, height, width, encoding, 0, rows.shape[1], rows.ravel())
    return message, "sensor_msgs/msg/Image"


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "png"])
def test_a_bag_is_played(encoding: str, tmp_path: Path) -> None:
    images = blobs(3, 32, 24)

    def write(writer: Any, store: Any) -> None:
        kind = image_message(store, 0, images[0], encoding)[1]
        topic = writer.add_connection("/cam/image", kind, typestore=store)
        for n, image in enumerate(images):
            time_ns = 5 * 10**9 + n * 50_000_000
            message, _ = image_message(store, time_ns, image, encoding)
            writer.write(topic, time_ns, store.serialize_cdr(message, kind))

    folder = bag(tmp_path / "bag", write)
    for path in (folder, next(folder.glob("*.mcap"))):
        camera = open_camera(path, CameraOptions())
        frames = list(camera.frames())
        assert camera.size == (32, 24) and [f.timestamp_s for f in frames] == [0.0, 0.05, 0.1]
        assert frames[-1].arrived_s - frames[0].arrived_s >= 0.099
        for frame, image in zip(frames, images, strict=True):
            assert np.array_equal(frame.image, image[..., [0, 0, 0]] if encoding == "mono8" else image)


def test_a_bag_says_what_is_in_it(tmp_path: Path) -> None:
    def write(writer: Any, store: Any) -> None:
        for topic in ("/left", "/right"):
            message, kind = image_message(store, 1, blobs(1)[0], "rgb8")
            writer.write(writer.add_connection(topic, kind, typestore=store), 1, store.serialize_cdr(message, kind))

    folder = bag(tmp_path / "bag", write)
    with pytest.raises(InputError, match="got 2: /left, /right; say which with --topic"):
        open_camera(folder, CameraOptions())
    with pytest.raises(InputError, match="expected one of the image topics /left, /right, got /up"):
        open_camera(folder, CameraOptions(topic="/up"))
    assert open_camera(folder, CameraOptions(topic="/right")).size == (64, 48)
    (tmp_path / "broken.mcap").write_bytes(b"no bag at all")
    with pytest.raises(InputError, match="expected a ROS bag"):
        open_camera(tmp_path / "broken.mcap", CameraOptions())


def one_image(of: Callable[[bytes], bytes]) -> Callable[[Any, Any], None]:
    """What writes a bag of one image message, whose bytes were changed."""

    def write(writer: Any, store: Any) -> None:
        message, kind = image_message(store, 1, blobs(1)[0], "rgb8")
        topic = writer.add_connection("/a", kind, typestore=store)
        writer.write(topic, 1, of(bytes(store.serialize_cdr(message, kind))))

    return write


@pytest.mark.parametrize(
    ("of", "says"),
    [
        (lambda data: data[:60], "expected a ROS bag, got"),  # a message that is cut
        (lambda data: data + b"\0" * 8, "expected a ROS bag, got"),  # one that is too long
        (lambda data: data.replace(b"rgb8", b"abc8"), "expected an image of rgb8"),
    ],
)
def test_a_bag_with_a_damaged_message_is_one_line(of: Callable[[bytes], bytes], says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says) as caught:
        open_camera(bag(tmp_path / "bag", one_image(of)), CameraOptions())
    assert "\n" not in str(caught.value)


def test_a_bag_that_says_it_is_larger_than_memory(tmp_path: Path) -> None:
    file = next(bag(tmp_path / "bag", one_image(lambda data: data)).glob("*.mcap"))
    data = bytearray(file.read_bytes())
    data[9:17] = (2**62).to_bytes(8, "little")  # length of the first record
    file.write_bytes(data)
    with pytest.raises(InputError, match="expected a ROS bag, got"):
        open_camera(file, CameraOptions())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes there")
def test_a_bag_with_a_pipe_in_it_is_not_waited_for(tmp_path: Path) -> None:
    folder = bag(tmp_path / "bag", one_image(lambda data: data))
    file = next(folder.glob("*.mcap"))
    file.unlink()
    os.mkfifo(file)
    for path in (folder, file):
        with pytest.raises(InputError, match=r"expected .*got a named pipe|expected a file or a folder"):
            open_camera(path, CameraOptions())


ZSTD = importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
CODECS = {
    "bz2": (bz2.compress, bz2.BZ2Decompressor),
    "lz4": (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
    "zstd": (ZSTD.compress, ZSTD.ZstdDecompressor),
}


@pytest.mark.parametrize("codec", CODECS)
def test_compressed_parts_are_unpacked_up_to_a_bound(codec: str) -> None:
    compress, make = CODECS[codec]
    packed = compress(b"one" * 1000) + compress(b"two")
    assert bag_limits.unpacked(packed, make, 3003) == b"one" * 1000 + b"two"
    with pytest.raises(ValueError, match="more than 0 MiB"):
        bag_limits.unpacked(packed, make, 3002)
    with pytest.raises(ValueError, match="ends too early"):
        bag_limits.unpacked(compress(b"one" * 1000)[:-3], make, 3003)


def compressed_bag(path: Path, mode: CompressionMode, plugin: StoragePlugin, side_px: int) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        message, name = image_message(store, 0, np.zeros((side_px, side_px, 3), np.uint8), "rgb8")
        writer.write(writer.add_connection("/a", name, typestore=store), 0, bytes(store.serialize_cdr(message, name)))
    return path


@pytest.mark.parametrize(
    ("mode", "plugin"),
    [
        (CompressionMode.STORAGE, StoragePlugin.MCAP),
        (CompressionMode.MESSAGE, StoragePlugin.SQLITE3),
        (CompressionMode.FILE, StoragePlugin.SQLITE3),
    ],
)
def test_a_bag_that_unpacks_to_far_more_is_refused(
    mode: CompressionMode, plugin: StoragePlugin, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = compressed_bag(tmp_path / "bag", mode, plugin, 200)
    assert open_camera(path, CameraOptions()).size == (200, 200)
    monkeypatch.setattr(bag_limits, "MOST_FILE", 20_000)
    monkeypatch.setattr(bag_limits, "MOST_RATIO", 1)
    monkeypatch.setattr(bag_limits, "MOST", 20_000)
    with pytest.raises(InputError, match="expected a ROS bag, got a compressed"):
        open_camera(path, CameraOptions())


def test_every_codec_that_rosbags_knows_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    bag_limits.bound_rosbags()
    known = [(name, lambda data, f=f: f(data, 1001)) for name, f in storage_mcap.DECOMPRESSORS.items() if name]
    known += [(name, f) for name, f in rosbag1_reader.decompressors.items() if name in CODECS]
    assert sorted(name for name, _ in known) == ["bz2", "lz4", "lz4", "zstd"]
    monkeypatch.setattr(bag_limits, "MOST", 1000)
    for name, decompress in known:
        assert decompress(CODECS[name][0](bytes(1000))) == bytes(1000)
        with pytest.raises(ValueError, match="more than"):
            decompress(CODECS[name][0](bytes(1001)))


def test_a_rosbags_that_cannot_be_bounded_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = bag(tmp_path / "bag", one_image(lambda data: data))
    monkeypatch.delattr(rosbag2_reader, "zstd")
    with pytest.raises(MissingPackage, match=r"rosbags, 0\.11\.7 or newer"):
        open_camera(folder, CameraOptions())
