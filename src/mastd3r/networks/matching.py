"""Matches of a decoded pair in torch, on the device that the predictions lie on: all pixels in step, no own kernels.

The twin of ``pointmap/matching.py``, which says what is searched and why; names, order and numbers are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from .record import Recorder

Array = NDArray[Any]
_SETTLED_PX = 1e-3
_FLAT, _MOST_ALIKE = 1e-6, 1.1
PADDED_TO = 512  # pixels asked for are padded to a multiple
_ROWS_AT_ONCE = 1 << 15  # pixels in one block of the descriptor search: 49 descriptors each are gathered


class Maps(Protocol):
    """One view of a decoded pair, as tensors of one device or as arrays; both views in the first one's camera."""

    @property
    def points(self) -> Any: ...  # (h, w, 3)

    @property
    def descriptors(self) -> Any: ...  # (h, w, c), unit length

    @property
    def descriptor_confidence(self) -> Any: ...  # (h, w)


class Options(Protocol):
    """What ``pointmap.matching.MatchOptions`` holds."""

    @property
    def iterations(self) -> int: ...
    @property
    def damping(self) -> float: ...
    @property
    def converged(self) -> float: ...
    @property
    def radius(self) -> int: ...
    @property
    def dilation_max(self) -> int: ...
    @property
    def distance_ratio(self) -> float: ...
    @property
    def min_descriptor_confidence(self) -> float: ...
    @property
    def reciprocal_px(self) -> float: ...


Found = tuple[Array, Array, Array, Array]
Maps6 = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]  # points, descriptors, confidence of target, of source


@torch.inference_mode()
def match_pixels(
    target: Maps,
    source: Maps,
    px: Array,
    start_px: Array | None,
    options: Options,
    device: torch.device | str | None = None,
) -> Found:
    """Find source pixels (n, 2) in the target view, from ``start_px`` (n, 2) there or from the same pixels.

    ``device`` defaults to that of target's points. Returns numpy (px (n, 2) float64, valid (n,) bool,
    confidence (n,) float64, likeness (n,) float64), the fields of ``pointmap.matching.FoundPixels`` in order.
    Raises ValueError where px lies outside the source view.
    """
    maps = _maps(target, source, device)
    at, start = _asked(source, px, start_px, maps[0].device)
    return _found(matched(options, *maps, at, start))


class RecordedMatching:
    """``match_pixels`` whose search is recorded: some thousand short kernels, played back as one launch."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._searches: dict[Options, Callable[..., Tensor]] = {}

    @torch.inference_mode()
    def __call__(self, target: Maps, source: Maps, px: Array, start_px: Array | None, options: Options) -> Found:
        """As ``match_pixels``. The pixels are padded to whole steps, so that few shapes are recorded."""
        maps = _maps(target, source, self._recorder.device)
        at, start = _asked(source, px, start_px, self._recorder.device)
        n = len(at)
        more = -n % PADDED_TO
        if options not in self._searches:
            self._searches[options] = self._recorder.recorded(partial(matched, options))
        padded = (functional.pad(values, (0, 0, 0, more)) for values in (at, start))
        return _found(self._searches[options](*maps, *padded)[:n])


def matched(
    options: Options,
    points: Tensor,
    descriptors: Tensor,
    sure: Tensor,
    source_points: Tensor,
    source_descriptors: Tensor,
    source_sure: Tensor,
    at: Tensor,
    start: Tensor,
) -> Tensor:
    """The search on tensors alone: (n, 5) float64 x, y, valid, confidence, likeness of whole source pixels ``at``."""
    x, y = at.unbind(1)
    wanted = source_points[y, x]
    near, cost = search_rays(ray_image(points), wanted, start, options)
    found, similarity = search_descriptors(descriptors, source_descriptors[y, x], near, options)
    tx, ty = found.round().long().unbind(1)
    nx, ny = near.round().long().unbind(1)
    valid = (cost < options.converged) & (similarity > -1)
    for there in (points[ny, nx], points[ty, tx]):
        valid &= same_place(there, wanted, options.distance_ratio)
    ends = torch.stack([sure[ty, tx], source_sure[y, x]])
    confidence = torch.where(torch.isfinite(ends) & (ends > 0), ends, 0.0).sqrt().prod(0)
    valid &= confidence > options.min_descriptor_confidence
    if options.reciprocal_px > 0:
        back, _ = search_descriptors(source_descriptors, descriptors[ty, tx], at.float(), options)
        valid &= (back - at).norm(dim=1) <= options.reciprocal_px
    rest = torch.stack([valid.double(), confidence.double(), similarity.double()], 1)
    return torch.cat([found.double(), rest], 1)


def _maps(target: Maps, source: Maps, device: torch.device | str | None) -> Maps6:
    first = _tensor(target.points, device)
    rest = (target.descriptors, target.descriptor_confidence, source.points, source.descriptors)
    a, b, c, d = (_tensor(values, first.device) for values in rest)
    return first, a, b, c, d, _tensor(source.descriptor_confidence, first.device)


def _asked(source: Maps, px: Array, start_px: Array | None, device: torch.device) -> tuple[Tensor, Tensor]:
    """Whole source pixels (n, 2) int64 and starts (n, 2) float32, on the device. Raises ValueError."""
    h, w = source.points.shape[:2]
    whole = np.round(np.asarray(px)).astype(np.int64).reshape(-1, 2)
    if len(whole) and ((whole < 0).any() or (whole >= [w, h]).any()):
        raise ValueError(f"match_pixels: expected pixels inside {w}x{h}, got {whole.min(0)}…{whole.max(0)}")
    start = np.asarray(px if start_px is None else start_px, np.float32).reshape(-1, 2)
    return torch.from_numpy(whole).to(device), torch.from_numpy(start).to(device)


def _found(values: Tensor) -> Found:
    out = values.cpu().numpy()
    return out[:, :2], out[:, 2] > 0, out[:, 3], out[:, 4]


def _tensor(values: Any, device: torch.device | str | None) -> Tensor:
    """float32 on the device; no copy where it is that already."""
    return torch.as_tensor(values, device=device).float()


def same_place(a: Tensor, b: Tensor, ratio: float) -> Tensor:
    """(n,) True where two points (n, 3) differ by less than ``ratio`` of the nearer one's distance."""
    away = (a - b).norm(dim=1)
    return (away < ratio * torch.minimum(a.norm(dim=1), b.norm(dim=1))) & torch.isfinite(away)


