"""Inputs that cameras and tools really leave behind: interlaced video, deep grey, broken files, masks beside frames."""

from __future__ import annotations

import logging
import os
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from helpers import Array, blobs, write_video
from mastd3r.config import SourceConfig
from mastd3r.sources import frame_is_blank, open_source
from mastd3r.sources.beside import beside_frames, without_word
from mastd3r.sources.grey_levels import WHOLE, GreyRange, range_of
from mastd3r.sources.interlacing import interlacing_of, misfits

ALL = SourceConfig()


def case_path(name: str) -> Path:
    """Folder of one real case; the test is skipped where the cases are not at hand."""
    default = Path(__file__).resolve().parents[2] / "shared" / "cases"
    folder = Path(os.environ.get("MASTD3R_CASES", default)) / name
    if not folder.is_dir():
        pytest.skip(f"the case {name} is not at hand (set MASTD3R_CASES to the folder that holds it)")
    return folder


# -- interlaced video ------------------------------------------------------------------------------------------------


def moving_texture(count: int, step_px: tuple[float, float] = (3.0, 0.4), noise: float = 0.0) -> list[Array]:
    """Grey pictures (120, 160) uint8 of a texture that slides by ``step_px`` a picture."""
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.normal(0, 1, (400, 600)).astype(np.float32), (0, 0), 1.5)
    texture = 128 + 40 * texture / texture.std()
    out = []
    for k in range(count):
        shift = np.array([[1, 0, -step_px[0] * k], [0, 1, -step_px[1] * k]], np.float32)
        seen = cv2.warpAffine(texture, shift, (160, 120), borderMode=cv2.BORDER_WRAP)
        out.append(np.clip(seen + rng.normal(0, noise, seen.shape), 0, 255).round().astype(np.uint8))
    return out


def woven(pictures: list[Array], top_first: bool = True) -> list[Array]:
    """Pictures two by two as the fields of one frame."""
    frames = []
    for first, second in zip(pictures[::2], pictures[1::2], strict=True):
        frame = first.copy()
        later = slice(1, None, 2) if top_first else slice(0, None, 2)
        frame[later] = second[later]
        frames.append(frame)
    return frames


def as_frames(pictures: list[Array]) -> list[av.VideoFrame]:
    return [av.VideoFrame.from_ndarray(p, format="gray") for p in pictures]


@pytest.mark.parametrize("noise", [0.0, 12.0])
@pytest.mark.parametrize("top_first", [True, False])
def test_the_order_of_fields_is_measured(top_first: bool, noise: float) -> None:
    found = interlacing_of(as_frames(woven(moving_texture(20, noise=noise), top_first)), 0)
    assert found is not None and found.top_first is top_first and not found.flagged


def test_progressive_video_is_left_as_it_is(tmp_path: Path) -> None:
    stripes = [np.where(np.arange(120)[:, None] % 2, 40, 215) * np.ones((1, 160)) for _ in range(12)]
    slid = moving_texture(12)
    faster = [
        moving_texture(1, (x, 0.5 * x))[0] if x == 0 else moving_texture(2, (x, 0.5 * x))[1] for x in (0, 1, 3, 6, 10)
    ]
    pictures = {
        "sliding": slid,
        "upwards, a line a picture": moving_texture(12, (0.0, 1.0)),
        "faster and faster": faster,
        "noise": [np.random.default_rng(k).integers(0, 255, (120, 160), np.uint8) for k in range(12)],
        "fine stripes over something that moves": [
            (s * 0.5 + p * 0.5).astype(np.uint8) for s, p in zip(stripes, slid, strict=True)
        ],
        "JPEG": [cv2.imdecode(cv2.imencode(".jpg", p, [cv2.IMWRITE_JPEG_QUALITY, 20])[1], 0) for p in slid],
        "one picture": [slid[0]] * 12,
        "black": [np.zeros((120, 160), np.uint8)] * 5,
    }
    for name, shown in pictures.items():
        assert interlacing_of(as_frames(shown), 0) is None, name
    path = write_video(tmp_path / "a.mp4", [np.dstack([p] * 3) for p in slid])
    source = open_source(path, ALL)
    assert not any("interlaced" in n for n in source.notes)


