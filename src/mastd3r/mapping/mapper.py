"""Algorithm 1: the Gaussian map, trained view by view under the static weights (III-C)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch

from ..camera.pinhole import Camera
from ..concurrency import one_torch_thread
from ..config import MappingConfig
from ..errors import ConfigError, InputError
from ..geometry.se3 import inverse, transform
from ..geometry.sim3 import Sim3
from ..types import StaticCloud, View
from .adam import RowAdam
from .correction import Visibility, changes_of, deformation, fitted_pose, followed, visibility
from .coverage import gaps_filled, with_backdrop
from .densify import DensifyPolicy, DensifySettings
from .gaussians import Array, GaussianArrays, GaussianMap
from .losses import mask_loss, photometric_loss, squared_color_error
from .quality import resolved
from .sampling import Sampling, sampled
from .schedule import Pace
from .screen import ScreenStats
from .seed import seed_gaussians
from .splat import NEAR_RATIO, as_pictures
from .targets import Targets, shrunk
from .view_parameters import ViewParameters

T = TypeVar("T")


@dataclass(frozen=True)
class TrainingRates:
    """Adam steps; the means' is a share of the median depth of the seeds. Steps fall evenly in their logarithm.

    A training has a tenth of the steps of the field's usual ones, so they are larger: what a Gaussian can move and
    change its shape by is their sum.
    """

    means: float = 2e-3
    means_last_ratio: float = 0.01
    log_scales: float = 2e-2
    quats: float = 4e-3
    opacity_logits: float = 5e-2
    shape_last_ratio: float = 0.3  # of the last three
    colors: float = 2.5e-3
    sh_rest: float = 1e-3


SEED_SHARE = 0.3  # of max_gaussians, so that densification has room
BACKDROP_SHARE = 0.03  # of max_gaussians, kept for what stands behind holes at the end
DEFORMATION_RATIO = 2e-3  # of the median depth, about half a pixel: below, Gaussians move by their anchor
SH_FROM = 0.4  # of the training; before that, colours do not depend on the direction
LEAST_SIGMA_PX = 0.2  # standard deviation of the smallest Gaussian, in pixels of the view that sees it largest
MOST_SIGMA_RATIO = 0.1  # standard deviation of the largest, of the distance to the nearest camera
MAX_VISIBILITIES = 48  # views that are drawn to see what Gaussians they see


class Mapper:
    """Owns the map and its optimiser. Same seed, same views, same result on one machine."""

    def __init__(
        self,
        config: MappingConfig,
        cloud: StaticCloud,
        views: list[View],
        seed: int,
        device: str = "cpu",
        rates: TrainingRates | None = None,
        densify: DensifySettings | None = None,
        start: GaussianArrays | None = None,
        steps_done: int = 0,
    ) -> None:
        """Seed the map from ``cloud``, or go on from ``start``; ``views`` beyond ``max_views`` are thinned evenly.

        ``steps_done`` of the schedule of ``config.iterations`` steps count as done.

        Raises InputError for no view, views of the wrong shape, or a cloud without a usable point, ConfigError for
        options outside their range.
        """
        check_map_options(config)
        self._views = _evenly(_checked_views(views), config.max_views)
        camera = self._views[0].camera
        config = resolved(config, (camera.width, camera.height), device)
        self.config, self._rates, self._device = config, rates or TrainingRates(), device
        self._seeds, self._seed = max(1, int(config.max_gaussians * SEED_SHARE)), seed
        if start is not None:
            self._map = GaussianMap.from_arrays(start, device)
        else:
            self._map = seed_gaussians(cloud, self._seeds, seed, device, config.sh_degree or 0)
        self._map.backend = config.backend
        self._adam = RowAdam(self._map.parameters())
        self._policy = DensifyPolicy(
            int(config.max_gaussians * (1 - BACKDROP_SHARE)), seed, densify or DensifySettings()
        )
        self._depth, self._near = _depths(self._map, self._views)
        self._view_parameters = ViewParameters(self._views, config.refine_poses, self._depth, config.exposure)
        self._targets = Targets(config, device)
        self._order = _view_order(len(self._views), seed)
        self._backgrounds = torch.Generator().manual_seed(seed)
        self._pace = Pace(camera.width, config.iterations or 0, steps_done)
        if start is None:
            self._fill_gaps()

    @property
    def gaussians(self) -> GaussianArrays:
        """The map as plain arrays."""
        return self._map.arrays()

    @property
    def facts(self) -> dict[str, Any]:
        """What run.json says of the map: lengths that its file does not tell, in map units."""
        return {"near": self._near, "median_depth": self._depth}

    def refine(self, steps: int, on_step: Callable[[int, float], None] | None = None) -> None:
        """Run ``steps`` optimisation steps, one view each; ``on_step(step, loss)`` counts from 1.

        The schedule of sizes, rates and densification is that of ``config.iterations`` steps in all.
        """
        with one_torch_thread():
            for _ in range(steps):
                self._step(on_step)

    def refine_for(self, seconds: float, on_step: Callable[[int, float], None] | None = None) -> None:
        """What is left of the schedule in so many seconds, however many steps that are on this machine."""
        width, before = self._views[0].camera.width, self._pace.steps
        self._pace = Pace(width, self.config.iterations or 0, before, seconds)
        with one_torch_thread():
            while self._pace.done < 1:
                self._step(on_step)

    def _step(self, on_step: Callable[[int, float], None] | None) -> None:
        self._pace.steps += 1
        loss = self._one_step(next(self._order))
        if on_step is not None:
            on_step(self._pace.steps, loss)

    def render(self, world_from_cam: Array, camera: Camera) -> tuple[Array, Array, Array]:
        """Colour (h,w,3) float32 0..1 over black, depth (h,w) in map units (0 where nothing is), alpha (h,w)."""
        cam_from_world = torch.from_numpy(np.linalg.inv(np.asarray(world_from_cam, float)))
        K = torch.from_numpy(camera.matrix).to(self._device)
        with torch.no_grad():
            drawn = self._draw(cam_from_world, K, camera.width, camera.height, None)
        return as_pictures(*drawn)

    def refined_pose(self, world_from_cam: Array, timestamp_s: float) -> Array:
        """A tracked pose (4, 4) under the corrections that the training views around it have learned."""
        cam_from_world = torch.from_numpy(np.linalg.inv(np.asarray(world_from_cam, float)))
        with torch.no_grad():
            return np.linalg.inv(self._view_parameters.corrected_at(cam_from_world, timestamp_s).numpy())

    def settle(self) -> None:
        """Make the map what its file shows: colours at the mean exposure, nothing right before a camera, no hole."""
        if self.config.exposure:
            gain, bias = self._view_parameters.centre_exposure(self._pace.exposure_share)
            self._map = self._map.exposed(gain, bias)
        self._clear_and_limit(len(self._views))
        self._fill_holes()

    def extend(self, views: list[View], cloud: StaticCloud) -> None:
        """More views (up to ``max_views``), and seeds from more points, up to half of what the limit leaves free.

        Raises InputError for views of the wrong shape.
        """
        new = (_checked_views(views) if views else [])[: max(0, self.config.max_views - len(self._views))]
        if new:
            self._views = [*self._views, *new]
            self._view_parameters.extend(new)
            self._order = _view_order(len(self._views), self._seed + len(self._views))
        room = max(self._seeds - len(self._map), (self.config.max_gaussians - len(self._map)) // 2)
        if room > 0 and len(cloud.points_world):
            seeds = seed_gaussians(cloud, room, self._seed, self._device, self.config.sh_degree or 0)
            self._map = self._map.joined(seeds)
            self._adam.grow(len(seeds))

    def move_keyframes(self, old_world_from_kf: dict[int, Array], new_world_from_kf: dict[int, Array]) -> None:
        """Follow a graph correction: Gaussians and views move with their keyframes; nothing restarts.

        Where the correction deforms the world, a Gaussian goes with all keyframes that see it (``correction.py``),
        which costs a picture of some views; otherwise with its anchor alone.
        """
        changes = changes_of(old_world_from_kf, new_world_from_kf)
        if not changes:
            return
        hung = [changes.get(v.kf_id, Sim3.identity()) for v in self._views]
        middle = self._map.means.detach().double().median(0).values.cpu().numpy()
        before, views = self._map, self._view_parameters
        if deformation(hung, middle) <= DEFORMATION_RATIO * self._depth:
            self._map = before.moved(changes)
            views.move_keyframes(changes)
            return
        visibilities = dict(self._sights(hung))
        trained_with = [views.cam_from_world(n).detach().numpy() for n in range(len(self._views))]
        self._map = followed(before, changes, visibilities.values())
        views.move_keyframes(changes)
        if self.config.refine_poses:
            self._fit_poses(before, trained_with, visibilities)

    def _sights(self, changes: list[Sim3]) -> Iterator[tuple[int, Visibility]]:
        """What a part of the views sees of the map now; ``changes`` are those of all views' keyframes."""
        for number in _evenly(range(len(self._views)), MAX_VISIBILITIES):
            view, (_, weight) = self._views[number], self._targets.get(number, self._views[number], 1)
            K = torch.from_numpy(view.camera.matrix).to(self._device)
            pose = self._view_parameters.cam_from_world(number).detach()
            refined = Sim3.from_rigid(inverse(self._view_parameters.tracked_cam_from_world(number)) @ pose.numpy())
            yield number, visibility(self._map, changes[number] @ refined, pose, K, weight, self._near)

    def _fit_poses(self, before: GaussianMap, trained_with: list[Array], visibilities: dict[int, Visibility]) -> None:
        """Every view's pose correction anew: the map as it is now is shown as ``before`` was.

        A view that was not drawn sees what the nearest one in time that was drawn sees.
        """
        old, new = (m.means.detach().double().cpu().numpy() for m in (before, self._map))
        drawn = np.array(sorted(visibilities, key=lambda n: self._views[n].timestamp_s))
        times_s = np.array([self._views[n].timestamp_s for n in drawn])
        for number, pose in enumerate(trained_with):
            nearest = drawn[np.abs(times_s - self._views[number].timestamp_s).argmin()]
            weight = visibilities[int(nearest)].weight_px.double().cpu().numpy()
            tracked = self._view_parameters.tracked_cam_from_world(number)
            found = fitted_pose(transform(pose, old), transform(tracked, new), weight, self._depth)
            self._view_parameters.correct(number, *found)

    def _fill_holes(self) -> None:
        """A backdrop behind what no photograph shows."""
        numbers, count = _evenly(range(len(self._views)), MAX_VISIBILITIES), len(self._map)
        poses = [self._view_parameters.cam_from_world(n).detach().numpy() for n in numbers]
        room, near = self.config.max_gaussians - count, NEAR_RATIO * self._depth
        self._map = with_backdrop(self._map, [self._views[n] for n in numbers], poses, near, room)
        self._adam.grow(len(self._map) - count)

    def _fill_gaps(self) -> None:
        """Seeds where the cloud has left the photographs' static pixels open."""
        numbers = _evenly(range(len(self._views)), MAX_VISIBILITIES)
        poses = [self._view_parameters.tracked_cam_from_world(n) for n in numbers]
        room = self.config.max_gaussians - len(self._map)
        self._map = gaps_filled(self._map, [self._views[n] for n in numbers], poses, self._near, room)
        self._adam = RowAdam(self._map.parameters())

    def _sampling(self, most_views: int) -> Sampling:
        numbers = _evenly(range(len(self._views)), most_views)
        poses = [self._view_parameters.cam_from_world(n).detach().numpy() for n in numbers]
        means = self._map.means.detach().float().cpu().numpy()
        return sampled(means, [self._views[n].camera for n in numbers], poses, self._near)

    def _clear_and_limit(self, most_views: int) -> None:
        """Remove what stands right before a camera; nothing may be finer than so many views can tell, nor too large.

        Floaters love the space before the lens, where hardly another view contradicts them; what is too fine falls
        apart when a viewer goes closer; and what is large beside a camera, such as the road below it, lies across the
        picture in viewers that take the projection's slope far outside of the image.
        """
        sampling = self._sampling(most_views)
        pixel, distance = (torch.from_numpy(a).to(self._device) for a in (sampling.pixel, sampling.distance))
        keep = torch.from_numpy(np.flatnonzero(~sampling.blocks)).to(self._device)
        if 0 < len(keep) < len(self._map):
            self._map, pixel, distance = self._map.picked(keep), pixel[keep], distance[keep]
            self._adam.pick(keep, torch.zeros(len(keep), dtype=torch.bool, device=keep.device))
        least = (LEAST_SIGMA_PX * pixel).clamp_min(1e-12).log()[:, None]
        most = torch.maximum((MOST_SIGMA_RATIO * distance).clamp_min(1e-12).log()[:, None], least)
        with torch.no_grad():
            self._map.log_scales.copy_(self._map.log_scales.clamp(least, most))

    def _draw(
        self,
        cam_from_world: torch.Tensor,
        K: torch.Tensor,
        width: int,
        height: int,
        stats: ScreenStats | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return self._map.draw(cam_from_world, K, width, height, NEAR_RATIO * self._depth, None, stats)

    def _one_step(self, number: int) -> float:
        """One view, over a background of a colour drawn at random: only an opaque world explains them all."""
        shrink = self._pace.shrink
        camera, stats = shrunk(self._views[number].camera, shrink), ScreenStats()
        K = torch.from_numpy(camera.matrix).to(self._device)
        cam_from_world = self._view_parameters.cam_from_world(number)
        background = torch.rand(3, generator=self._backgrounds).to(self._device)
        color, _, alpha = self._draw(cam_from_world, K, camera.width, camera.height, stats)
        color = self._view_parameters.exposed(color, alpha, number, self._pace.exposure_share)
        color = color + (1 - alpha)[..., None] * background
        loss = self._loss(color, number, shrink) + self._view_parameters.prior(number).to(color.device)
        loss.backward()
        self._policy.observe(self._map, stats, camera.width)
        self._adam.step(self._map.parameters(), self._current_rates())
        self._view_parameters.step(number, self._pace.done)
        with torch.no_grad():
            self._map.colors.clamp_(0, 1)  # as the file holds them
        if self._policy.due(self._pace.steps, self._pace.done):
            self._map = self._policy.round(self._map, self._adam, camera.width, self._pace.done)
            self._clear_and_limit(MAX_VISIBILITIES)
        return float(loss.detach())

    def _loss(self, color: torch.Tensor, number: int, shrink: int) -> torch.Tensor:
        target, weight = self._targets.get(number, self._views[number], shrink)
        if self.config.paper_loss:
            return mask_loss(squared_color_error(color, target), weight)
        return photometric_loss(color, target, weight, self.config.ssim_share)

    def _current_rates(self) -> dict[str, float]:
        r, done = self._rates, self._pace.done
        shape = r.shape_last_ratio**done
        return {
            "means": r.means * self._depth * r.means_last_ratio**done,
            "log_scales": r.log_scales * shape,
            "quats": r.quats * shape,
            "opacity_logits": r.opacity_logits * shape,
            "colors": r.colors,
            "sh_rest": r.sh_rest if done >= SH_FROM else 0.0,
        }


def check_map_options(config: MappingConfig) -> None:
    """Raises ConfigError for options outside their range."""
    if config.sh_degree is not None and config.sh_degree not in range(4):
        raise ConfigError(f"mapping.sh_degree: expected 0 to 3, got {config.sh_degree}")
    if not 0 <= config.ssim_share <= 1:
        raise ConfigError(f"mapping.ssim_share: expected 0 to 1, got {config.ssim_share}")
    if not 0 <= config.minutes < math.inf:
        raise ConfigError(f"mapping.minutes: expected a finite number, 0 or more, got {config.minutes}")


def _checked_views(views: list[View]) -> list[View]:
    if not views:
        raise InputError("Gaussian map: expected at least one training view, got none")
    for view in views:
        size = (view.camera.height, view.camera.width)
        if view.image.shape != (*size, 3) or view.image.dtype != np.uint8 or view.static.shape != size:
            raise InputError(
                f"Gaussian map, view at {view.timestamp_s} s: expected image {(*size, 3)} of bytes and static {size}, "
                f"got {view.image.shape} of {view.image.dtype} and {view.static.shape}"
            )
    return views


def _evenly(items: Sequence[T], limit: int) -> list[T]:
    if len(items) <= limit:
        return list(items)
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, limit).round().astype(int))]


def _depths(gaussians: GaussianMap, views: list[View]) -> tuple[float, float]:
    """Median depth of the seeds that a few cameras see, and the near limit below which nothing is drawn.

    The limit is half of the nearest percent, kept within 2 % to 25 % of the median: floaters love the space
    right before the lens, where hardly another view contradicts them.
    """
    means = gaussians.means.detach().double().cpu().numpy()
    depths = []
    for view in views[:: max(1, len(views) // 8)]:
        points_cam = (means - view.world_from_cam[:3, 3]) @ view.world_from_cam[:3, :3]
        points_cam = points_cam[points_cam[:, 2] > 1e-9]
        camera, pixels = view.camera, view.camera.project(points_cam)
        inside = ((pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(1)
        depths.append(points_cam[inside, 2])
    every = np.concatenate(depths)
    if len(every) == 0:
        raise InputError("Gaussian map: expected static points in front of the cameras, got none")
    median = float(np.median(every))
    return median, float(np.clip(0.5 * np.percentile(every, 1), 0.02 * median, 0.25 * median))


def _view_order(count: int, seed: int) -> Iterator[int]:
    """Every view once, in a new random order each time."""
    rng = np.random.default_rng(seed)
    while True:
        yield from (int(i) for i in rng.permutation(count))
