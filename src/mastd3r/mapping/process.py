"""The map in a process of its own, fed while tracking runs; it never holds tracking back (``--realtime``).

One bounded queue leads in. What does not fit is dropped and counted: a later keyframe, and the poses that are sent
again after every correction, make up for it. Training steps are spent from a budget that every keyframe brings.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import queue
import signal
import time
from dataclasses import dataclass, replace
from typing import Any

from ..config import MappingConfig
from ..errors import InputError
from ..types import StaticCloud, View
from .gaussians import Array, GaussianArrays
from .mapper import Mapper

log = logging.getLogger(__name__)
QUEUE_LENGTH = 8  # messages; a keyframe is about a megabyte
FIRST_KEYFRAMES = 3  # that a map is started from
NICENESS = 10  # tracking goes first where cores are scarce
PATIENCE_S = 1.0  # between two looks at whether the other side still lives
FINISH_S = 120.0  # the longest wait for the last step and the copy of the map


@dataclass(frozen=True)
class KeyframeNews:
    """A keyframe as it is known now, and the training steps that it pays for."""

    view: View
    cloud: StaticCloud  # of this keyframe alone
    world_from_kf: Array  # (4, 4), what view and cloud were placed by
    steps: int


@dataclass(frozen=True)
class PoseNews:
    """A graph correction: where all keyframes that were sent stand now."""

    world_from_kf: dict[int, Array]


@dataclass(frozen=True)
class Outcome:
    """The map when tracking ended. ``gaussians`` is None where no keyframe made one."""

    gaussians: GaussianArrays | None
    steps: int
    views: int

    def in_lengths(self, factor: float) -> Outcome:
        """The same with lengths times ``factor``."""
        return self if self.gaussians is None else replace(self, gaussians=self.gaussians.in_lengths(factor))


class Trainer:
    """What the process does with its messages; knows nothing of processes."""

    def __init__(self, config: MappingConfig, seed: int, device: str) -> None:
        self._config, self._seed, self._device = config, seed, device
        self._mapper: Mapper | None = None
        self._waiting: list[KeyframeNews] = []
        self._world_from_kf: dict[int, Array] = {}
        self._budget, self._steps, self._views = 0, 0, 0

    @property
    def idle(self) -> bool:
        """True where there is nothing to train, or no step left to spend."""
        return self._mapper is None or self._budget <= 0

    def take(self, message: KeyframeNews | PoseNews) -> None:
        """Grow or move the map."""
        if isinstance(message, PoseNews):
            self._move(message.world_from_kf)
            return
        self._budget += message.steps
        self._waiting.append(message)
        if self._mapper is None and len(self._waiting) < FIRST_KEYFRAMES:
            return
        for news in self._waiting:
            self._world_from_kf.setdefault(news.view.kf_id, news.world_from_kf)
        waiting, self._waiting = self._waiting, []
        if self._mapper is not None:
            for news in waiting:
                self._mapper.extend([news.view], news.cloud)
        else:
            try:
                self._mapper = Mapper(
                    self._config, waiting[0].cloud, [w.view for w in waiting], self._seed, self._device
                )
            except InputError as e:  # no point in front of these views: the next keyframe brings more
                log.info("realtime map not started yet: %s", e)
                self._waiting = waiting[1:]
                return
            for news in waiting[1:]:
                self._mapper.extend([], news.cloud)
        self._views += len(waiting)

    def _move(self, now: dict[int, Array]) -> None:
        before = {k: p for k, p in self._world_from_kf.items() if k in now}
        if self._mapper is not None:
            self._mapper.move_keyframes(before, now)
        self._world_from_kf |= {k: now[k] for k in before}

    def step(self) -> None:
        """One training step."""
        assert self._mapper is not None
        self._mapper.refine(1)
        self._budget -= 1
        self._steps += 1

    def outcome(self) -> Outcome:
        """What there is now."""
        return Outcome(None if self._mapper is None else self._mapper.gaussians, self._steps, self._views)


def serve(inbox: Any, outbox: Any, config: MappingConfig, seed: int, device: str) -> None:
    """The process: take what has come, train while there is budget, give the map when None comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's, which then ends this process
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    trainer, parent = Trainer(config, seed, device), multiprocessing.parent_process()
    while parent is None or parent.is_alive():
        try:
            message = inbox.get(timeout=PATIENCE_S) if trainer.idle else inbox.get_nowait()
        except queue.Empty:
            if not trainer.idle:
                trainer.step()
            continue
        if message is None:
            outbox.put(trainer.outcome())
            return
        trainer.take(message)


class MapProcess:
    """The parent's side: ``offer`` returns at once, ``finish`` waits for the map."""

    def __init__(self, config: MappingConfig, seed: int, device: str, queue_length: int = QUEUE_LENGTH) -> None:
        context = multiprocessing.get_context("spawn")
        self._inbox, self._outbox = context.Queue(queue_length), context.Queue()
        words = (self._inbox, self._outbox, config, seed, device)
        self._process = context.Process(target=serve, args=words, name="map", daemon=True)
        self._process.start()
        self.sent, self.dropped = 0, 0

    def offer(self, message: KeyframeNews | PoseNews) -> bool:
        """Put a message in the queue if there is room; never waits. False where it was dropped."""
        try:
            self._inbox.put_nowait(message)
        except queue.Full:
            self.dropped += 1
            return False
        self.sent += 1
        return True

    def finish(self, poses: PoseNews) -> Outcome | None:
        """The last poses in, the map out; None where the process has died or does not answer. It has ended then."""
        until = time.monotonic() + FINISH_S
        for message in (poses, None):
            while self._process.is_alive() and time.monotonic() < until:
                try:
                    self._inbox.put(message, timeout=PATIENCE_S)
                    break
                except queue.Full:
                    continue
        outcome: Outcome | None = None
        while outcome is None and time.monotonic() < until:
            alive = self._process.is_alive()
            try:
                outcome = self._outbox.get(timeout=PATIENCE_S)
            except queue.Empty:
                if not alive:
                    break
        self.close()
        return outcome

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._inbox.cancel_join_thread()
        if self._process.is_alive():
            self._process.join(PATIENCE_S)
        if self._process.is_alive():
            self._process.terminate()
        self._process.join()
