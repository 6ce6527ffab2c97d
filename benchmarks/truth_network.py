"""A two-view network that answers with the truth of a sequence with sensor depth, after work at its own full cost.

Random weights give points that nothing can be tracked by. To time the whole loop, the full-size layers run on every
frame and every pair, and their answer is replaced by what a perfect network would say: points from the sensor's depth
and the true poses, descriptors that belong to places of the room. So frames really track.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mastd3r.config import SourceConfig
from mastd3r.geometry.se3 import inverse
from mastd3r.networks.pair import EncodedFrame, NetworkPair, NetworkView, PairNetwork, Prepared
from mastd3r.sources.tum import TumSource
from mastd3r.types import Frame

Array = NDArray[Any]
WAVE_M = 0.15  # length scale of the descriptors
SURE, UNSURE = 5.0, 1.0  # confidences where the sensor measured, and where it did not


class Clip:
    """Frames of a TUM-layout folder kept in memory, with the truth of each. The tracker is shown the photographs."""

    def __init__(self, folder: Path, frames: int) -> None:
        source = TumSource(folder, SourceConfig(end=frames), want_depth=True, want_semantic=False)
        truth = source.truth()
        if truth is None or len(truth.timestamps_s) == 0 or not source.has_depth or truth.focal_px is None:
            raise SystemExit(f"{folder}: expected a TUM-layout folder with depth, poses and fx in info.json")
        self.folder, self.size, self.focal_px, self.truth = folder, source.size, truth.focal_px, truth
        self.frames = list(source.frames())
        self.timestamps_s = np.array([f.timestamp_s for f in self.frames])
        at = np.abs(truth.timestamps_s[None] - self.timestamps_s[:, None]).argmin(1)
        self.world_from_cam = truth.world_from_cam[at]

    def photographs(self) -> Iterator[Frame]:
        """The same without depth, read from the files again as a run does."""
        source = TumSource(self.folder, SourceConfig(end=len(self.frames)), want_semantic=False)
        yield from source.frames()


@dataclass(frozen=True)
class Numbered(Prepared):
    """A prepared photograph that is known."""

    number: int  # of the frame in the clip


@dataclass(frozen=True)
class Seen:
    """An encoded photograph that is known."""

    encoded: EncodedFrame
    number: int

    @property
    def pooled(self) -> Array:
        return self.encoded.pooled


class TruthNetwork:
    """A ``PairNetwork`` whose layers run, and whose answers are the truth. ``network`` None: no layers at all."""

    def __init__(self, network: PairNetwork, clip: Clip, *, run_layers: bool = True) -> None:
        self.network, self.clip, self.device, self.run_layers = network, clip, network.device, run_layers
        self.long_side_px = network.long_side_px
        self.encoded = self.decoded = 0  # frames, pairs
        self._number = {f.image.tobytes(): n for n, f in enumerate(clip.frames)}
        waves = np.random.default_rng(7).normal(0, 1 / WAVE_M, (3, 12)).astype(np.float32)
        self._waves = torch.from_numpy(waves).to(self.device)
        self._views = [self._view(f, pose) for f, pose in zip(clip.frames, clip.world_from_cam, strict=True)]

    def _view(self, frame: Frame, world_from_cam: Array) -> NetworkView:
        """Points in the frame's own camera. Where the sensor has a hole, it is filled and called unsure."""
        mapping = self.network.prepare(frame.image).mapping
        w, h = mapping.net_size
        full = mapping.full_from_net(np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1))
        assert frame.depth_m is not None
        depth = cv2.remap(frame.depth_m, full.astype(np.float32), None, cv2.INTER_NEAREST)
        known = depth > 0
        depth = np.where(known, depth, np.median(depth[known]))[..., None]
        centre = (np.array(self.clip.size) - 1) / 2
        points = np.concatenate([(full - centre) / self.clip.focal_px * depth, depth], -1)
        world = points @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        phase = torch.from_numpy(world.astype(np.float32)).to(self.device) @ self._waves
        descriptors = torch.cat([phase.sin(), phase.cos()], -1) / 12**0.5
        sure = torch.from_numpy(np.where(known, SURE, UNSURE).astype(np.float32)).to(self.device)
        return NetworkView(torch.from_numpy(points.astype(np.float32)).to(self.device), sure, descriptors, sure)

    def prepare(self, image: Array) -> Numbered:
        """As the network does; a frame that is not of the clip has number -1 and cannot be decoded."""
        p = self.network.prepare(image)
        return Numbered(p.image, p.mapping, p.height, p.width, self._number.get(image.tobytes(), -1))

    def encode(self, prepared: Numbered) -> Seen:
        """The encoder runs."""
        self.encoded += 1
        return Seen(self.network.encode(prepared), prepared.number)

    def pair(self, a: Seen, b: Seen) -> NetworkPair:
        """The decoders and heads run; the answer is the truth."""
        return self.pairs([(a, b)])[0]

    @torch.inference_mode()
    def pairs(self, pairs: Sequence[tuple[Seen, Seen]], symmetric: bool = False) -> list[NetworkPair]:
        """The same of several, as one batch."""
        self.decoded += len(pairs) * (1 + symmetric)
        if self.run_layers:
            self.network.pairs([(a.encoded, b.encoded) for a, b in pairs], symmetric)
        return [self._truth(a.number, b.number, symmetric) for a, b in pairs]

    def _truth(self, a: int, b: int, symmetric: bool) -> NetworkPair:
        pose = self.clip.world_from_cam
        first_from_second = torch.from_numpy((inverse(pose[a]) @ pose[b]).astype(np.float32)).to(self.device)
        second = self._views[b]
        points: Tensor = second.points @ first_from_second[:3, :3].T + first_from_second[:3, 3]
        moved = NetworkView(points, second.confidence, second.descriptors, second.descriptor_confidence)
        return NetworkPair(self._views[a], moved, self._truth(b, a, False) if symmetric else None)
