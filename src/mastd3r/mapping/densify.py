"""When and where the map grows and shrinks: one policy object, bounded by ``max_gaussians``."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .adam import RowAdam
from .gaussians import GaussianMap
from .rasterise_reference import rotation_matrices
from .screen import ScreenStats


@dataclass(frozen=True)
class DensifySettings:
    """Times are shares of the whole schedule."""

    every: int = 100  # steps between two rounds
    start_ratio: float = 0.05
    stop_ratio: float = 0.8
    full_ratio: float = 0.35  # of the schedule: from here on there may be as many Gaussians as the limit
    grad_threshold: float = 2e-4  # mean |d loss / d mean| in units of half an image width
    split_sigma_px: float = 3.0  # larger Gaussians are split in two, smaller ones are cloned
    prune_opacity: float = 0.02
    prune_width_ratio: float = 0.35  # a standard deviation above this share of the image width is a veil


class DensifyPolicy:
    """Collects screen gradients and, in rounds, clones, splits and prunes."""

    def __init__(self, max_gaussians: int, seed: int, settings: DensifySettings) -> None:
        self.settings, self._limit = settings, max_gaussians
        self._generator = torch.Generator().manual_seed(seed)
        self._first: int | None = None  # Gaussians at the first round
        self._reset(0)

    def _reset(self, count: int, device: torch.device | None = None) -> None:
        self._grad_sum = torch.zeros(count, device=device)
        self._seen = torch.zeros(count, device=device)
        self._sigma_px = torch.zeros(count, device=device)

    def observe(self, gaussians: GaussianMap, stats: ScreenStats, width: int) -> None:
        """Take in one step's screen statistics, after backward."""
        if len(self._seen) != len(gaussians):
            self._reset(len(gaussians), gaussians.means.device)
        if stats.radii_px is None or stats.mean_grad_px is None:
            return
        radius = stats.radii_px.amax(1)
        self._grad_sum += stats.mean_grad_px.norm(dim=1) * (width / 2)
        self._seen += radius > 0
        self._sigma_px = torch.maximum(self._sigma_px, radius / 3.0)

    def due(self, step: int, done: float) -> bool:
        """True where a round follows step ``step`` (counted from 1), with a share ``done`` of the training behind."""
        return step % self.settings.every == 0 and self.settings.start_ratio <= done <= self.settings.stop_ratio

    def allowed(self, count: int, done: float) -> int:
        """How many Gaussians there may be: from ``count`` at the first round to the limit."""
        s = self.settings
        self._first = count if self._first is None else self._first
        ramp = (done - s.start_ratio) / max(s.full_ratio - s.start_ratio, 1e-9)
        return int(self._first + (self._limit - self._first) * min(1.0, max(0.0, ramp)))

    @torch.no_grad()
    def round(self, gaussians: GaussianMap, adam: RowAdam, width: int, done: float) -> GaussianMap:
        """One round of pruning and growth; returns the new map and keeps ``adam`` in step with it.

        What is pruned makes room, and the room goes where the loss pulls hardest.
        """
        s = self.settings
        opacity = gaussians.opacity_logits.sigmoid()
        keep = (opacity > s.prune_opacity) & (self._sigma_px < s.prune_width_ratio * width)
        keep &= torch.isfinite(gaussians.means).all(1)
        if not bool(keep.any()):
            keep = opacity >= opacity.max()
        grad = self._grad_sum / self._seen.clamp_min(1)
        wants = torch.nonzero(keep & (grad > s.grad_threshold))[:, 0]
        room = max(0, self.allowed(len(gaussians), done) - int(keep.sum()))
        grown = wants[torch.argsort(-grad[wants], stable=True)[:room]]
        rows = torch.cat([torch.nonzero(keep)[:, 0], grown])
        fresh = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
        fresh[len(rows) - len(grown) :] = True
        large = self._sigma_px > s.split_sigma_px
        chosen = torch.zeros_like(large)
        chosen[grown] = True
        split = (chosen & large)[rows]
        result = gaussians.picked(rows)
        self._share_opacity(result, (chosen & keep)[rows])
        self._split(result, split)
        adam.pick(rows, fresh | split)
        self._reset(len(result), result.means.device)
        return result

    def _share_opacity(self, gaussians: GaussianMap, doubled: torch.Tensor) -> None:
        """Two in one place must hide as much as one before: 1 - (1 - o')^2 = o (Rota Bulo et al. 2024)."""
        opacity = gaussians.opacity_logits[doubled].sigmoid()
        gaussians.opacity_logits[doubled] = torch.logit(1 - torch.sqrt(1 - opacity), eps=1e-4)

    def _split(self, gaussians: GaussianMap, split: torch.Tensor) -> None:
        """Both halves of a split Gaussian are drawn from it, 1.6 times smaller."""
        at = torch.nonzero(split)[:, 0]
        if len(at) == 0:
            return
        noise = torch.randn(len(at), 3, generator=self._generator).to(gaussians.means)
        local = noise * gaussians.log_scales[at].exp()
        turned = torch.einsum("nij,nj->ni", rotation_matrices(gaussians.quats[at]), local)
        gaussians.means[at] += turned
        gaussians.log_scales[at] -= 0.47  # ln 1.6