def test_misfits_tell_nothing_where_nothing_moves() -> None:
    picture = moving_texture(1)[0]
    assert misfits(picture, picture, picture) is None


def write_interlaced(path: Path, frames: list[Array], flag: bool = True) -> Path:
    """Frames (h, w) at 25 frames a second, marked as top field first or not marked at all."""
    options = {"x264-params": "tff=1" if flag else "", "crf": "6"}
    return write_video(
        path, [np.dstack([f] * 3) for f in frames], [40 * k for k in range(len(frames))], codec_options=options
    )


@pytest.mark.parametrize("flag", [True, False])
def test_interlaced_video_is_deinterlaced(tmp_path: Path, flag: bool) -> None:
    pictures = moving_texture(24)
    path = write_interlaced(tmp_path / "a.mp4", woven(pictures), flag)
    source = open_source(path, ALL)
    frames = list(source.frames())
    told = "interlaced, top field first: deinterlaced"
    if not flag:
        told = "interlaced, top field first (measured, the file does not say so): deinterlaced"
    assert told in source.notes and source.length == 12
    assert [f.index for f in frames] == list(range(12))
    np.testing.assert_allclose([f.timestamp_s for f in frames], 0.04 * np.arange(12), atol=1e-6)
    inner = (slice(8, -8), slice(8, -8))
    for k, f in enumerate(frames):
        whole = np.abs(f.image[..., 0].astype(float) - pictures[2 * k])[inner].mean()
        combed = np.abs(woven(pictures)[k].astype(float) - pictures[2 * k])[inner].mean()
        assert whole < 0.4 * combed, k
    part = list(open_source(path, SourceConfig(start=3, end=10, stride=3)).frames())
    assert [f.index for f in part] == [3, 6, 9]
    for f in part[:2]:
        np.testing.assert_array_equal(f.image, frames[f.index].image)
    again = list(source.frames())
    assert all((a.image == b.image).all() for a, b in zip(frames, again, strict=True))


def test_colours_of_interlaced_video_stay(tmp_path: Path) -> None:
    pictures = [np.dstack([p, 255 - p, np.full_like(p, 60)]) for p in moving_texture(16)]
    frames = [
        np.where((np.arange(120) % 2)[:, None, None], b, a) for a, b in zip(pictures[::2], pictures[1::2], strict=True)
    ]
    path = write_video(tmp_path / "a.mp4", frames, codec_options={"x264-params": "tff=1:colormatrix=bt709", "crf": "4"})
    given = list(open_source(path, ALL).frames())
    with av.open(str(path)) as container:
        as_stored = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    for f, stored in zip(given, as_stored, strict=True):
        np.testing.assert_allclose(f.image.mean((0, 1)), stored.mean((0, 1)), atol=1.5)


def test_the_interlaced_corridor() -> None:
    source = open_source(case_path("interlaced") / "inter.mp4", ALL)
    frames = list(source.frames())
    assert "interlaced, top field first: deinterlaced" in source.notes
    assert [f.index for f in frames] == list(range(24))
    np.testing.assert_allclose([f.timestamp_s for f in frames], np.arange(24) / 30, atol=1e-6)
    lumas = [cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY) for f in frames]
    assert interlacing_of(as_frames(lumas), 0) is None


# -- more than 8 bits of grey ----------------------------------------------------------------------------------------


def warm(count: int, low: int, high: int) -> list[Array]:
    """16-bit pictures between two levels, with a dead pixel."""
    out = []
    for image in blobs(count):
        levels = low + (image[..., 0].astype(float) - 17) / 220 * (high - low)
        levels[0, 0] = 65535
        out.append(levels.round().astype(np.uint16))
    return out


