"""DINOv2 (Oquab et al. 2023) through transformers: features of an image, one vector a patch.

Weights are read from this machine only. Preprocessing is written here, without torchvision: ImageNet mean and
deviation, then a bilinear resize to whole patches. Class token and registers are dropped; the final norm is applied.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import interpolate

from ..download.weights import path as weights_path
from ..errors import InputError, MissingPackage
from ..reading.files import is_file
from .products import products
from .record import Recorder

Array = NDArray[Any]

IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MODEL_TYPES = ("dinov2", "dinov2_with_registers")
MAX_SIDE_PX = 512  # larger images are shrunk first: attention grows with the fourth power of the side


@dataclass(frozen=True)
class FeatureMap:
    """Features of one image, one vector a cell."""

    features: Array  # (rows, cols, c) float32
    size: tuple[int, int]  # (width, height) of the image that was given

    def centres_px(self) -> Array:
        """(rows, cols, 2) float64: where each cell's centre lies in the image, (x, y), pixel centres at integers."""
        rows, cols = self.features.shape[:2]
        return cell_centres_px(rows, cols, *self.size)


def cell_centres_px(rows: int, cols: int, width: int, height: int) -> Array:
    """(rows, cols, 2) centres of cells that divide an image evenly; an image spans -0.5 … w - 0.5."""
    x = (np.arange(cols) + 0.5) * width / cols - 0.5
    y = (np.arange(rows) + 0.5) * height / rows - 0.5
    return np.stack(np.meshgrid(x, y), -1)


class Dinov2Features:
    """A loaded DINOv2 of any size, with or without registers."""

    def __init__(
        self,
        path_or_id: str | Path,
        device: str = "cpu",
        dtype: str | torch.dtype = "float32",
        recorded: bool = False,
    ) -> None:
        """``path_or_id``: a folder with config.json and model.safetensors, or a name or hub id of ``weights``.

        ``recorded``: play the layers back as one launch, on CUDA.
        Raises MissingPackage (no transformers), InputError (weights that are absent, damaged or not DINOv2).
        """
        folder = weights_path(str(path_or_id))
        self.dtype = getattr(torch, dtype) if isinstance(dtype, str) else dtype
        self.device = torch.device(device)
        self.model = _load(folder).to(self.device, self.dtype)
        config = self.model.config
        self.patch_px = int(config.patch_size)
        self.channels: int = config.hidden_size
        self._hidden = self._layers
        if recorded:
            self._hidden = Recorder(self.device).recorded(self._layers)
        self.extra_tokens: int = 1 + getattr(config, "num_register_tokens", 0)

    def __call__(self, images: Sequence[Array]) -> list[FeatureMap]:
        """Features of (h, w, 3) uint8 RGB images of one size, in one batch. Raises InputError."""
        if len({i.shape for i in images}) != 1 or images[0].ndim != 3 or images[0].shape[2] != 3:
            raise InputError(f"DINOv2: expected RGB images of one size, got shapes {[i.shape for i in images]}")
        pixels = torch.from_numpy(np.stack(images)).to(self.device).permute(0, 3, 1, 2).float() / 255
        height, width = images[0].shape[:2]
        return [FeatureMap(f, (width, height)) for f in self.tokens(pixels).cpu().numpy()]

    def one(self, image: Array) -> FeatureMap:
        """Features of one (h, w, 3) uint8 RGB image."""
        return self([image])[0]

    def _layers(self, pixels: torch.Tensor) -> torch.Tensor:
        hidden: torch.Tensor = self.model(pixel_values=pixels).last_hidden_state
        return hidden

    @torch.inference_mode()
    def tokens(self, pixels: torch.Tensor) -> torch.Tensor:
        """(b, 3, h, w) float RGB in 0..1, on any device, to (b, rows, cols, c) float32 on the model's device.

        Raises InputError where the images are smaller than a patch, or the features are not finite.
        """
        ready = self.preprocess(pixels.to(self.device))
        rows, cols = ready.shape[2] // self.patch_px, ready.shape[3] // self.patch_px
        with products(self.dtype):
            hidden = self._hidden(ready.to(self.dtype))
        features = hidden[:, self.extra_tokens :].reshape(len(ready), rows, cols, -1).float()
        if not bool(torch.isfinite(features).all()):
            raise InputError(f"DINOv2 in {self.dtype}: expected finite features, got some that are not; use float32")
        return features

    def preprocess(self, pixels: torch.Tensor) -> torch.Tensor:
        """(b, 3, h, w) float RGB in 0..1 to normalised float32 of whole patches: 384 x 512 gives 378 x 504."""
        size = patch_size_px(pixels.shape[2], pixels.shape[3], self.patch_px)
        shift = torch.tensor(IMAGENET_MEAN, device=pixels.device).view(3, 1, 1)
        scale = torch.tensor(IMAGENET_DEVIATION, device=pixels.device).view(3, 1, 1)
        pixels = (pixels.float() - shift) / scale
        if max(pixels.shape[2:]) > MAX_SIDE_PX:
            shrink = MAX_SIDE_PX / max(pixels.shape[2:])
            smaller = [round(side * shrink) for side in pixels.shape[2:]]
            pixels = interpolate(pixels, smaller, mode="bilinear", align_corners=False, antialias=True)
        return interpolate(pixels, size, mode="bilinear", align_corners=False)


def patch_size_px(height: int, width: int, patch_px: int) -> tuple[int, int]:
    """(height, width) of whole patches, rounded down, long side at most MAX_SIDE_PX. Raises InputError."""
    shrink = min(1.0, MAX_SIDE_PX / max(height, width))
    rows, cols = (round(side * shrink) // patch_px for side in (height, width))
    if min(rows, cols) < 1:
        raise InputError(f"DINOv2: expected an image of at least {patch_px} x {patch_px} px, got {width} x {height}")
    return rows * patch_px, cols * patch_px


def _load(folder: Path) -> Any:
    """The model in float32 on the CPU, without a look at the net. Raises MissingPackage, InputError."""
    try:
        from safetensors import SafetensorError
        from transformers import AutoConfig, Dinov2Model, Dinov2WithRegistersModel
    except ImportError as e:
        raise MissingPackage(f"DINOv2 needs transformers ({e}): pip install 'mastd3r-slam[networks]'") from e
    if not is_file(folder / "config.json"):
        raise InputError(
            f"{folder}: expected a DINOv2 folder with config.json and model.safetensors, got no config.json"
        )
    try:
        with _quiet():
            config = AutoConfig.from_pretrained(folder, local_files_only=True)
            if config.model_type not in MODEL_TYPES:
                raise InputError(f"{folder}: expected a DINOv2 model, got {config.model_type}")
            kind = Dinov2Model if config.model_type == "dinov2" else Dinov2WithRegistersModel
            model, found = kind.from_pretrained(
                folder, config=config, local_files_only=True, use_safetensors=True, output_loading_info=True
            )
    except (OSError, ValueError, RuntimeError, KeyError, TypeError, SafetensorError) as e:
        raise InputError(f"{folder}: expected whole DINOv2 weights, got {' '.join(str(e).split())[:300]}") from e
    missing = sorted(set(found["missing_keys"]) | {str(m[0]) for m in found["mismatched_keys"]})
    if missing:
        raise InputError(f"{folder}: expected all parameters of DINOv2, {len(missing)} are missing, {missing[0]} first")
    return model.eval().requires_grad_(False)


@contextmanager
def _quiet() -> Iterator[None]:
    """transformers draws bars and reports what it loads; this program says it in its own words."""
    from transformers.utils import logging

    bars, level = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    logging.set_verbosity(logging.CRITICAL)
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
