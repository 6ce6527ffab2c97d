"""Work beside the main loop: what is made ahead is what would have been made in turn."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from mastd3r import pipeline
from mastd3r.concurrency import Future, Worker, one_blas_thread, prefetch
from mastd3r.config import Config
from mastd3r.errors import SlamError
from mastd3r.parts import parts_of
from mastd3r.tracking.observation import Observer
from mastd3r.types import WorkFrame
from test_pointmap_mast3r import TrueNetwork, photograph, provider_of


def test_items_come_in_order_each_worked_on_before_it_is_given() -> None:
    done: list[tuple[int, str]] = []
    threads = set()

    def work(item: int, said: str) -> None:
        threads.add(threading.get_ident())
        done.append((item, said))

    turn, given = ["start"], []
    for item in prefetch(iter(range(5)), work, lambda: turn[0]):
        assert item in [n for n, _ in done]
        given.append(item)
        turn[0] = f"after {item}"
    assert given == [0, 1, 2, 3, 4]
    assert done == [(0, "start"), (1, "start"), (2, "after 0"), (3, "after 1"), (4, "after 2")]
    assert threading.get_ident() not in threads and len(threads) == 1


def test_an_error_comes_when_its_item_is_asked_for() -> None:
    def items() -> Iterator[int]:
        yield 0
        yield 1
        raise OSError("the file ends here")

    def work(item: int, _: None) -> None:
        if item == 1 and bad:
            raise ValueError("item 1 is no good")

    for bad, kind, expected in ((False, OSError, [0, 1]), (True, ValueError, [0])):
        seen = []
        with pytest.raises(kind):
            for item in prefetch(items(), work, lambda: None):
                seen.append(item)
        assert seen == expected


def test_values_are_made_in_order_and_errors_are_raised_at_get() -> None:
    beside, made = Worker("test"), []
    values = [beside.submit(lambda n=n: made.append(n) or n) for n in range(20)]  # type: ignore[func-returns-value,misc]
    assert [v.get() for v in values] == made == list(range(20))
    broken = beside.submit(lambda: 1 // 0)
    assert Future.done(3).get() == 3
    with pytest.raises(ZeroDivisionError):
        broken.get()


def test_leaving_waits_for_what_was_given() -> None:
    made: list[int] = []
    with pytest.raises(KeyError), Worker("test") as beside:
        beside.submit(lambda: (time.sleep(0.05), made.append(1)))
        raise KeyError("here")
    assert made == [1]


@pytest.mark.parametrize("prefetches_pairs", [False, True])
def test_frames_seen_ahead_are_those_seen_in_turn(prefetches_pairs: bool) -> None:
    """The keyframe changes at the third frame: what was decoded beside the old one is not used."""
    frames = [photograph(t) for t in (0.0, 0.2, 0.4, 0.6, 0.8)]
    outcome = []
    for looks_ahead in (True, False):
        network = TrueNetwork()
        provider = provider_of(network, prefetches_pairs=prefetches_pairs)
        observer = Observer(parts_of(provider, Config()))
        keyframe: list[WorkFrame | None] = [None]

        def near(keyframe: list[WorkFrame | None] = keyframe) -> object:
            followed = keyframe[0]
            return lambda _: followed

        works = []
        for frame in observer.prefetched(iter(frames), near) if looks_ahead else iter(frames):  # type: ignore[arg-type]
            works.append(observer.observe(frame, keyframe[0]).work)
            if frame.index in (0, 4):
                keyframe[0] = works[-1]
        outcome.append((works, network.encoded, network.decoded))
    (one, encoded, decoded), (other, encoded_too, decoded_too) = outcome
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.own_inv_depth, b.own_inv_depth)
        np.testing.assert_array_equal(a.gray, b.gray)
    assert encoded == encoded_too == 5 and decoded_too == 5
    assert decoded == (6 if prefetches_pairs else 5)  # one was beside the keyframe of before


def blas_threads() -> list[int]:
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]


def test_blas_computes_in_the_thread_that_calls_it_and_gets_its_own_back() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        with one_blas_thread():
            assert set(blas_threads()) == {1}
        assert max(blas_threads()) == 2


def test_a_run_has_one_blas_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Stopped(SlamError):
        pass

    seen = []

    def job(*_: object) -> None:
        seen.extend(blas_threads())
        raise Stopped

    monkeypatch.setattr(pipeline, "_slam_of", job)
    for call in (pipeline.reconstruct, pipeline.material_for_map):
        with threadpool_limits(limits=2, user_api="blas"), pytest.raises(Stopped):
            call(tmp_path, tmp_path / "out", Config())
    assert set(seen) == {1}
