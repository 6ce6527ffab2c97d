"""Video files: true times, upright pictures, broken and cut files."""

from __future__ import annotations

from pathlib import Path

import av.error
import numpy as np
import pytest

from helpers import blobs, data_path, patch_display_matrix, write_video
from mastd3r.config import SourceConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.sources import open_source
from mastd3r.sources.image_files import read_rgb
from mastd3r.sources.turns import UPRIGHT, turn_of, turned

ALL = SourceConfig()
UNEVEN_MS = [100 + 33 * i + 11 * (i % 3) + (400 if i > 20 else 0) for i in range(40)]


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a.astype(float) - b).mean())


def test_uneven_times_come_back_and_pictures_are_in_order(tmp_path: Path) -> None:
    images = blobs(40)
    source = open_source(write_video(tmp_path / "a.mp4", images, UNEVEN_MS), ALL)
    frames = list(source.frames())
    assert source.kind == "video" and source.size == (64, 48) and source.length == 40
    assert source.notes == [] and source.truth() is None
    np.testing.assert_allclose([1000 * f.timestamp_s for f in frames], UNEVEN_MS, atol=0.51)
    for i, f in enumerate(frames):
        assert f.index == i and f.image.dtype == np.uint8
        assert np.argmin([difference(f.image, image) for image in images]) == i


def test_frames_may_be_read_again_and_in_part(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(40), UNEVEN_MS)
    whole = list(open_source(path, ALL).frames())
    source = open_source(path, SourceConfig(start=7, end=31, stride=5))
    assert source.length == 5
    for _ in range(2):
        part = list(source.frames())
        assert [f.index for f in part] == [7, 12, 17, 22, 27]
        assert all(f.timestamp_s == whole[f.index].timestamp_s for f in part)
        assert all((f.image == whole[f.index].image).all() for f in part)
    assert source.notes == []


@pytest.mark.parametrize(
    ("window", "error"),
    [
        (SourceConfig(start=40), InputError),
        (SourceConfig(start=-1), ConfigError),
        (SourceConfig(start=5, end=5), ConfigError),
        (SourceConfig(stride=0), ConfigError),
    ],
)
def test_windows_that_hold_no_frame(tmp_path: Path, window: SourceConfig, error: type[Exception]) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(40))
    with pytest.raises(error):
        open_source(path, window)


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((0, 1, -1, 0), lambda a: np.rot90(a, -1)),  # what a phone held upright writes
        ((0, -1, 1, 0), lambda a: np.rot90(a, 1)),
        ((-1, 0, 0, -1), lambda a: np.rot90(a, 2)),
        ((-1, 0, 0, 1), lambda a: a[:, ::-1]),  # mirrored front camera
    ],
)
def test_rotation_metadata_is_honoured(tmp_path: Path, matrix: tuple[int, ...], shown: object) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(3))
    as_stored = [f.image for f in open_source(path, ALL).frames()]
    patch_display_matrix(path, matrix)
    source = open_source(path, ALL)
    for stored, f in zip(as_stored, source.frames(), strict=True):
        np.testing.assert_array_equal(f.image, shown(stored))  # type: ignore[operator]
        assert (f.image.shape[1], f.image.shape[0]) == source.size
    assert any("upright" in n for n in source.notes)


def test_turn_of_a_display_matrix() -> None:
    def matrix(a: float, b: float, c: float, d: float) -> bytes:
        fixed = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 14]) * 65536
        return np.rint(fixed).astype(np.int32).tobytes()

    assert turn_of(matrix(1, 0, 0, 1)) == UPRIGHT
    assert turn_of(matrix(0.99, 0.1, -0.1, 0.99)) == UPRIGHT
    image = np.arange(2 * 3 * 3).reshape(2, 3, 3)
    for a, b, c, d in ((0, 1, -1, 0), (0, -1, 1, 0), (0, 1, 1, 0), (0, -1, -1, 0), (1, 0, 0, -1)):
        out = turned(image, turn_of(matrix(a, b, c, d)))
        xs, ys = np.meshgrid(range(3), range(2))
        to_x, to_y = a * xs + c * ys, b * xs + d * ys
        np.testing.assert_array_equal(out[to_y - to_y.min(), to_x - to_x.min()], image)


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [
        ("ten_bit.mp4", "libx264", "yuv420p10le"),
        ("grey.mkv", "ffv1", "gray"),
        ("grey10.mkv", "ffv1", "gray10le"),
        ("vp9.webm", "libvpx-vp9", "yuv420p"),
    ],
)
def test_pixel_formats(tmp_path: Path, name: str, codec: str, pix_fmt: str) -> None:
    images = blobs(6)
    if "gray" in pix_fmt:
        images = [np.repeat(i.mean(-1, keepdims=True).astype(np.uint8), 3, -1) for i in images]
    path = write_video(tmp_path / name, images, codec=codec, pix_fmt=pix_fmt, codec_options={})
    frames = list(open_source(path, ALL).frames())
    assert len(frames) == 6
    for f, image in zip(frames, images, strict=True):
        assert f.image.shape == image.shape and f.image.dtype == np.uint8
        assert difference(f.image, image) < 12


def test_odd_sizes(tmp_path: Path) -> None:
    images = blobs(3, width=67, height=45)
    path = write_video(tmp_path / "odd.mkv", images, codec="ffv1", pix_fmt="yuv444p", codec_options={})
    for f, image in zip(open_source(path, ALL).frames(), images, strict=True):
        assert f.image.shape == (45, 67, 3) and difference(f.image, image) < 4


