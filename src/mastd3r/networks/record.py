"""Layers recorded once a shape and played back as one launch (a CUDA graph).

A pair of 512 x 384 is some two thousand short kernels. Launched one by one they take longer than they run, and keep
the interpreter busy, which has the tracking to do. A recording does the same kernels in the same order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map_only

log = logging.getLogger(__name__)
WARM_CALLS = 3  # before a recording: libraries choose and set up their kernels then
MOST_SHAPES = 6  # of one call; recordings keep the memory of their layers; beyond, layers are launched one by one


@dataclass(frozen=True)
class _Recording:
    graph: Any  # torch.cuda.CUDAGraph
    inputs: tuple[Tensor, ...]
    outputs: Any  # overwritten by the next play


def can_record(device: torch.device) -> bool:
    """Whether layers can be recorded on a device."""
    return device.type == "cuda"


class Recorder:
    """Makes recordings that share their memory; so one is played at a time, whatever thread asks."""

    def __init__(self, device: torch.device) -> None:
        self.device, self._lock = device, Lock()
        self._pool: Any = None

    def recorded(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """``call`` of tensors of the device, to be recorded at the first use of every shape.

        Its results are copies. What it reads beside its arguments must stay where it is: weights do.
        """
        known: dict[tuple[Any, ...], _Recording] = {}

        def play(*given: Tensor) -> Any:
            shapes = tuple((tuple(t.shape), t.dtype) for t in given)
            with self._lock:
                if shapes not in known and len(known) == MOST_SHAPES:
                    return call(*given)
                if shapes not in known:
                    known[shapes] = self._record(call, given)
                recording = known[shapes]
                for kept, new in zip(recording.inputs, given, strict=True):
                    kept.copy_(new)
                recording.graph.replay()
                return tree_map_only(Tensor, Tensor.clone, recording.outputs)

        return play

    def _record(self, call: Callable[..., Any], given: tuple[Tensor, ...]) -> _Recording:
        inputs = tuple(t.clone() for t in given)
        beside = torch.cuda.Stream(self.device)
        beside.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(beside):
            for _ in range(WARM_CALLS):
                call(*inputs)
        torch.cuda.current_stream(self.device).wait_stream(beside)
        self._pool = self._pool or torch.cuda.graph_pool_handle()
        graph = torch.cuda.CUDAGraph()
        # another thread may copy its own things meanwhile: only this one's calls are watched
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            outputs = call(*inputs)
        log.info("recorded the layers for %s", ", ".join(str(tuple(t.shape)) for t in inputs))
        return _Recording(graph, inputs, outputs)
