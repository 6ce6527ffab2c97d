"""Work beside the main loop: the next items made ready, values in the making. Results do not depend on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Generic, TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")
C = TypeVar("C")


class Later(Generic[T]):
    """A value that may still be in the making; ``get`` waits for it, and raises what its making raised."""

    def __init__(self, get: Callable[[], T]) -> None:
        self.get = get

    @staticmethod
    def known(value: T) -> Later[T]:
        """One that is there."""
        return Later(lambda: value)


class Beside:
    """One thread beside the caller's: what is given to it is done in order."""

    def __init__(self, name: str) -> None:
        self._pool = ThreadPoolExecutor(1, name)

    def later(self, make: Callable[[], T]) -> Later[T]:
        """The value of ``make``, made there."""
        return Later(self._pool.submit(make).result)

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *_: object) -> None:
        """Waits for all that was given to it."""
        self._pool.shutdown()


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


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it BLAS computes in the thread that calls it, whatever library brought it.

    Our products are small and many: BLAS's own threads would spin between them on the cores that our threads need,
    which costs more than half of the processor's time on two cores.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        yield
