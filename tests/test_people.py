"""The network that finds people, and when it is asked."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.nn import functional

from helpers import data_path
from mastd3r.config import Config
from mastd3r.dynamics.config import DynamicsConfig, RefinementConfig, SemanticConfig
from mastd3r.dynamics.fusion import shown_mask
from mastd3r.dynamics.people import AGAIN_S, PeoplePrior, without_still
from mastd3r.dynamics.refinement import EdgeRefinement
from mastd3r.errors import InputError
from mastd3r.networks import people_kernels
from mastd3r.networks.people import WEIGHTS, PeopleNetwork
from mastd3r.parts import build_parts, parts_of
from mastd3r.slam import Slam
from mastd3r.tracking.memory import remember
from mastd3r.types import Frame
from test_dynamics_filter import frame, input_of
from test_parts import Clip

Array = NDArray[Any]
# every 16th pixel from (8, 8) of what TensorFlow Lite (ai-edge-litert 2.3) makes of ``figure()`` with the model that
# the weights are from, in thousandths
REFERENCE = """
0 0 0 250 9 0 0 0 0 0 0 0 224 0 0 0
0 0 6 33 1 0 0 0 0 0 0 1 284 0 0 0
0 0 0 0 0 0 0 1000 1000 0 0 0 0 0 0 0
325 406 316 287 0 0 1000 1000 1000 1000 300 0 0 0 0 0
0 0 292 263 0 0 1000 1000 1000 1000 0 0 0 0 0 0
333 338 438 300 287 284 1000 1000 1000 1000 0 0 0 0 0 0
5 394 345 33 357 350 1000 1000 1000 1000 0 0 0 0 0 0
242 422 311 431 331 322 442 1000 1000 0 0 0 0 0 0 0
774 724 1000 559 531 454 1000 1000 1000 1000 75 0 0 0 0 271
1000 1000 1000 648 986 1000 1000 1000 1000 1000 1000 1000 0 0 289 278
1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 557 0 337 155
1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 0 0 282
1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 473 337 626
1000 1000 982 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 644 1000
1000 1000 787 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000
1000 1000 759 1000 1000 1000 1000 1000 1000 1000 1000 1000 1000 684 1000 1000
"""


@pytest.fixture(scope="module")
def network() -> PeopleNetwork:
    return PeopleNetwork()


def figure() -> Array:
    """A head and shoulders, drawn by numbers, (256, 256, 3)."""
    y, x = np.mgrid[0:256, 0:256].astype(np.float32)
    red, green = 90 + 60 * np.sin(x / 17) + 30 * np.cos(y / 9), 100 + 50 * np.cos(x / 23 + y / 31)
    image = np.stack([red, green, 110 + 40 * np.sin((x + y) / 13)], 2)

    def inside(centre: tuple[float, float], half: tuple[float, float]) -> Array:
        found: Array = ((x - centre[0]) / half[0]) ** 2 + ((y - centre[1]) / half[1]) ** 2 < 1
        return found

    head = inside((128, 80), (34, 44))
    image[inside((128, 250), (95, 125))] = (40, 50, 120)
    image[head] = (215, 170, 140)
    image[head & (y < 62)] = (60, 40, 25)
    for eye in (114, 142):
        image[inside((eye, 76), (6, 4))] = (250, 250, 250)
        image[(x - eye) ** 2 + (y - 76) ** 2 < 8] = (30, 20, 20)
    image[inside((128, 104), (14, 4))] = (170, 60, 70)
    return np.clip(image, 0, 255).astype(np.uint8)


# -- the network -------------------------------------------------------------------------------------------------


def test_the_network_answers_as_the_reference(network: PeopleNetwork) -> None:
    expected = np.array([row.split() for row in REFERENCE.split("\n") if row], float) / 1000
    network.square(np.zeros((90, 90, 3), np.uint8))  # what is kept of a pass is not seen in the next
    found = network.square(figure())
    assert found.shape == (256, 256) and found.dtype == np.float32
    np.testing.assert_allclose(found[8::16, 8::16], expected, atol=2e-3)


def test_a_wide_and_a_tall_image_keep_their_proportions(network: PeopleNetwork) -> None:
    plain = np.full((256, 384, 3), 128, np.uint8)
    plain[:, 128:] = figure()
    wide = network(plain)
    assert wide.shape == (256, 384)
    alone = network.square(figure())
    np.testing.assert_allclose(wide[:, 256:], alone[:, 128:], atol=1e-6)  # one square sees the figure whole, alone
    assert wide[128:, 200:300].mean() > 0.5 > wide[:, :64].mean()
    tall = network(np.concatenate([figure()[:128], figure()]))
    assert tall.shape == (384, 256)
    assert network(figure()).shape == (256, 256)
    assert network(np.zeros((30, 240, 3), np.uint8)).shape == (256, 2048)
    assert not network(np.zeros((2, 3000, 3), np.uint8)).any()


def nchw(image: Array) -> torch.Tensor:
    return torch.from_numpy(image).double().permute(2, 0, 1)[None]


def hwc(tensor: torch.Tensor) -> Array:
    found: Array = tensor[0].permute(1, 2, 0).numpy()
    return found


@pytest.mark.parametrize("activation", [people_kernels.LINEAR, people_kernels.RELU, people_kernels.HARD_SWISH])
def test_pointwise_is_a_convolution(activation: int) -> None:
    rng = np.random.default_rng(activation)
    x, w, b = (rng.normal(size=s).astype(np.float32) for s in ((6, 10, 5), (5, 7), (7,)))
    plain = functional.conv2d(
        nchw(x), torch.from_numpy(w.T.copy()).double()[..., None, None], torch.from_numpy(b).double()
    )
    plain = (plain, functional.relu(plain), functional.hardswish(plain))[activation]
    np.testing.assert_allclose(
        people_kernels.pointwise(people_kernels.Kept(), x, w, b, activation), hwc(plain), rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize(("size", "stride"), [(3, 1), (3, 2), (5, 1), (5, 2)])
def test_depthwise_is_a_grouped_convolution(size: int, stride: int) -> None:
    rng = np.random.default_rng(size + stride)
    x, w, b = (rng.normal(size=s).astype(np.float32) for s in ((8, 12, 6), (size, size, 6), (6,)))
    more = size - stride  # of padding, as TensorFlow's SAME: the greater part after
    padded = functional.pad(nchw(x), (more // 2, more - more // 2, more // 2, more - more // 2))
    kernel = torch.from_numpy(w).double().permute(2, 0, 1)[:, None]
    plain = functional.conv2d(padded, kernel, torch.from_numpy(b).double(), stride=stride, groups=6)
    found = people_kernels.depthwise(people_kernels.Kept(), x, w, b, stride, people_kernels.LINEAR)
    np.testing.assert_allclose(found, hwc(plain), rtol=1e-5, atol=1e-5)


def test_patches_are_what_a_strided_kernel_sees() -> None:
    rng = np.random.default_rng(1)
    x, w = rng.normal(size=(8, 6, 3)).astype(np.float32), rng.normal(size=(4, 3, 3, 3)).astype(np.float32)
    kernel = torch.from_numpy(w).double().permute(0, 3, 1, 2)
    plain = functional.conv2d(functional.pad(nchw(x), (0, 1, 0, 1)), kernel, stride=2)
    np.testing.assert_allclose(
        people_kernels.patches(people_kernels.Kept(), x) @ w.reshape(4, 27).T, hwc(plain), rtol=1e-5, atol=1e-5
    )


def test_twice_and_shuffled_are_those_of_torch() -> None:
    rng = np.random.default_rng(2)
    x, w, b = (rng.normal(size=s).astype(np.float32) for s in ((5, 7, 4), (4, 4), (1,)))
    larger = functional.interpolate(nchw(x), scale_factor=2, mode="bilinear", align_corners=False)
    np.testing.assert_allclose(people_kernels.twice(people_kernels.Kept(), x), hwc(larger), rtol=1e-5, atol=1e-5)
    kernel = torch.from_numpy(w).double().reshape(4, 1, 2, 2)
    plain = functional.conv_transpose2d(nchw(x), kernel, torch.from_numpy(b).double(), stride=2)
    np.testing.assert_allclose(people_kernels.shuffled(x, w, b), hwc(plain)[..., 0], rtol=1e-5, atol=1e-5)


def test_weights_of_other_content_are_named(tmp_path: Path) -> None:
    file = tmp_path / "people.npy"
    with pytest.raises(InputError, match=r"people\.npy: expected the weights that come with the package, got No such"):
        PeopleNetwork(file)
    shutil.copy(WEIGHTS, file)
    damaged = bytearray(file.read_bytes())
    damaged[5000] ^= 1
    file.write_bytes(damaged)
    with pytest.raises(InputError, match="got a file of other content"):
        PeopleNetwork(file)


# -- when it is asked, and what its answer counts ----------------------------------------------------------------


class Counting:
    """A network that sees somebody from a number of its calls on, and is asked by colour."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def __call__(self, image: Array) -> Array:
        number = int(image[0, 0, 0])
        if self.asked[-1:] != [number]:  # once a second in all four turns
            self.asked.append(number)
        return np.full((4, 4), 0.95 if image[0, 0, 1] else 0.0, np.float32)