def ray_image(points: Tensor) -> Tensor:
    """(h, w, 9) unit rays of a pointmap (h, w, 3) in its own camera, and their change a pixel along x and y."""
    length = points.norm(dim=-1, keepdim=True)
    known = torch.isfinite(length) & (length > 0)
    rays = torch.where(known, points, 0.0) / torch.where(known, length, 1.0)
    # by slices, not as a convolution: those may run with 10 bits (TF32), the size of the changes themselves
    side = functional.pad(rays.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="reflect")[0].permute(1, 2, 0)
    across, down = side[:, 2:] - side[:, :-2], side[2:] - side[:-2]
    along_x = (3 * (across[:-2] + across[2:]) + 10 * across[1:-1]) / 32  # Scharr
    along_y = (3 * (down[:, :-2] + down[:, 2:]) + 10 * down[:, 1:-1]) / 32
    return torch.cat([rays, along_x, along_y], -1)


def _sample(image: Tensor, px: Tensor) -> Tensor:
    """(n, 9) bilinear values at (n, 2) pixels with 0 <= x < w - 1, 0 <= y < h - 1."""
    low = px.floor()
    a, b = (px - low).unbind(1)
    j, i = low.long().unbind(1)
    flat, w = image.reshape(-1, image.shape[-1]), image.shape[1]
    at = i * w + j
    upper = flat[at] * (1 - a)[:, None] + flat[at + 1] * a[:, None]
    lower = flat[at + w] * (1 - a)[:, None] + flat[at + w + 1] * a[:, None]
    return upper * (1 - b)[:, None] + lower * b[:, None]


def _clamped(px: Tensor, low: int, high_x: int, high_y: int) -> Tensor:
    """(n, 2) pixels held inside; plain numbers, since a recording cannot bring arrays to the device."""
    return torch.stack([px[:, 0].clamp(low, high_x), px[:, 1].clamp(low, high_y)], 1)


