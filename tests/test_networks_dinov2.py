"""DINOv2 as transformers computes it, on small random networks of both kinds, with preprocessing written out here."""

from __future__ import annotations

import json
import shutil
import socket
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

transformers = pytest.importorskip("transformers", reason="DINOv2 needs pip install 'mastd3r-slam[networks]'")

from safetensors.torch import load_file, save_file  # noqa: E402

from helpers import blobs  # noqa: E402
from mastd3r.download.weights import folder_of  # noqa: E402
from mastd3r.download.weights_known import KNOWN  # noqa: E402
from mastd3r.errors import InputError, MissingPackage  # noqa: E402
from mastd3r.networks.dinov2 import Dinov2Features, cell_centres_px, patch_size_px  # noqa: E402

Array = NDArray[Any]

SMALL = {"hidden_size": 48, "num_hidden_layers": 3, "num_attention_heads": 3, "image_size": 98, "patch_size": 14}
REGISTERS = {"dinov2": 0, "dinov2_with_registers": 4}
MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def network(kind: str, **options: Any) -> Any:
    """A network whose every parameter matters, as none is 0 or 1."""
    torch.manual_seed(len(kind))
    if kind == "dinov2":
        model = transformers.Dinov2Model(transformers.Dinov2Config(**SMALL | options))
    else:
        registers = {"num_register_tokens": REGISTERS[kind]}
        model = transformers.Dinov2WithRegistersModel(
            transformers.Dinov2WithRegistersConfig(**SMALL | registers | options)
        )
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.2)
    return model.eval()


@pytest.fixture(scope="module", params=list(REGISTERS))
def saved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """(the network in memory, its folder on the disk)."""
    model, folder = network(request.param), tmp_path_factory.mktemp(request.param)
    model.save_pretrained(folder)
    return model, folder


def bilinear(image: Array, height: int, width: int) -> Array:
    """(h, w, 3) to (height, width, 3), from the definition: half-pixel centres, no smoothing."""

    def axis(old: int, new: int) -> tuple[Array, Array, Array]:
        at = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, None)
        low = np.minimum(at.astype(int), old - 1)
        return low, np.minimum(low + 1, old - 1), at - low

    y0, y1, fy = axis(image.shape[0], height)
    x0, x1, fx = axis(image.shape[1], width)
    rows = image[y0] * (1 - fy)[:, None, None] + image[y1] * fy[:, None, None]
    return rows[:, x0] * (1 - fx)[:, None] + rows[:, x1] * fx[:, None]


def reference(model: Any, image: Array, registers: int) -> Array:
    """Features by numpy, PIL and a plain call of transformers: (rows, cols, c)."""
    height, width = image.shape[:2]
    pixels = image / 255
    if max(height, width) > 512:
        size = (round(width * 512 / max(height, width)), round(height * 512 / max(height, width)))
        planes = [Image.fromarray(p.astype(np.float32), "F").resize(size, Image.Resampling.BILINEAR) for p in
                  pixels.transpose(2, 0, 1)]  # fmt: skip
        pixels = np.stack([np.asarray(p) for p in planes], -1)
    rows, cols = pixels.shape[0] // 14, pixels.shape[1] // 14
    ready = bilinear((pixels - MEAN) / DEVIATION, rows * 14, cols * 14)
    with torch.no_grad():
        hidden = model(pixel_values=torch.from_numpy(ready.transpose(2, 0, 1)[None]).float()).last_hidden_state
    result: Array = hidden[0, 1 + registers :].reshape(rows, cols, -1).numpy()
    return result


@pytest.mark.parametrize(("width", "height"), [(512, 384), (384, 512), (98, 98), (131, 75), (640, 360), (500, 900)])
def test_features_are_those_of_transformers(saved: tuple[Any, Path], width: int, height: int) -> None:
    model, folder = saved
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    ours = Dinov2Features(folder).one(image)
    truth = reference(model, image, REGISTERS[model.config.model_type])
    assert ours.features.dtype == np.float32 and ours.features.shape == truth.shape and ours.size == (width, height)
    assert np.abs(truth).max() > 0.3, "the reference says something"
    assert np.abs(ours.features - truth).max() <= 1e-4 * max(1.0, np.abs(truth).max())


def test_384_by_512_gives_27_by_36_patches_of_378_by_504() -> None:
    assert patch_size_px(384, 512, 14) == (378, 504) == (27 * 14, 36 * 14)
    assert patch_size_px(480, 640, 14) == (378, 504) and patch_size_px(1080, 1920, 14) == (280, 504)
    assert patch_size_px(14, 14, 14) == (14, 14)
    with pytest.raises(InputError, match="at least 14 x 14 px, got 200 x 13"):
        patch_size_px(13, 200, 14)


@pytest.mark.parametrize("kind", list(REGISTERS))
def test_a_cell_sees_the_pixels_that_its_centre_is_said_to_have(kind: str, tmp_path: Path) -> None:
    model = network(kind)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "layer_scale" in name:
                parameter.zero_()  # no attention, no MLP: a cell sees its own patch
    model.save_pretrained(tmp_path)
    features = Dinov2Features(tmp_path)
    dark = np.zeros((300, 401, 3), np.uint8)
    for x, y in [(7, 9), (205, 151), (390, 290), (388, 10)]:
        bright = dark.copy()
        bright[y - 2 : y + 3, x - 2 : x + 3] = 255
        got = features.one(bright)
        change = np.abs(got.features - features.one(dark).features).sum(-1)
        r, c = np.unravel_index(change.argmax(), change.shape)
        centre = got.centres_px()[r, c]
        assert (np.abs(centre - [x, y]) <= 0.5 * np.array([401 / 28, 300 / 21]) + 0.5).all()
        assert (change > 1e-3 * change.max()).sum() <= 4