def clip(seen: str, fps: float = 20.0) -> Iterator[Frame]:
    """A frame a letter; somebody is in those of x."""
    for n, letter in enumerate(seen):
        image = np.zeros((8, 8, 3), np.uint8)
        image[..., 0], image[..., 1] = n, letter == "x"
        yield Frame(n, n / fps, image)


def test_it_looks_at_every_frame_while_somebody_is_there_and_four_a_second_else() -> None:
    network = Counting()
    prior = PeoplePrior(network, "")
    filled = [prior.fill(f).semantic is not None for f in clip("..........xxx............")]
    assert network.asked == [0, 5, 10, 11, 12, 13, 18, 23]
    assert [n for n, f in enumerate(filled) if f] == [10, 11, 12]
    assert pytest.approx(5 / 20) == AGAIN_S


def test_slow_frames_are_all_looked_at() -> None:
    network = Counting()
    prior = PeoplePrior(network, "")
    for one in clip("....x...", fps=1.5):
        prior.fill(one)
    assert network.asked == list(range(8))


@pytest.mark.parametrize("stopped", [1, 5, 9, 11, 14, 20])
def test_it_looks_at_the_same_frames_after_a_stop(stopped: int) -> None:
    whole, first, rest = Counting(), Counting(), Counting()
    frames = list(clip(".....xx.......x.........."))
    a, b, c = (PeoplePrior(n, "") for n in (whole, first, rest))
    for one in frames:
        a.fill(one)
    for one in frames[: stopped + 1]:  # one frame was looked at before its turn
        b.fill(one)
    c.remember(b.memory())
    for one in frames[stopped:]:
        c.fill(one)
    assert sorted({*first.asked, *rest.asked}) == whole.asked
    again = Counting()
    d = PeoplePrior(again, "")
    maps = []
    for _ in range(2):  # the smoothing pass reads the video once more
        maps.append([d.fill(one).semantic is not None for one in frames])
        d.fill(frames[stopped])  # a lost frame is looked for after the last one
        d.forget()
    assert maps[0] == maps[1]
    somebody = [n for n, there in enumerate(maps[0]) if there]  # of the others it is known that they show nobody
    assert [n for n in again.asked if n != stopped] == [n for n in whole.asked + somebody if n != stopped]


