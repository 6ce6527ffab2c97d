"""The same work on many items, on two threads, with a result that does not depend on which thread was faster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

S = TypeVar("S")
T = TypeVar("T")
_BESIDE = ThreadPoolExecutor(1, "every other")


def on_two_threads(make: Callable[[S], T], items: Sequence[S]) -> list[T]:
    """``make`` of every item, in order; every other one is made in a thread beside, always the same ones.

    So what a thread keeps from item to item (a flow engine's memory) is the same in every run. ``make`` must not call
    this again: there is one thread beside.
    """
    beside = _BESIDE.submit(lambda: [make(item) for item in items[1::2]])
    here = [make(item) for item in items[::2]]
    out: list[Any] = [None] * len(items)
    out[::2], out[1::2] = here, beside.result()
    return out