def _difference(sampled: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit rays (n, 3), their lengths before (n, 1), squared differences (n,), inf where there is no ray."""
    length = sampled[:, :3].norm(dim=1, keepdim=True)
    there = length[:, 0] > 0.5
    unit = sampled[:, :3] / torch.where(there[:, None], length, 1.0)
    return unit, length, torch.where(there, (unit - rays).square().sum(1), torch.inf)


def _step(sampled: Tensor, unit: Tensor, length: Tensor, rays: Tensor, damping: Tensor) -> Tensor:
    """(n, 2) damped least-squares steps to be subtracted."""
    jx = (sampled[:, 3:6] - unit * (unit * sampled[:, 3:6]).sum(1, keepdim=True)) / length
    jy = (sampled[:, 6:9] - unit * (unit * sampled[:, 6:9]).sum(1, keepdim=True)) / length
    e = unit - rays
    xx, yy, xy = jx.square().sum(1) + damping, jy.square().sum(1) + damping, (jx * jy).sum(1)
    bx, by = (jx * e).sum(1), (jy * e).sum(1)
    return torch.stack([yy * bx - xy * by, xx * by - xy * bx], 1) / (xx * yy - xy * xy)[:, None]


def search_rays(image: Tensor, points: Tensor, start_px: Tensor, options: Options) -> tuple[Tensor, Tensor]:
    """(n, 2) pixels whose rays point at ``points`` (n, 3), and (n,) squared differences of the rays; inf = no point."""
    length = points.norm(dim=1, keepdim=True)
    known = torch.isfinite(length) & (length > 0)
    rays = (torch.where(known, points, 0.0) / torch.where(known, length, 1.0)).double()
    image, h, w = image.double(), image.shape[0], image.shape[1]
    px = _clamped(torch.where(torch.isfinite(start_px), start_px, 0.0).double(), 1, w - 2, h - 2)
    sampled = _sample(image, px)
    unit, size, cost = _difference(sampled, rays)
    damping = torch.full_like(cost, options.damping)
    active = torch.isfinite(cost)
    for _ in range(options.iterations):
        trial_px = _clamped(px - _step(sampled, unit, size, rays, damping), 1, w - 2, h - 2)
        sound = torch.isfinite(trial_px).all(1)
        trial_px = torch.where(sound[:, None], trial_px, px)
        trial_sampled = _sample(image, trial_px)
        trial_unit, trial_size, trial_cost = _difference(trial_sampled, rays)
        kept = active & sound & (trial_cost < cost)
        settled = kept & ((trial_px - px).abs().amax(1) < _SETTLED_PX)
        px, sampled = torch.where(kept[:, None], trial_px, px), torch.where(kept[:, None], trial_sampled, sampled)
        unit, size = torch.where(kept[:, None], trial_unit, unit), torch.where(kept[:, None], trial_size, size)
        cost = torch.where(kept, trial_cost, cost)
        damping = torch.where(kept, damping * 0.1, damping * 10)
        active = active & sound & ~settled
    return px.float(), torch.where(known[:, 0], cost, torch.inf)


def search_descriptors(
    descriptors: Tensor, wanted: Tensor, start_px: Tensor, options: Options
) -> tuple[Tensor, Tensor]:
    """(n, 2) sub-pixel places of the descriptors (h, w, c) most like ``wanted`` (n, c) about start_px, and likeness."""
    if not len(wanted):
        return start_px, start_px.new_zeros(0)
    blocks = zip(wanted.split(_ROWS_AT_ONCE), start_px.split(_ROWS_AT_ONCE), strict=True)
    found = [_search_block(descriptors, rows, start, options) for rows, start in blocks]
    return torch.cat([px for px, _ in found]), torch.cat([similarity for _, similarity in found])


def _search_block(maps: Tensor, wanted: Tensor, start_px: Tensor, options: Options) -> tuple[Tensor, Tensor]:
    h, w = maps.shape[:2]
    at = _clamped(start_px.round().long(), 0, w - 1, h - 1)
    one_way = torch.arange(-options.radius, options.radius + 1, device=maps.device)
    offsets = torch.cartesian_prod(one_way, one_way).flip(1)  # row by row
    middle = len(offsets) // 2
    similarity = wanted.new_full((len(wanted),), -1.0)
    for step in range(options.dilation_max, 0, -1):
        candidates = at[:, None] + step * offsets
        values = _likeness(maps, candidates, wanted).nan_to_num(-1.0)
        similarity, chosen = values.max(1)
        chosen = torch.where(values[:, middle] >= similarity, middle, chosen)
        moved = candidates.gather(1, chosen[:, None, None].expand(-1, 1, 2))[:, 0]
        at = torch.where((similarity > -1)[:, None], moved, at)
    return at + _top(maps, at, wanted, similarity), similarity


def _top(maps: Tensor, at: Tensor, wanted: Tensor, best: Tensor) -> Tensor:
    """(n, 2) where the quadratic through the likeness of 3 x 3 pixels is highest, from ``at``; 0 where not within 1."""
    h, w = maps.shape[:2]
    one_way = torch.arange(-1, 2, device=maps.device)
    around = _likeness(maps, at[:, None] + torch.cartesian_prod(one_way, one_way), wanted)  # column by column
    gx, gy = (around[:, 7] - around[:, 1]) / 2, (around[:, 5] - around[:, 3]) / 2
    xx, yy = around[:, 1] - 2 * best + around[:, 7], around[:, 3] - 2 * best + around[:, 5]
    xy = (around[:, 8] + around[:, 0] - around[:, 6] - around[:, 2]) / 4
    det = xx * yy - xy * xy
    step = torch.stack([xy * gy - yy * gx, xy * gx - xx * gy], 1) / det[:, None]
    inner = (at > 0).all(1) & (at[:, 0] < w - 1) & (at[:, 1] < h - 1)
    near = (xx < -_FLAT) & (yy < -_FLAT) & (det > _FLAT**2) & (step.abs() <= 1).all(1)
    return torch.where((inner & near & (best > -1))[:, None], step, 0.0)


def _likeness(maps: Tensor, px: Tensor, wanted: Tensor) -> Tensor:
    """(n, m) products of wanted (n, c) with the descriptors at px (n, m, 2); NaN outside and for no unit vector."""
    h, w = maps.shape[:2]
    x, y = px.unbind(-1)
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    rows = maps.reshape(h * w, -1)[y.clamp(0, h - 1) * w + x.clamp(0, w - 1)]
    values = (rows * wanted[:, None]).sum(-1)  # not a product of matrices, for the same reason as in ray_image
    return torch.where(inside & (values < _MOST_ALIKE), values, torch.nan)