def test_a_range_is_that_of_the_samples_a_little_wider() -> None:
    found = range_of([np.arange(30000, 31001, dtype=np.uint16).reshape(7, 143)])
    assert found is not None and 29900 < found.low < 30000 and 31000 < found.high < 31100
    assert range_of([]) is None
    assert range_of([np.linspace(2000, 60000, 999)]) == WHOLE
    constant = range_of([np.full((5, 5), 700)])
    assert constant is not None and constant.high - constant.low == 64
    assert (GreyRange(100, 355).as_8_bit(np.array([0, 100, 101, 355, 9999])) == [0, 0, 1, 255, 255]).all()
    every = np.arange(65536)
    assert (WHOLE.as_8_bit(every) == (every + 128) // 257).all()


def test_deep_grey_is_stretched_alike_in_all_frames(tmp_path: Path) -> None:
    levels = warm(20, 29000, 30500)
    for k, image in enumerate(levels):
        Image.fromarray(image).save(tmp_path / f"{k}.png")
    source = open_source(tmp_path, ALL)
    frames = list(source.frames())
    assert any(n.startswith("16-bit grey: levels 28") for n in source.notes)
    shown: dict[int, int] = {}
    for f, image in zip(frames, levels, strict=True):
        assert not frame_is_blank(f.image)
        assert all(
            shown.setdefault(int(a), int(b)) == b for a, b in zip(image.ravel(), f.image[..., 1].ravel(), strict=True)
        )
    levels_in_order = [shown[k] for k in sorted(shown)]
    assert (np.diff(levels_in_order) >= 0).all() and levels_in_order[0] < 25 and levels_in_order[-2] > 230


@pytest.mark.parametrize(("pix_fmt", "bits"), [("gray16le", 16), ("gray10le", 10), ("gray12le", 12)])
def test_deep_grey_video(tmp_path: Path, pix_fmt: str, bits: int) -> None:
    levels = [(image >> (16 - bits)) for image in warm(8, 29000, 30500)]
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.height, stream.width = levels[0].shape
        stream.pix_fmt = pix_fmt
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for k, image in enumerate(levels):
            frame = av.VideoFrame(image.shape[1], image.shape[0], pix_fmt)
            plane = frame.planes[0]
            rows = np.zeros((image.shape[0], plane.line_size // 2), "<u2")
            rows[:, : image.shape[1]] = image
            plane.update(rows.tobytes())
            frame.pts, frame.time_base = 33 * k, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    source = open_source(path, ALL)
    frames = list(source.frames())
    assert len(frames) == 8 and any(n.startswith("16-bit grey") for n in source.notes)
    for f, image in zip(frames, levels, strict=True):
        assert f.image.shape == (48, 64, 3) and f.image.std() > 40
        ratio = np.polyfit(image[1:].ravel().astype(float), f.image[1:, :, 0].ravel().astype(float), 1)[0]
        assert ratio * 2**bits == pytest.approx(255 * 65536 / 1650, rel=0.15)


def test_the_thermal_camera() -> None:
    source = open_source(case_path("thermal_16_bit"), ALL)
    frames = list(source.frames())
    assert len(frames) == 3 and not any(frame_is_blank(f.image) for f in frames)
    assert all(f.image.std() > 30 for f in frames) and any("16-bit grey" in n for n in source.notes)


# -- broken images ---------------------------------------------------------------------------------------------------


def test_a_truncated_photograph() -> None:
    source = open_source(case_path("truncated_jpeg"), ALL)
    assert [(f.index, f.timestamp_s) for f in source.frames()] == [(0, 0.0), (2, 2 / 30)]
    assert "images that cannot be read are left out: 1 of 3, the first is f001.jpg" in source.notes


# -- masks beside the frames -----------------------------------------------------------------------------------------


def scene(folder: Path, name: str, seed: int, mode: str = "RGB") -> None:
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.integers(0, 255, (48, 64, 3), np.uint8), (0, 0), 1.2)
    Image.fromarray(image).convert(mode).save(folder / name)


def mask(folder: Path, name: str, seed: int) -> None:
    image = np.zeros((48, 64), np.uint8)
    image[10 : 20 + seed, 20:40] = 255
    Image.fromarray(image).save(folder / name)


@pytest.mark.parametrize(
    ("frame", "beside"),
    [
        ("f{:03d}.jpg", "f{:03d}_mask.png"),
        ("IMG_{}.jpg", "IMG_{}-seg.jpg"),
        ("img{}.png", "mask_img{}.png"),
        ("rgb_{:04d}.png", "label_{:04d}.png"),
        ("{:04d}.jpg", "{:04d}.png"),
        ("{:04d}.jpg", "{:04d}.jpg.png"),
        ("{}.png", "{}_m.png"),
    ],
)
@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_masks_beside_frames_are_left_out_aloud(
    tmp_path: Path, frame: str, beside: str, mode: str, caplog: pytest.LogCaptureFixture
) -> None:
    for k in range(5):
        scene(tmp_path, frame.format(k), k, mode)
        mask(tmp_path, beside.format(k), k)
    with caplog.at_level(logging.WARNING):
        source = open_source(tmp_path, ALL)
    assert source.length == 5 and [f.index for f in source.frames()] == [0, 1, 2, 3, 4]
    line = next(n for n in source.notes if "beside the frames" in n)
    assert f"left out: 5, the first is {beside.format(0)}" in line and "--maps" in line
    assert any(line in r.getMessage() for r in caplog.records)
    assert all(f.image.std() < 90 for f in source.frames())


def test_depth_beside_colour_is_no_frame(tmp_path: Path) -> None:
    for k in range(4):
        scene(tmp_path, f"{k}_rgb.png", k)
        levels = np.random.default_rng(k).integers(500, 4000, (48, 64), np.uint16)
        Image.fromarray(levels).save(tmp_path / f"{k}_depth.png")
    source = open_source(tmp_path, ALL)
    assert source.length == 4 and not any("16-bit" in n for n in source.notes)


def test_photographs_are_no_masks(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A night shot, grey beside colour, photographs with a word in their name, masks alone."""
    for name in ("alone", "words", "kinds"):
        (tmp_path / name).mkdir()
    for k in range(4):
        mask(tmp_path / "alone", f"{k}_mask.png", k)
        scene(tmp_path / "words", f"room_{k}.png", k)
        scene(tmp_path / "words", f"room_m_{k}.png", 10 + k)
        scene(tmp_path / "kinds", f"{k}.jpg", k)
        scene(tmp_path / "kinds", f"{k}.png", 10 + k)
    for name, count in (("alone", 4), ("words", 8), ("kinds", 8)):
        source = open_source(tmp_path / name, ALL)
        assert source.length == count and not any("beside" in n for n in source.notes), name
    assert beside_frames([]) == []


def test_names_without_their_word() -> None:
    names = {"f000_mask": "f000", "mask_F000": "f000", "a-b.seg": "a_b", "f000": None, "mask": None, "maskara_1": None}
    assert {name: without_word(name) for name in names} == names


def test_masks_beside_frames_can_be_used(tmp_path: Path) -> None:
    for k in range(3):
        scene(tmp_path, f"f{k}.png", k)
        mask(tmp_path, f"f{k}_mask.png", k)
    source = open_source(tmp_path, ALL, semantic_dir=tmp_path)
    for f in source.frames():
        assert f.semantic is not None and f.semantic.sum() == (10 + f.index) * 20


def test_the_folder_with_masks() -> None:
    source = open_source(case_path("masks_beside_frames"), ALL)
    assert source.length == 3 and all(len(np.unique(f.image)) > 100 for f in source.frames())
    assert any("left out: 3, the first is f000_mask.png" in n for n in source.notes)