@pytest.mark.parametrize("quarter", range(4))
def test_the_second_pass_finds_what_it_would_without_the_first(quarter: int) -> None:
    upright = somebody(24, 36)
    images = [np.ascontiguousarray(np.rot90(i, -quarter)) for i in (np.zeros_like(upright), upright)]
    frames = [Frame(n, n / 10, images[15 < n < 60]) for n in range(100)]
    both, alone = PeoplePrior(network := Standing(), ""), PeoplePrior(Standing(), "")
    for one in frames:
        both.fill(one)
    asked = network.asked
    both.forget()
    alone.remember(((), (quarter, ())))
    for one in frames:
        a, b = both.fill(one).semantic, alone.fill(one).semantic
        assert (a is None) == (b is None)
        np.testing.assert_array_equal(a, b)
    assert (network.asked - asked < 0.7 * asked) == (quarter == 0)  # which way up was known from the beginning


class Standing:
    """A network that is sure of whoever stands: brightest at the top. Others it shows vaguely, and nobody in black."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self, image: Array) -> Array:
        self.asked += 1
        level = image[..., 0].astype(np.float32)
        there = level[:, level.any(0)]
        stands = there.size > 0 and there[0].min() > there[-1].max() + 100 and there[0].std() < 1
        return np.where(level > 0, np.float32(0.97 if stands else 0.6), np.float32(0))


def somebody(height: int, width: int) -> Array:
    """Brightest at the top, in the left of the image (height, width, 3)."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 3] = np.linspace(250, 10, height).astype(np.uint8)[:, None, None]
    return image


