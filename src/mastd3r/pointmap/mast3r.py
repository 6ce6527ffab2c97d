"""Pointmaps of a two-view network (MASt3R): points, matches and own depth from its decoded pairs (III-A, eq. (7)).

Pixels. The whole photograph is shrunk to the network's scale (long side 512): that is the working image. The network
sees a window of it whose sides are multiples of 16, at a whole-pixel offset, so network px = working px - offset and
every camera is that of the working image. Outside the window nothing is measured: weight 0, own depth 0.

Pairs. ``predict(ref, new)`` decodes new as FIRST view, as MASt3R-SLAM does in tracking: new's points and ref's points
in new's camera, from which ref's pixels are found in new. One decode a pair; the other order is ``predict(new, ref)``.

Own depth. A frame's depth is the z of its first decode as first view: with itself, or with the frame named ``near``
in ``beside``, whose pair is then ready for ``predict`` and costs nothing more. Points of ref and of new are always
this depth along the given camera's rays, so ``own_inv_depth`` and both pointmaps are of one mould and ICP, scale and
re-mapping see one lens. Every frame has its own scale: that is what eq. (9) finds.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, fields, replace
from threading import Lock, RLock
from typing import Any, Generic, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..errors import InputError
from ..geometry.inpainting import inpainted_grid
from ..types import Frame, Guess, Matches, PairPrediction, Pointmap, WorkFrame
from .base import Provider
from .geometric import GeometricPointmaps
from .matching import FoundPixels, MatchOptions, ViewMaps, match_pixels, subsampled
from .network_view import Window, as_array, corner_of, focal_from_points, in_window, own_inv_depth, sample_smooth

Array = NDArray[Any]
T = TypeVar("T")
FLOW_STEP_PX = 8  # the dense flow is matched at one pixel of 8 x 8, and interpolated
SPARE_PAIRS = 2  # of those remembered: what the frames ahead bring in
HALF_WEIGHT = 1.5  # descriptor confidence at which a match weighs one half


class TwoViewNetwork(Protocol):
    """The network behind the provider. ``networks.pair.PairNetwork`` is one."""

    def prepare(self, image: Array) -> Any: ...  # (H, W, 3) uint8 RGB -> has .mapping, a Window
    def encode(self, prepared: Any) -> Any: ...  # -> has .pooled, (c,) numpy: the mean token
    def pairs(self, pairs: Sequence[tuple[Any, Any]]) -> Sequence[Any]: ...

    # of two encoded each -> each has .first, .second: ViewMaps, arrays or tensors; all of one size


Matcher = Callable[[ViewMaps, ViewMaps, Array, "Array | None", MatchOptions], FoundPixels]


def working_size_of(network: TwoViewNetwork, full_size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of the working image of photographs of ``full_size``. Raises InputError for a thin strip."""
    width, height = network.prepare(np.zeros((full_size[1], full_size[0], 3), np.uint8)).mapping.resized_size
    return width, height


def match_on_host(
    target: ViewMaps, source: ViewMaps, px: Array, start_px: Array | None, options: MatchOptions
) -> FoundPixels:
    """``match_pixels`` for maps that may lie on a device."""
    return match_pixels(_HostMaps(target), _HostMaps(source), px, start_px, options)


class _HostMaps:
    """Maps as numpy, each brought over when it is asked for."""

    def __init__(self, maps: ViewMaps) -> None:
        self._maps = maps

    @property
    def points(self) -> Array:
        return as_array(self._maps.points)

    @property
    def descriptors(self) -> Array:
        return as_array(self._maps.descriptors)

    @property
    def descriptor_confidence(self) -> Array:
        return as_array(self._maps.descriptor_confidence)


@dataclass(frozen=True, kw_only=True)
class NetworkFrame(WorkFrame):
    """A working frame that the network can be shown."""

    prepared: Any  # the network's image, to encode it again should its tokens be forgotten
    window: Window
    serial: int  # one a call of observe


