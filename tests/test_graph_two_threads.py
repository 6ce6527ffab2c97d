"""Work on two threads: the order of the items, and which thread makes which, are always the same."""

from __future__ import annotations

import threading
import time

import pytest

from mastd3r.concurrency import on_two_threads


@pytest.mark.parametrize("slow", [0, 1])
@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_every_other_item_is_made_beside_however_long_the_others_take(count: int, slow: int) -> None:
    def make(item: int) -> tuple[int, bool]:
        if item % 2 == slow:
            time.sleep(0.02)
        return 10 * item, threading.current_thread() is threading.main_thread()

    assert on_two_threads(make, range(count)) == [(10 * n, n % 2 == 0) for n in range(count)]


@pytest.mark.parametrize("bad", [2, 3])
def test_what_is_raised_for_an_item_reaches_the_caller(bad: int) -> None:
    def make(item: int) -> int:
        if item == bad:
            raise ValueError(f"item {item}")
        return item

    with pytest.raises(ValueError, match=f"item {bad}"):
        on_two_threads(make, range(5))
    assert on_two_threads(make, [0, 1]) == [0, 1]