@pytest.mark.parametrize("quarter", range(4))
def test_people_are_found_in_pictures_that_lie_on_their_side(quarter: int, caplog: pytest.LogCaptureFixture) -> None:
    network = Standing()
    prior, upright = PeoplePrior(network, ""), somebody(24, 36)
    image = np.ascontiguousarray(np.rot90(upright, -quarter))
    with caplog.at_level("INFO"):
        filled = [prior.fill(Frame(n, n / 10, image)).semantic for n in range(60)]
    assert ("turned by" in caplog.text) == (quarter > 0)
    known = filled[24:]
    assert all(f is not None and f.shape == image.shape[:2] for f in known)
    np.testing.assert_array_equal(known[-1] > 0.9, image[..., 0] > 0)
    assert min(f.max() for f in known if f is not None) > 0.9
    assert network.asked <= 60 + 3 * 20  # all four turns are asked for at a few frames only
    other = PeoplePrior(Standing(), "")
    other.remember(prior.memory())
    later = other.fill(Frame(60, 6.0, image)).semantic
    np.testing.assert_array_equal(later, filled[-1])
    prior.forget()  # the second pass begins with what the first has found
    np.testing.assert_array_equal(prior.fill(Frame(0, 0.0, image)).semantic, filled[-1])


def test_what_is_vague_only_is_nobody_unless_somebody_was_seen() -> None:
    vague = np.zeros((8, 8), np.float32)
    vague[:4] = 0.6
    prior = PeoplePrior(lambda image: vague if image[0, 0, 0] else np.full((8, 8), 0.99, np.float32), "")
    dim, clear = np.full((8, 8, 3), 9, np.uint8), np.zeros((8, 8, 3), np.uint8)
    assert all(prior.fill(Frame(n, n / 4, dim)).semantic is None for n in range(8))
    assert all(prior.fill(Frame(n, n / 4, clear)).semantic is not None for n in range(8, 16))
    assert prior.fill(Frame(16, 4.0, dim)).semantic is not None  # somebody was, a moment before


def test_a_map_of_people_says_nothing_where_it_shows_nobody() -> None:
    config = DynamicsConfig(semantic=SemanticConfig(shows_all=False))
    some = np.zeros((48, 64), np.float32)
    some[:, 32:] = 1
    found = EdgeRefinement(config, 64, 48).semantic_log_odds(some)
    nothing = EdgeRefinement(config, 64, 48).semantic_log_odds(None)
    np.testing.assert_allclose(found[:, :32], nothing[:, :32], rtol=1e-5)
    np.testing.assert_allclose(
        found[:, 32:], np.log(config.semantic.most_partial / (1 - config.semantic.most_partial)), rtol=1e-5
    )
    assert config.semantic.share_beside(some) == 1.0
    assert DynamicsConfig().semantic.share_beside(some) == DynamicsConfig().semantic.evidence_share
    assert DynamicsConfig().semantic.share_beside(None) == 1.0


def test_the_model_is_told_that_people_are_not_all_that_moves() -> None:
    parts = build_parts(Config(pointmaps="geometric", semantics="people", features="orb"), Clip())
    assert parts.notes[0] == "semantics: people" and "MediaPipe" in parts.notes[-1]
    assert not parts.dynamics.filter(64, 48).config.semantic.shows_all  # type: ignore[attr-defined]
    plain = parts_of(parts.provider, Config(features="orb"))
    assert plain.dynamics.filter(64, 48).config.semantic.shows_all  # type: ignore[attr-defined]