class Mast3rPointmaps(Provider):
    """Provider over an injected network. It remembers tokens and pairs; one thread at a time asks the network."""

    name = "mast3r"
    finds_far = True  # the search on rays finds its way from the same pixel, without a start
    side_by_side = False  # one accelerator, and a memory of pairs
    own_scale_known = False

    def __init__(
        self,
        network: TwoViewNetwork,
        width: int,
        height: int,
        cell_px: int,
        *,
        options: MatchOptions | None = None,
        matcher: Matcher = match_on_host,
        remembered_frames: int = 48,
        remembered_pairs: int = 4,
        depth_sigma_ratio: float = 0.08,
        prefetches_pairs: bool = False,
        notes: tuple[str, ...] = (),
    ) -> None:
        """``width`` and ``height`` are those of ``working_size_of``; maps on a device want a matcher for them."""
        self.network, self.width, self.height, self.cell_px = network, width, height, cell_px
        self.size = (width, height)
        self.options, self.matcher = options or MatchOptions(), matcher
        self._look = GeometricPointmaps(width, height, cell_px)
        self._encoded: _Remembered[Any] = _Remembered(remembered_frames)
        self._pairs: _Remembered[Any] = _Remembered(remembered_pairs)
        self.depth_sigma_ratio: float | None = depth_sigma_ratio
        self.prefetches_pairs, self.notes = prefetches_pairs, notes
        self._serial = itertools.count()
        self._asking = RLock()

    def look(self, frame: Frame) -> NetworkFrame:
        """Working image, pixels to match, and the network's tokens; no own depth yet.

        Raises InputError where the frame's size does not give the provider's working size.
        """
        prepared = self.network.prepare(frame.image)
        window: Window = prepared.mapping
        if tuple(window.resized_size) != (self.width, self.height):
            h, w = frame.image.shape[:2]
            raise InputError(
                f"frame {frame.index}: expected frames whose working size is {self.width}x{self.height}, "
                f"got {w}x{h} pixels, which give {window.resized_size[0]}x{window.resized_size[1]}"
            )
        seen = _fields(self._look.look(frame))
        work = NetworkFrame(**seen, prepared=prepared, window=window, serial=next(self._serial))
        self._tokens(work)
        return work

    def beside(self, work: WorkFrame, near: WorkFrame | None) -> NetworkFrame:
        """The frame with own depth and focal length, from its pair with ``near``.

        ``near``: a frame that sees the same place (the keyframe that the next ``predict`` will name as ref). Without
        it the frame is paired with itself: one more decode.
        """
        new = _network_frame(work)
        window = new.window
        first = self._decoded(new, new if near is None else _network_frame(near)).first
        points, confidence = as_array(first.points), as_array(first.confidence)
        own = np.zeros((self.height, self.width), np.float32)
        in_window(own, window)[:] = own_inv_depth(points, confidence)
        centre = (self.width - 1) / 2 - window.crop_left_px, (self.height - 1) / 2 - window.crop_top_px
        focal = focal_from_points(points, in_window(own, window) > 0, centre)
        return replace(new, own_inv_depth=own, focal_px=focal)

    def expect(self, pairs: Sequence[tuple[WorkFrame, WorkFrame]]) -> None:
        """Decode both orders of these pairs in one pass, if they can all be remembered until they are asked for."""
        orders = [(a, b) for pair in pairs for a, b in (pair, pair[::-1])]
        frames = [(_network_frame(a), _network_frame(b)) for a, b in orders]
        wanted = [p for p in frames if self._pairs.get(_serials(p)) is None]
        if len(wanted) <= self._pairs.most - SPARE_PAIRS:
            self._decode_all(wanted)

    def predict(self, ref: WorkFrame, new: WorkFrame, guess: Guess) -> PairPrediction:
        """Ref's chosen pixels found in new, eq. (7), and ref's points in the scale of guess.ref_inv_depth.

        ``guess.flow`` is where the search starts. ``new_own`` keeps new's own scale.
        """
        a, b = _network_frame(ref), _network_frame(new)
        pair = self._decoded(b, a)
        matches, flow = self._matches(a, b, pair, guess.flow)
        factor = _scale_to(guess, sample_smooth(a.own_inv_depth, a.px))
        ref_map = _along_rays(a, a.px, guess.camera, _at(pair.second.confidence, a.window, a.px), factor)
        confidence = _at(pair.first.confidence, b.window, matches.new_px) * (matches.weight > 0)
        own = _along_rays(b, matches.new_px, guess.camera, confidence, 1.0)
        return PairPrediction(matches, ref_map, own, flow)

    def place_descriptor(self, work: WorkFrame) -> Array:
        """(c,) float32 of unit length, alike where two frames show the same place: the mean token. 0 if not finite."""
        pooled = np.asarray(self._tokens(_network_frame(work)).pooled, np.float32).reshape(-1)
        length = float(np.linalg.norm(pooled))
        return pooled / length if np.isfinite(length) and length > 0 else np.zeros_like(pooled)

    # -- the network, each thing once ------------------------------------------------------------------------

    def _tokens(self, frame: NetworkFrame) -> Any:
        found = self._encoded.get(frame.serial)
        if found is None:
            with self._asking:
                found = self._encoded.get(frame.serial) or self.network.encode(frame.prepared)
                self._encoded.put(frame.serial, found)
        return found

    def _decoded(self, first: NetworkFrame, second: NetworkFrame) -> Any:
        found = self._pairs.get((first.serial, second.serial))  # without waiting for what another thread asks
        return found or self._decode_all([(first, second)])[0]

    def _decode_all(self, pairs: Sequence[tuple[NetworkFrame, NetworkFrame]]) -> Sequence[Any]:
        if not pairs:
            return []
        with self._asking:
            found = self.network.pairs([(self._tokens(a), self._tokens(b)) for a, b in pairs])
            for pair, decoded in zip(pairs, found, strict=True):
                self._pairs.put(_serials(pair), decoded)
        return found

    def _matches(self, ref: NetworkFrame, new: NetworkFrame, pair: Any, start: Array | None) -> tuple[Matches, Array]:
        """Matches of ref's chosen pixels, and the dense flow ref -> new (h, w, 2) float32."""
        offset, (w, h) = corner_of(ref.window), ref.window.net_size
        chosen = np.round(ref.px) - offset
        inside = ((chosen >= 0) & (chosen < [w, h])).all(1)
        cells, grid = subsampled(h, w, FLOW_STEP_PX)
        at = np.concatenate([chosen[inside], cells])
        begin = at if start is None else at + _flow_at(start, at + offset)
        shift = offset - corner_of(new.window)  # 0 for frames of one size
        found = self.matcher(pair.first, pair.second, at, begin + shift, self.options)
        moved, n = found.px - shift - at, int(inside.sum())
        flow = self._spread(moved[n:], found.valid[n:], grid, offset, start)
        new_px = ref.px + _flow_at(flow, ref.px)
        new_px[inside] = np.where(found.valid[:n, None], ref.px[inside] + moved[:n], new_px[inside])
        weight = np.zeros(len(ref.px))
        weight[inside] = np.where(found.valid[:n], found.confidence[:n] / (found.confidence[:n] + HALF_WEIGHT), 0.0)
        return Matches(ref.px, new_px, weight), flow

    def _spread(
        self, moved: Array, valid: Array, grid: tuple[int, int], offset: Array, fallback: Array | None
    ) -> Array:
        """(h, w, 2) float32 flow over the working image from the cells' motion; unmatched cells take their
        neighbours', all of them the start's (or none) where nothing matched."""
        if not valid.any():
            return np.zeros((self.height, self.width, 2), np.float32) if fallback is None else fallback
        known = np.where(valid[:, None], moved, 0).reshape(*grid, 2).astype(np.float32)
        everywhere = np.median(moved[valid], axis=0)
        cells = inpainted_grid(known, valid.reshape(grid).astype(np.float32), everywhere)
        x = (np.arange(self.width) - offset[0] - FLOW_STEP_PX // 2) / FLOW_STEP_PX
        y = (np.arange(self.height) - offset[1] - FLOW_STEP_PX // 2) / FLOW_STEP_PX
        map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        return cv2.remap(cells, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


class _Remembered(Generic[T]):
    """The values of the last few keys that were put or asked for."""

    def __init__(self, most: int) -> None:
        self.most, self._values, self._lock = most, OrderedDict[Hashable, T](), Lock()

    def put(self, key: Hashable, value: T) -> None:
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self.most:
                self._values.popitem(last=False)

    def get(self, key: Hashable) -> T | None:
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)


def _serials(pair: tuple[NetworkFrame, NetworkFrame]) -> tuple[int, int]:
    return pair[0].serial, pair[1].serial


def _fields(frame: WorkFrame) -> dict[str, Any]:
    return {f.name: getattr(frame, f.name) for f in fields(WorkFrame)}


def _network_frame(frame: WorkFrame) -> NetworkFrame:
    if not isinstance(frame, NetworkFrame):
        raise TypeError(f"Mast3rPointmaps: expected a frame of its own look(), got {type(frame).__name__}")
    return frame


def _at(confidence: Any, window: Window, px: Array) -> Array:
    """(p,) 0..1 from the network's confidence 1 … inf at working pixels: 1 - 1/c; 0 outside and where not finite."""
    x, y = (np.round(px) - corner_of(window)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < window.net_size[0]) & (y < window.net_size[1])
    raw = as_array(confidence)[np.where(inside, y, 0), np.where(inside, x, 0)].astype(float)
    return np.where(inside & np.isfinite(raw) & (raw > 1), 1 - 1 / np.maximum(raw, 1), 0.0)


def _along_rays(frame: NetworkFrame, px: Array, camera: Camera, confidence: Array, factor: float) -> Pointmap:
    """Own depth times ``factor`` along the camera's rays; confidence 0, and depth 1, where there is none."""
    inv_depth = sample_smooth(frame.own_inv_depth, px)
    known = inv_depth > 0
    points = camera.rays(px) * (factor / np.where(known, inv_depth, factor))[:, None]
    return Pointmap(px, points, np.where(known, confidence, 0.0))


def _scale_to(guess: Guess, own_inv_depth: Array) -> float:
    """What brings ref's own lengths to those of the guess: median ratio over depths known to 15 %; 1 if there are
    fewer than 20."""
    if guess.ref_inv_depth is None or guess.ref_depth_info is None:
        return 1.0
    sure = guess.ref_depth_info * guess.ref_inv_depth**2 > 1 / 0.15**2
    sure &= (own_inv_depth > 0) & (guess.ref_inv_depth > 0)
    return float(np.median(own_inv_depth[sure] / guess.ref_inv_depth[sure])) if sure.sum() >= 20 else 1.0


def _flow_at(flow: Array, px: Array) -> Array:
    """(p, 2) bilinear flow at working pixels; the nearest pixel's outside."""
    h, w = flow.shape[:2]
    at = np.clip(px, 0, [w - 1, h - 1])
    x, y = np.minimum(at.astype(int), [w - 2, h - 2]).T
    a, b = (at[:, 0] - x)[:, None], (at[:, 1] - y)[:, None]
    upper, lower = flow[y, x] * (1 - a) + flow[y, x + 1] * a, flow[y + 1, x] * (1 - a) + flow[y + 1, x + 1] * a
    return np.asarray(upper * (1 - b) + lower * b, float)
