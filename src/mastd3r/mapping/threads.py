"""A numba kernel over an index range, on all cores, by plain Python threads (the kernels release the GIL).

Not numba's own parallel loops: OpenMP workers spin while they wait, and on a machine with other work
(tracking beside mapping) that made the rasteriser five times slower than these threads.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch

_BLOCKS_PER_THREAD = 4  # blocks of a range differ in work; several a thread even that out


def thread_count() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@cache
def _pool(process_id: int, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rasterise")


def in_blocks(kernel: Callable[..., Any], count: int, *arguments: Any, threads: int | None = None) -> None:
    """Call ``kernel(first, last, *arguments)`` over blocks of 0 … count-1; it must not mind the split."""
    threads = threads or thread_count()
    blocks = min(count, threads * _BLOCKS_PER_THREAD)
    if threads == 1 or blocks < 2:
        kernel(0, count, *arguments)
        return
    pool = _pool(os.getpid(), threads)
    edges = [block * count // blocks for block in range(blocks + 1)]
    futures = [pool.submit(kernel, a, b, *arguments) for a, b in itertools.pairwise(edges)]
    for future in futures:
        future.result()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch on one thread inside the block: its workers would spin on the cores that the kernels need."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