def test_pixels_that_are_not_square_are_stretched(tmp_path: Path) -> None:
    path = write_video(tmp_path / "wide.mp4", blobs(3), codec_options={"x264-params": "sar=4/3"}, pix_fmt="yuv420p")
    source = open_source(path, ALL)
    assert source.size == (85, 48)
    assert next(source.frames()).image.shape == (48, 85, 3)
    assert any("stretched" in n for n in source.notes)
    patch_display_matrix(path, (0, 1, -1, 0))
    assert open_source(path, ALL).size == (48, 85)
    path = tmp_path / "wider.y4m"
    path.write_bytes(b"YUV4MPEG2 W64 H48 F30:1 A60000:1 C420\n" + (b"FRAME\n" + b"\x80" * (64 * 48 * 3 // 2)) * 2)
    with pytest.raises(InputError, match="stretched as it asks for: expected at most 80000000 pixels"):
        open_source(path, ALL)


def test_pictures_that_ffmpeg_decodes_and_does_not_convert(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(3))
    source = open_source(path, ALL)

    def refuse(*_: object) -> None:
        raise av.error.OSError(95, "Operation not supported")

    monkeypatch.setattr("mastd3r.sources.video.turned", refuse)
    with pytest.raises(InputError, match=r"a\.mp4: expected pictures that can be shown as RGB"):
        open_source(path, ALL)
    with pytest.raises(InputError, match=r"a\.mp4: expected pictures that can be shown as RGB"):
        list(source.frames())


def test_a_video_that_has_gone_since_it_was_opened(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(3))
    source = open_source(path, ALL)
    path.unlink()
    with pytest.raises(InputError, match=r"a\.mp4: expected a video, got no such"):
        list(source.frames())


def test_an_mp4_without_its_index(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(40))
    path.write_bytes(path.read_bytes()[:8000])
    with pytest.raises(InputError, match=r"a\.mp4: expected a whole video, got .*moov"):
        open_source(path, ALL)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_video_cut_in_the_middle_gives_what_is_whole(tmp_path: Path, name: str) -> None:
    images = blobs(40)
    path = write_video(tmp_path / name, images, mux={"movflags": "faststart"} if name == "a.mp4" else None)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    source = open_source(path, ALL)
    frames = list(source.frames())
    assert 10 < len(frames) < 30 and [f.index for f in frames] == list(range(len(frames)))
    assert all(difference(f.image, images[f.index]) < 12 for f in frames)
    line = next(n for n in source.notes if "cut short" in n)
    assert f"after frame {frames[-1].index}" in line and source.length == len(frames)
    before = list(source.notes)
    assert len(list(source.frames())) == len(frames) and source.notes == before


def test_a_video_cut_before_its_first_frame(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(40), mux={"movflags": "faststart"})
    path.write_bytes(path.read_bytes()[: path.read_bytes().index(b"mdat") + 20])
    with pytest.raises(InputError, match="without a whole frame"):
        open_source(path, ALL)


def test_broken_bytes_lose_frames_up_to_the_next_key_frame_and_no_more(tmp_path: Path) -> None:
    images = blobs(40)
    path = write_video(tmp_path / "a.mp4", images)
    data = bytearray(path.read_bytes())
    at = len(data) // 3
    data[at : at + 600] = bytes(600)
    path.write_bytes(data)
    source = open_source(path, ALL)
    frames = list(source.frames())
    assert 25 <= len(frames) < 40 and frames[-1].index == 39
    assert all(difference(f.image, images[f.index]) < 12 for f in frames)
    assert any("broken at" in n for n in source.notes)


@pytest.mark.parametrize("content", [b"", b"hello world\n" * 50, bytes(range(256)) * 8])
@pytest.mark.parametrize("name", ["a.mp4", "a.txt", "a.bin"])
def test_a_file_that_is_no_video(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: expected a video"):
        open_source(path, ALL)


def test_maps_of_the_user_go_with_a_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", blobs(4))
    maps = tmp_path / "maps"
    maps.mkdir()
    np.save(maps / "00002.npy", np.full((6, 8), 0.25, np.float32))
    source = open_source(path, ALL, semantic_dir=maps)
    semantic = [f.semantic for f in source.frames()]
    assert source.has_semantic and not source.has_depth
    assert [s is None for s in semantic] == [True, True, False, True]
    assert semantic[2] is not None and semantic[2].shape == (6, 8) and (semantic[2] == 0.25).all()


def test_bedroom_as_mp4(tmp_path: Path) -> None:
    folder = data_path("bedroom")
    files = sorted((folder / "rgb").iterdir())[:20]
    images = [read_rgb(p) for p in files]
    path = write_video(tmp_path / "bedroom.mp4", images, codec_options={"preset": "ultrafast", "crf": "12"})
    frames = list(open_source(path, ALL).frames())
    assert len(frames) == 20
    assert all(difference(f.image, images[f.index]) < 6 for f in frames)


def test_the_video_is_never_held_in_memory(tmp_path: Path) -> None:
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("the system does not tell a process's memory")
    images = [np.kron(i, np.ones((15, 15, 1), np.uint8)) for i in blobs(4)] * 30  # 120 of 960x720: 240 MB
    path = write_video(tmp_path / "a.mp4", images, codec_options={"preset": "ultrafast"})
    used_mb = []
    for f in open_source(path, ALL).frames():
        if f.index in (20, 119):
            used_mb.append(int(statm.read_text().split()[1]) * 4096 / 1e6)
    assert used_mb[1] - used_mb[0] < 60
