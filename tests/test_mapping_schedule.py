"""How a training is spent: image sizes, steps or seconds, and what a quality stands for."""

from __future__ import annotations

import numpy as np
import pytest

from mastd3r.camera.pinhole import Camera
from mastd3r.config import MappingConfig, MapQualityKind
from mastd3r.mapping.quality import CPU, resolved
from mastd3r.mapping.sampling import sampled
from mastd3r.mapping.schedule import SMALLEST_PX, STEP_SHARES, Pace, levels
from mastd3r.mapping.targets import Targets, shrunk, smaller_static
from mastd3r.types import View


@pytest.mark.parametrize(("width", "shrinks"), [(96, [1]), (320, [2, 1]), (640, [4, 2, 1]), (1242, [4, 2, 1])])
def test_images_grow_to_full_size(width: int, shrinks: list[int]) -> None:
    plan = levels(width)
    assert [level.shrink for level in plan] == shrinks and plan[-1].until == 1
    assert all(width / level.shrink >= SMALLEST_PX for level in plan[:-1])
    assert plan[-1].until - (plan[-2].until if len(plan) > 1 else 0) >= STEP_SHARES[-1] - 1e-9


def test_a_pace_counts_steps_and_starts_where_it_is_told() -> None:
    pace = Pace(640, 100)
    seen = []
    for pace.steps in range(100):
        seen.append(pace.shrink)
    assert seen == [4] * 20 + [2] * 30 + [1] * 50
    assert Pace(640, 100, steps_done=50).shrink == 1
    assert Pace(640, 100, steps_done=50, seconds=1e6).done == pytest.approx(0.5, abs=0.01)
    assert Pace(640, 100, seconds=1e-9).done == 1


@pytest.mark.parametrize("quality", ["draft", "standard", "high"])
@pytest.mark.parametrize("size", [(640, 480), (1242, 375), (540, 960), (4000, 3000)])
def test_a_quality_never_enlarges_and_keeps_what_was_given(quality: MapQualityKind, size: tuple[int, int]) -> None:
    m = resolved(MappingConfig(quality=quality), size, "cpu")
    width = m.width_px
    assert 8 <= width <= size[0] and width * width * size[1] / size[0] <= CPU[quality].area_px * 1.01
    assert m.iterations and m.max_gaussians and m.sh_degree is not None
    given = resolved(
        MappingConfig(quality=quality, iterations=0, width_px=100, max_gaussians=7, sh_degree=2), size, "cpu"
    )
    assert (given.iterations, given.width_px, given.max_gaussians, given.sh_degree) == (0, 100, 7, 2)


def test_standard_trains_the_photographs_own_width_where_they_are_small() -> None:
    for size in ((640, 480), (1242, 375), (1226, 370), (540, 360)):
        assert resolved(MappingConfig(), size, "cpu").width_px == size[0]


def test_small_targets_keep_holes_and_colours() -> None:
    camera = Camera.centred(50, 64, 48)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    static = np.ones((48, 64), np.float16)
    static[:, 31:] = 0
    view = View(0.0, image, static, np.eye(4), camera, 0)
    targets = Targets(MappingConfig(loss="mask"), "cpu")
    small, weight = targets.get(0, view, 2)
    assert small.shape == (24, 32, 3) and weight.shape == (24, 32)
    assert np.allclose(small.numpy(), image.reshape(24, 2, 32, 2, 3).mean((1, 3)) / 255, atol=1 / 255)
    assert (weight.numpy()[:, 15:] == 0).all() and (weight.numpy()[:, :15] == 1).all()
    whole, _ = targets.get(0, view, 1)
    assert np.allclose(whole.numpy() * 255, image, atol=1e-3)
    assert shrunk(camera, 2).fx_px == 25 and smaller_static(static, shrunk(camera, 4))[0, 8] == 0


def test_what_views_sample_and_what_stands_in_their_way() -> None:
    camera = Camera.centred(50, 64, 48)
    back = np.eye(4)
    back[2, 3] = 1.0  # a camera one unit behind: everything is a unit farther away
    means = np.array([[0, 0, 2], [0, 0, 0.1], [0, 0, -5], [3, 0, 2]], np.float32)
    seen = sampled(means, [camera, camera], [np.eye(4), back], near=0.3)
    assert seen.pixel[:3] == pytest.approx([2 / 50, 0.1 / 50, 0])
    assert seen.blocks.tolist() == [False, True, False, False]
    assert seen.distance == pytest.approx([2, 0.1, 4, 13**0.5])


def test_exposures_go_into_the_colours_before_the_end() -> None:
    shares = [Pace(320, 100, done).exposure_share for done in (0, 75, 80, 90, 100)]
    assert shares[:2] == [1, 1] and 0 < shares[2] < 1 and shares[3:] == pytest.approx([0, 0], abs=1e-12)
