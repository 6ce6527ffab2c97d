"""masks.mp4 and the panel of evidence terms."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from mastd3r.errors import OutputError
from mastd3r.export.evidence import EvidenceSample, panel, signed_colours
from mastd3r.export.mask_video import MaskVideo
from mastd3r.export.report import _evidence


def test_the_video_shows_what_moves_at_the_frames_own_times(tmp_path: Path) -> None:
    video = MaskVideo(tmp_path / "masks.mp4", 65, 49)
    times = [3.0, 3.05, 3.05, 3.5]  # two frames of one time are kept apart
    image = np.full((49, 65, 3), 90, np.uint8)
    moving = np.zeros((49, 65), np.float32)
    moving[:, 40:] = 1.0
    for t in times:
        video.add(t, image, moving)
    video.close()
    with av.open(str(tmp_path / "masks.mp4")) as container:
        frames = list(container.decode(video=0))
    assert [f.time for f in frames] == pytest.approx([0, 0.05, 0.05, 0.5], abs=2e-3)
    shown = frames[-1].to_ndarray(format="rgb24").astype(int)
    assert shown.shape == (48, 64, 3)
    assert (shown[:, 48:, 0] - shown[:, 48:, 2]).mean() > 60 > abs(shown[:, :30, 0] - shown[:, :30, 2]).mean()


def test_a_video_without_frames_is_no_file(tmp_path: Path) -> None:
    MaskVideo(tmp_path / "masks.mp4", 64, 48).close()
    assert not list(tmp_path.iterdir())


def test_a_video_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"masks\.mp4: expected to write"):
        video = MaskVideo(tmp_path / "nowhere" / "masks.mp4", 64, 48)
        video.add(0.0, np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32))
        video.close()


def test_the_panel_shows_every_term() -> None:
    terms = {"motion": np.full((24, 32), 4.0, np.float32), "time": np.full((24, 32), -4.0, np.float32)}
    sample = EvidenceSample(2.5, np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32), terms)
    pictures = panel(sample)
    assert len(pictures) == 3 and all(p.shape == (48, 64, 3) for _, p in pictures)
    red, blue = pictures[1][1].mean((0, 1)), pictures[2][1].mean((0, 1))
    assert red[0] > 190 and red[2] < 60 and blue[2] > 160 and blue[0] < 30
    page = _evidence(sample)
    assert page.count("<img") == 3 and "2.500 s" in page and _evidence(None) == ""
    np.testing.assert_array_equal(signed_colours(np.zeros((1, 1)))[0, 0], [216, 216, 216])