def test_a_figure_that_stands_is_in_no_mask_and_one_that_stirs_is() -> None:
    """What the mask shows, not the map alone: half of the figure has no texture to be seen by."""
    config = DynamicsConfig(semantic=SemanticConfig(shows_all=False), refinement=RefinementConfig(enabled=False))
    given = input_of(0, *frame(0, 3.0)[:2])
    height, width = given.gray.shape
    shown, evidence = np.zeros((height, width), np.float32), np.zeros((height // 2, width // 2), np.float32)
    figure_at, bare = np.s_[60:180, 80:200], np.s_[70:110, 90:190]
    shown[figure_at] = 1
    evidence[60:90, 40:100] = -3
    refinement = EdgeRefinement(config, width, height)
    standing = shown_mask(refinement, evidence, replace(given, semantic=shown), None, {}).probability
    evidence[80:84, 40:100] = 3
    stirring = shown_mask(refinement, evidence, replace(given, semantic=shown), None, {}).probability
    assert standing[bare].max() < 0.2 and stirring[bare].min() > 0.7


def test_where_it_looked_is_part_of_what_tracking_remembers() -> None:
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    config = Config(semantics="people", mapping=replace(Config().mapping, enabled=False))
    first, second = (Slam(config, (160, 120)) for _ in range(2))
    first.track(image, 0.5)
    kept = first.memory()
    assert kept.semantics[0] == ((0.5, False),) and [t for t, _, _ in kept.semantics[1][1]] == [0.5]
    remember(kept, second.keyframes, second.masks, second.parts)
    assert second.parts.semantics.memory() == kept.semantics  # type: ignore[attr-defined]


# -- real photographs --------------------------------------------------------------------------------------------


def test_a_person_in_a_kitchen_is_found(network: PeopleNetwork) -> None:
    folder, intersection, union = data_path("kitchen_walk_close"), 0, 0
    for file in sorted((folder / "mask").iterdir())[::20]:
        moving = cv2.imread(str(file), 0) > 127
        image = cv2.cvtColor(cv2.imread(str(next((folder / "rgb").glob(f"{file.stem}.*")))), cv2.COLOR_BGR2RGB)
        found = cv2.resize(network(image), moving.shape[::-1]) > 0.5
        intersection += int((found & moving).sum())
        union += int((found | moving).sum())
    assert intersection / union > 0.8


def test_a_person_in_a_kitchen_is_found_on_the_side_too(network: PeopleNetwork) -> None:
    """Images of a camera that was turned by 90 degrees: the mask is as good as of those that stand."""
    folder, prior, counts = data_path("kitchen_walk_close"), PeoplePrior(network, ""), np.zeros(2, int)
    for n, file in enumerate(sorted((folder / "mask").iterdir())[::10]):
        moving = np.rot90(cv2.imread(str(file), 0) > 127)
        image = cv2.cvtColor(cv2.imread(str(next((folder / "rgb").glob(f"{file.stem}.*")))), cv2.COLOR_BGR2RGB)
        found = prior.fill(Frame(n, n / 3, np.ascontiguousarray(np.rot90(image)))).semantic
        shown = np.zeros(moving.shape, bool) if found is None else cv2.resize(found, moving.shape[::-1]) > 0.5
        if n >= 10:
            counts += int((shown & moving).sum()), int((shown | moving).sum())
    assert counts[0] / counts[1] > 0.75


def test_what_stands_still_as_a_whole_is_nobody() -> None:
    shown, evidence = np.zeros((48, 64), np.float32), np.zeros((24, 32), np.float32)
    shown[10:40, 8:20] = shown[10:40, 40:52] = 0.9  # two figures, and what is seen of them
    evidence[5:20, 4:10] = evidence[5:20, 20:26] = -3
    np.testing.assert_array_equal(without_still(shown, evidence)[:, 4:56], 0)
    evidence[8:11, 21:24] = 3  # one of them stirs
    found = without_still(shown, evidence)
    assert not found[:, :30].any() and (found[:, 30:] == shown[:, 30:]).all()
    np.testing.assert_array_equal(without_still(shown, np.zeros((24, 32), np.float32)), shown)
