"""What is said while the map trains: what will be spent, how long that will take, and how good the map is by now."""

from __future__ import annotations

import logging
import time
from collections import deque

import numpy as np

from ..config import MappingConfig
from ..evaluation.image_error import psnr
from ..mapping.mapper import Mapper
from ..mapping.schedule import Level, levels
from ..progress import Bar
from ..types import View

log = logging.getLogger(__name__)
WARM_STEPS, TIMED_STEPS = 2, 8  # of each image size: those that do not count, and those that its time is taken from
LEAST_COST = 0.15  # of a step on full images: what a step costs beside the pixels
MEASURED_RATIO = 0.02  # of the training's time may go into measuring
MEASURED_APART_S = 0.5  # at least
SHOWN_VIEWS = 8  # what is shown is the mean over the training views that were measured last
VIEW_STEP_RATIO = 0.618  # of all views, from one that is measured to the next: they lie spread over the video


def budget(m: MappingConfig, steps: int) -> str:
    """What a training will spend, in words; ``m`` with numbers for what its quality decides."""
    length = f"{m.minutes:g} min" if m.minutes else f"{steps} steps"
    return f"{length} on images {m.width_px} px wide, at most {m.max_gaussians} Gaussians"


class MapProgress:
    """Follows a training as its ``on_step``: moves the bar and says what is known."""

    def __init__(self, mapper: Mapper, views: list[View], steps: int, bar: Bar) -> None:
        """``steps`` are those that are left of the schedule; ``views`` are those that are trained on."""
        self._mapper, self._views, self._bar = mapper, views, bar
        self._seconds, self._all = 60 * mapper.config.minutes, mapper.config.iterations or 0
        self._levels = levels(views[0].camera.width)
        self._began = self._step_began = time.monotonic()
        self.steps = self._shown_s = 0  # steps that were taken; seconds that the bar shows
        self._level: Level | None = None
        self._times_s: list[float] = []  # of the first steps on images of this size
        self._ends: float | None = None  # when the training will, as far as can be told
        self._psnr: deque[float] = deque(maxlen=SHOWN_VIEWS)
        self._next_view, self._measuring_s = 0.0, 0.0
        self._measured = self._began
        self._spent = budget(mapper.config, steps)
        log.info("map: %s", self._spent)
        bar.say(self._spent)

    def __call__(self, step: int, _loss: float) -> None:
        """Step ``step`` of the schedule is done."""
        now = time.monotonic()
        self.steps += 1
        if self._seconds:
            passed = min(round(self._seconds), int(now - self._began))
            self._bar.advance(passed - self._shown_s)
            self._shown_s = passed
        else:
            self._bar.advance()
            self._estimate(step, now)
            if step >= self._all:
                self._ends = None
                self._say()
        due = max(MEASURED_APART_S, self._measuring_s / MEASURED_RATIO)
        if now - self._measured > due:
            self._measure(now)
            self._say()
        self._step_began = time.monotonic()

    def _estimate(self, step: int, now: float) -> None:
        """When the training ends, told anew after the first steps on images of each size."""
        level = self._level_at((step - 1) / max(1, self._all))
        if level is not self._level:
            self._level, self._times_s = level, []
        if len(self._times_s) >= WARM_STEPS + TIMED_STEPS:
            return
        self._times_s.append(now - self._step_began)
        if len(self._times_s) < WARM_STEPS + TIMED_STEPS:
            return
        step_s = float(np.mean(self._times_s[WARM_STEPS:]))
        left_s = step_s * self._steps_left(step, level)
        self._ends = now + left_s
        width = self._views[0].camera.width // level.shrink
        log.info("map: %.3f s a step on images %d px wide, about %s left", step_s, width, duration(left_s))
        self._say()

    def _level_at(self, done: float) -> Level:
        return next((level for level in self._levels if done < level.until), self._levels[-1])

    def _steps_left(self, step: int, now_on: Level) -> float:
        """Steps that are left, those on images of other sizes counted as what they cost in steps on this one."""
        total, done = 0.0, step / max(1, self._all)
        for level in self._levels:
            total += max(0.0, level.until - done) * self._all * _cost(level) / _cost(now_on)
            done = max(done, level.until)
        return total

    def _measure(self, now: float) -> None:
        """The splat's PSNR over the pixels of one more training view that count."""
        view = self._views[int(self._next_view * len(self._views))]
        self._next_view = (self._next_view + VIEW_STEP_RATIO) % 1
        pose = self._mapper.refined_pose(view.world_from_cam, view.timestamp_s)
        color, _, _ = self._mapper.render(pose, view.camera)
        found = psnr(color, view.image / 255, view.static > 0.5)
        if found is not None and np.isfinite(found):
            self._psnr.append(found)
        self._measured = time.monotonic()
        self._measuring_s = self._measured - now

    def _say(self) -> None:
        words = [self._spent]
        if self._ends is not None:
            words.append(f"about {duration(max(0.0, self._ends - time.monotonic()))} left")
        if self._psnr:
            words.append(f"PSNR {np.mean(self._psnr):.1f} dB")
        self._bar.say(" · ".join(words))


def duration(seconds: float) -> str:
    """Seconds in words, to two figures or so: 40 s, 12 min, 1 h 20 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def _cost(level: Level) -> float:
    return LEAST_COST + (1 - LEAST_COST) / level.shrink**2
