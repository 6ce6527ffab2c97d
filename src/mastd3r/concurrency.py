"""Every thread of the package: values in the making, items made ready ahead, work in two threads or in blocks.

Results never depend on which thread was faster. And what a request to stop must not cut in two (``undivided``)."""

from __future__ import annotations

import ctypes
import itertools
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any, Generic, TypeVar

from threadpoolctl import ThreadpoolController

T = TypeVar("T")
C = TypeVar("C")


class Future(Generic[T]):
    """A value that may still be in the making; ``get`` waits for it, and raises what its making raised.

    ``ready`` says whether it is there; who goes by that has results that depend on the machine's speed.
    """

    def __init__(self, get: Callable[[], T], ready: Callable[[], bool] = lambda: True) -> None:
        self.get, self.ready = get, ready

    @staticmethod
    def done(value: T) -> Future[T]:
        """One that is there."""
        return Future(lambda: value)

    @staticmethod
    def lazy(make: Callable[[], T]) -> Future[T]:
        """One that is made, once, in the thread that asks for it first."""
        made: list[T] = []
        one_at_a_time = threading.Lock()

        def get() -> T:
            with one_at_a_time:
                if not made:
                    made.append(make())
                return made[0]

        return Future(get)


class Worker:
    """One thread beside the caller's: what is given to it is done in order."""

    def __init__(self, name: str) -> None:
        self._pool = ThreadPoolExecutor(1, name)

    def submit(self, make: Callable[[], T]) -> Future[T]:
        """The value of ``make``, made there."""
        made = self._pool.submit(make)
        return Future(made.result, made.done)

    def close(self) -> None:
        """Wait for all that was given to it, and end it."""
        self._pool.shutdown()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def prefetch(items: Iterator[T], work: Callable[[T, C], None], context: Callable[[], C]) -> Iterator[T]:
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


class Newest(Generic[T]):
    """A slot of one, filled from an iterator by a thread of its own: whoever takes gets the newest item.

    What is not taken before the next one comes is dropped, and counted: nothing waits in a queue. The thread is not
    waited for at the end of the process, since who reads a camera may wait for it for ever.
    """

    def __init__(self, items: Iterator[T], name: str) -> None:
        self._items, self._change = items, threading.Condition()
        self._slot: list[T] = []
        self._over, self._closed = False, False
        self._error: BaseException | None = None
        self.came = self.dropped = 0
        self._thread = threading.Thread(target=self._read, name=name, daemon=True)
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether nothing comes any more: the iterator has ended, and its last item was taken."""
        with self._change:
            return self._over and not self._slot

    def take(self, timeout_s: float) -> T | None:
        """The newest item; None where none has come in so long, or none comes any more (``over``).

        Raises what the iterator raised, once its last item was taken.
        """
        with self._change:
            self._change.wait_for(lambda: self._slot or self._over, timeout_s)
            if self._slot:
                return self._slot.pop()
            if self._error is not None:
                error, self._error = self._error, None
                raise error
            return None

    def close(self, timeout_s: float = 1.0) -> None:
        """Take nothing more: the thread ends at its next item, which is waited for no longer than that."""
        with self._change:
            self._closed = True
            self._slot.clear()
        self._thread.join(timeout_s)

    def _read(self) -> None:
        try:
            for item in self._items:
                with self._change:
                    if self._closed:
                        return
                    self.came += 1
                    self.dropped += len(self._slot)
                    self._slot[:] = [item]
                    self._change.notify()
        except BaseException as e:  # noqa: BLE001  whoever takes is told
            self._error = e
        finally:
            with self._change:
                self._over = True
                self._change.notify()


class _BlasLimit:
    """Holds BLAS to one thread for whoever is inside, in whichever order they come and go.

    Some builds of OpenBLAS keep the number for every calling thread, others for the process: what one thread found is
    given back in that thread, and the last one out leaves what there was before the first.
    """

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._first: list[int] = []  # threads of the libraries before anybody was inside
        self._libraries: list[Any] = []
        self._modules = 0  # there were when the libraries were looked for, which takes 3 ms

    def enter(self) -> tuple[list[Any], list[int]]:
        """The libraries, and the threads that they had for this caller."""
        with self._lock:
            if self._modules != len(sys.modules):  # whoever brings another library has imported something
                self._modules = len(sys.modules)
                self._libraries = ThreadpoolController().select(user_api="blas").lib_controllers
            libraries = self._libraries
            found = [library.num_threads for library in libraries]
            if self._inside == 0:
                self._first = found
            self._inside += 1
            for library in libraries:
                library.set_num_threads(1)
            return libraries, found

    def leave(self, libraries: list[Any], found: list[int]) -> None:
        with self._lock:
            self._inside -= 1
            before = self._first if self._inside == 0 and len(self._first) == len(found) else found
            for library, threads in zip(libraries, before, strict=True):
                library.set_num_threads(threads)


_BLAS = _BlasLimit()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it BLAS computes in the thread that calls it, whatever library brought it.

    Our products are small and many: BLAS's own threads would spin between them on the cores that our threads need,
    which costs more than half of the processor's time on two cores.
    """
    entered = _BLAS.enter()
    try:
        yield
    finally:
        _BLAS.leave(*entered)


S = TypeVar("S")
_BESIDE = ThreadPoolExecutor(1, "every other")


_HALVES = ThreadPoolExecutor(2, "halves")


def in_halves(make: Callable[[slice], T], count: int) -> list[T]:
    """``make`` of the first and of the second half of 0 … count-1, at once. It must not call this again."""
    return list(_HALVES.map(make, (slice(None, count // 2), slice(count // 2, None))))


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


@cache
def _allocator() -> Any:
    """The C library whose heap can be trimmed; None elsewhere than under glibc."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        return ctypes.CDLL("libc.so.6") if hasattr(ctypes.CDLL("libc.so.6"), "malloc_trim") else None
    except OSError:  # musl
        return None


def give_back_memory() -> None:
    """Free memory between what is kept goes back to the system, where the allocator can.

    Threads that make short-lived arrays beside long-lived ones leave holes: on a long video as much as all keyframes.
    """
    library = _allocator()
    if library is not None:
        library.malloc_trim(0)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch on one thread inside the block: its workers would spin on the cores that the kernels need."""
    import torch  # heavy, and needed by those alone who have it already

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Stop:
    """A request to stop that waits for the end of what must not be divided."""

    inside = 0
    waiting: BaseException | None = None


def stop_with(error: BaseException) -> None:
    """Raise ``error`` in the main thread, whose signal handler calls this: at once, or at the end of ``undivided``.

    Who asks again while the first request waits is served at once.
    """
    if _Stop.inside and _Stop.waiting is None:
        _Stop.waiting = error
        return
    _Stop.waiting = None
    raise error


@contextmanager
def undivided() -> Iterator[None]:
    """A request to stop that comes within the block is raised at its end, so that what it changes is left whole."""
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's alone
        yield
        return
    _Stop.inside += 1
    try:
        yield
    finally:
        _Stop.inside -= 1
        error = _Stop.waiting
        if _Stop.inside == 0 and error is not None:
            _Stop.waiting = None
            raise error
