"""Photograph to network image and back: against PIL's own steps, and by finding a spot where the mapping says it is."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from mastd3r.errors import InputError
from mastd3r.networks.preprocess import prepare_image


def photograph(width: int, height: int) -> np.ndarray:
    return np.random.RandomState(0).randint(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    ("full", "net"),
    [
        ((640, 480), (512, 384)), ((480, 640), (384, 512)), ((1242, 375), (512, 144)), ((1920, 1080), (512, 288)),
        ((300, 201), (512, 336)), ((500, 500), (512, 384)), ((1023, 767), (512, 384)), ((700, 1000), (352, 512)),
    ],
)  # fmt: skip
def test_image_is_resized_and_cropped_as_the_network_was_trained(full: tuple[int, int], net: tuple[int, int]) -> None:
    """Twin: the four steps on a PIL image, with the centre and half sizes of the published recipe."""
    image = photograph(*full)
    values, mapping = prepare_image(image)
    how = Image.Resampling.LANCZOS if max(full) > 512 else Image.Resampling.BICUBIC
    resized = Image.fromarray(image).resize(tuple(round(s * 512 / max(full)) for s in full), how)
    cx, cy = resized.size[0] // 2, resized.size[1] // 2
    half_w, half_h = 2 * cx // 16 * 8, 2 * cy // 16 * 8
    if resized.size[0] == resized.size[1]:
        half_h = 3 * half_w // 4
    twin = np.asarray(resized.crop((cx - half_w, cy - half_h, cx + half_w, cy + half_h)), np.float32)
    np.testing.assert_allclose(values.transpose(1, 2, 0), twin / 127.5 - 1, atol=1e-6)
    assert mapping.net_size == net == (values.shape[2], values.shape[1])


@pytest.mark.parametrize("full", [(640, 480), (480, 641), (1242, 375), (300, 201), (500, 500)])
def test_pixels_find_their_way_to_the_network_and_back(full: tuple[int, int]) -> None:
    """A smooth spot at a full pixel is found at the mapped net pixel; the way back is exact."""
    y, x = np.mgrid[0 : full[1], 0 : full[0]]
    for share in ((0.3, 0.4), (0.7, 0.55)):
        centre = np.array([share[0] * full[0], share[1] * full[1]])
        spot = 255 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * (full[0] / 60) ** 2))
        values, mapping = prepare_image(np.repeat(np.rint(spot)[..., None], 3, 2).astype(np.uint8))
        light = (values[0] + 1) * (values[0] > -0.9)
        rows, cols = np.mgrid[0 : values.shape[1], 0 : values.shape[2]]
        found = np.array([(light * cols).sum(), (light * rows).sum()]) / light.sum()
        np.testing.assert_allclose(found, mapping.net_from_full(centre), atol=0.05)
        np.testing.assert_allclose(mapping.full_from_net(mapping.net_from_full(centre)), centre, atol=1e-9)


def test_images_of_the_training_size_are_left_as_they_are() -> None:
    image = photograph(512, 384)
    values, mapping = prepare_image(image)
    np.testing.assert_allclose(values, image.transpose(2, 0, 1) / 127.5 - 1, atol=1e-6)
    assert prepare_image(photograph(512, 512), square_ok=True)[1].net_size == (512, 512)
    np.testing.assert_array_equal(mapping.net_from_full(np.array([[0, 0], [511, 383]])), [[0, 0], [511, 383]])


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((10, 10), np.uint8), "expected (height, width, 3) uint8, got (10, 10) uint8"),
        (np.zeros((10, 10, 3), np.float32), "got (10, 10, 3) float32"),
        (np.zeros((10, 0, 3), np.uint8), "expected pixels, got 0x10"),
        (
            np.zeros((10, 1000, 3), np.uint8),
            "at least 16 px a side once the long side is 512 px, got 512x5 from 1000x10",
        ),
    ],
)
def test_images_that_the_network_cannot_see_are_refused(image: np.ndarray, words: str) -> None:
    with pytest.raises(InputError) as caught:
        prepare_image(image)
    assert words in str(caught.value) and "\n" not in str(caught.value)
