"""The next items are made ready while the caller works on the one it was given; results do not depend on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
C = TypeVar("C")


def ahead(items: Iterator[T], work: Callable[[T, C], None], context: Callable[[], C]) -> Iterator[T]:
    """The items, in order; ``work`` is done on each, in one other thread, before it is given.

    ``work`` also gets what ``context`` says, in the caller's thread, when the item before is given. What is raised for
    an item is raised when the caller asks for it.
    """
    end = object()

    def one(given: C) -> T | object:
        item = next(items, end)
        if item is not end:
            work(item, given)  # type: ignore[arg-type]
        return item

    with ThreadPoolExecutor(1, "ahead") as pool:
        job = pool.submit(one, context())
        while (item := job.result()) is not end:
            job = pool.submit(one, context())
            yield item  # type: ignore[misc]
