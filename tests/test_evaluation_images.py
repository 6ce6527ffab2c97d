"""PSNR and SSIM held to scikit-image; masks held to counting by hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from mastd3r.errors import InputError
from mastd3r.evaluation.image_error import psnr, ssim
from mastd3r.evaluation.mask_error import mask_error, read_mask


def image_pair(seed: int, h: int, w: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = cv2.GaussianBlur(rng.random((h, w, 3)), (0, 0), 2)
    return a, np.clip(a + rng.normal(0, noise, a.shape), 0, 1)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6), h=st.integers(11, 60), w=st.integers(11, 60), noise=st.floats(0.01, 0.5)
)  # fmt: skip
def test_equals_scikit_image(seed: int, h: int, w: int, noise: float) -> None:
    a, b = image_pair(seed, h, w, noise)
    assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), abs=1e-6)
    theirs = structural_similarity(
        a, b, data_range=1, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert ssim(a, b) == pytest.approx(theirs, abs=1e-6)


def test_float32_images_give_the_same() -> None:
    a, b = image_pair(0, 48, 64, 0.1)
    assert psnr(a.astype(np.float32), b.astype(np.float32)) == pytest.approx(psnr(a, b), abs=1e-4)
    assert ssim(a.astype(np.float32), b.astype(np.float32)) == pytest.approx(ssim(a, b), abs=1e-6)


def test_equal_images() -> None:
    a, _ = image_pair(0, 20, 20, 0.1)
    assert psnr(a, a) == float("inf")
    assert ssim(a, a) == pytest.approx(1)


def test_where_sees_only_its_pixels() -> None:
    a, _ = image_pair(0, 64, 64, 0)
    b = a.copy()
    b[:, 32:] = 1 - b[:, 32:]
    left = np.zeros((64, 64), bool)
    left[:, :20] = True
    assert psnr(a, b, left) == float("inf")
    assert ssim(a, b, left) == pytest.approx(1)
    everywhere = np.ones((64, 64), bool)
    assert psnr(a, b, everywhere) == psnr(a, b)
    assert ssim(a, b, everywhere) == ssim(a, b)
    assert psnr(a, b, ~everywhere) is None
    assert ssim(a, b, ~everywhere) is None


def test_shapes_that_do_not_fit_are_refused() -> None:
    a, b = image_pair(0, 20, 20, 0.1)
    with pytest.raises(InputError, match=r"\(20, 20, 3\) and \(19, 20, 3\)"):
        psnr(a, b[1:])
    with pytest.raises(InputError, match="pixels to compare"):
        ssim(a, b, np.ones((20, 19), bool))
    with pytest.raises(InputError, match="11 px or more"):
        ssim(a[:10], b[:10])


def test_mask_figures_counted_by_hand() -> None:
    truth = np.zeros((10, 10), np.uint8)
    truth[:5] = 255
    guess = np.zeros((10, 10), np.uint8)
    guess[3:6] = 200  # two rows right, one wrong, three missed
    error = mask_error([(guess, truth), (guess, None), (np.full((10, 10), 127, np.uint8), None)])
    assert error.iou == pytest.approx(20 / 60)
    assert error.false_positive_ratio == pytest.approx((0.1 + 0.3 + 0) / 3)
    assert error.called_moving_ratio == pytest.approx((0.3 + 0.3 + 0) / 3)
    assert (error.n_frames, error.n_moving) == (3, 1)


def test_less_than_one_percent_moving_does_not_count_for_iou() -> None:
    truth = np.zeros((100, 100), np.uint8)
    truth[0, :99] = 255
    assert mask_error([(truth, truth)]).iou is None
    truth[0, 99] = 255
    assert mask_error([(truth, truth)]).iou == 1.0


def test_mask_is_resized_to_the_truth() -> None:
    truth = np.zeros((40, 80), np.uint8)
    truth[:, :40] = 255
    guess = np.zeros((10, 20), np.uint8)
    guess[:, :10] = 255
    assert mask_error([(guess, truth)]).iou == 1.0


def test_no_masks_no_figures() -> None:
    error = mask_error([])
    assert (error.iou, error.false_positive_ratio, error.called_moving_ratio) == (None, None, None)


def test_unreadable_mask_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothere"):
        read_mask(tmp_path / "nothere.png")
    for content in (b"", b"not an image"):
        (tmp_path / "bad.png").write_bytes(content)
        with pytest.raises(InputError, match=rf"bad.png: .*{len(content)} bytes"):
            read_mask(tmp_path / "bad.png")