def test_cells_divide_the_image_evenly() -> None:
    centres = cell_centres_px(27, 36, 512, 384)
    assert centres.shape == (27, 36, 2)
    assert centres[0, 0] == pytest.approx([512 / 72 - 0.5, 384 / 54 - 0.5])
    assert centres[0, 0] + centres[-1, -1] == pytest.approx([511, 383]), "the middle is the image's middle"


def test_a_batch_is_its_images_one_by_one(saved: tuple[Any, Path]) -> None:
    features = Dinov2Features(saved[1])
    images = blobs(3, 128, 96)
    together = features(images)
    for image, map_ in zip(images, together, strict=True):
        assert np.abs(map_.features - features.one(image).features).max() <= 1e-5
    pixels = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2) / 255
    assert np.abs(features.tokens(pixels).numpy() - np.stack([m.features for m in together])).max() <= 1e-6
    with pytest.raises(InputError, match="expected RGB images of one size"):
        features([images[0], images[1][:-1]])
    with pytest.raises(InputError, match="expected RGB images of one size"):
        features([images[0][..., 0]])


def test_half_precision_is_near_and_still_float32_outside(saved: tuple[Any, Path]) -> None:
    image = blobs(1, 128, 96)[0]
    exact = Dinov2Features(saved[1]).one(image).features
    half = Dinov2Features(saved[1], dtype="bfloat16").one(image).features
    assert half.dtype == np.float32
    assert 1e-6 < np.abs(half - exact).mean() < 0.1 * np.abs(exact).mean()


def test_features_that_overflow_are_refused(tmp_path: Path) -> None:
    model = network("dinov2")
    with torch.no_grad():
        model.embeddings.cls_token.fill_(float("nan"))
    model.save_pretrained(tmp_path)
    with pytest.raises(InputError, match=r"expected finite features.*use float32"):
        Dinov2Features(tmp_path, dtype=torch.float16).one(blobs(1)[0])


def test_the_net_is_never_touched(saved: tuple[Any, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def forbidden(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("the net was touched")

    for name in ("connect", "connect_ex", "sendto"):
        monkeypatch.setattr(socket.socket, name, forbidden)
    monkeypatch.setattr(socket, "getaddrinfo", forbidden)
    monkeypatch.setenv("MASTD3R_HOME", str(tmp_path))
    name = "dinov2-with-registers-small"
    with pytest.raises(InputError, match=f"run mastd3r weights download {name}, or place config.json and model"):
        Dinov2Features(name)
    folder_of(name).parent.mkdir()
    shutil.copytree(saved[1], folder_of(name))
    image = blobs(1)[0]
    expected = Dinov2Features(saved[1]).one(image).features
    for given in (name, f"facebook/{name}"):
        assert (Dinov2Features(given).one(image).features == expected).all()
    assert "torchvision" not in sys.modules


def test_weights_that_are_not_whole_are_refused(saved: tuple[Any, Path], tmp_path: Path) -> None:
    def changed(name: str) -> Path:
        folder = tmp_path / name
        shutil.copytree(saved[1], folder)
        return folder

    folder = changed("truncated")
    data = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="expected whole DINOv2 weights"):
        Dinov2Features(folder)
    folder = changed("fewer")
    tensors = load_file(folder / "model.safetensors")
    save_file({k: v for k, v in tensors.items() if k != "layernorm.weight"}, folder / "model.safetensors",
              metadata={"format": "pt"})  # fmt: skip
    with pytest.raises(InputError, match=r"1 are missing, layernorm\.weight first"):
        Dinov2Features(folder)
    folder = changed("shape")
    tensors["layernorm.weight"] = torch.zeros(3)
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match=r"layernorm\.weight|expected whole DINOv2 weights"):
        Dinov2Features(folder)
    folder = changed("pickle")
    (folder / "model.safetensors").unlink()
    torch.save(tensors, folder / "pytorch_model.bin")
    with pytest.raises(InputError, match="expected whole DINOv2 weights"):
        Dinov2Features(folder)
    folder = changed("no_config")
    (folder / "config.json").unlink()
    with pytest.raises(InputError, match=r"expected a DINOv2 folder with config\.json"):
        Dinov2Features(folder)
    folder = changed("other")
    (folder / "config.json").write_text(json.dumps({"model_type": "vit"}))
    with pytest.raises(InputError, match="expected a DINOv2 model, got vit"):
        Dinov2Features(folder)


def test_without_transformers_the_pip_line_is_said(saved: tuple[Any, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(MissingPackage, match=r"pip install 'mastd3r-slam\[networks\]'"):
        Dinov2Features(saved[1])


@pytest.mark.parametrize(("size", "channels", "layers"), [("small", 384, 12), ("base", 768, 12), ("large", 1024, 24)])
def test_released_sizes_are_those_of_the_architecture(size: str, channels: int, layers: int) -> None:
    with torch.device("meta"):
        config = transformers.Dinov2Config(
            hidden_size=channels, num_hidden_layers=layers, num_attention_heads=channels // 64, image_size=518
        )
        count = sum(p.numel() for p in transformers.Dinov2Model(config).parameters())
    released = KNOWN[f"dinov2-{size}"].origins[0].files[-1].size_bytes
    assert released is not None and 0 < released - 4 * count < 100_000, "the rest is the header"
