"""Interlaced video: frames whose even and odd lines were taken one after the other, and one whole image of each.

A file may say that it is interlaced, or its pictures show it. Of three frames in a row, the lines of one field of the
middle frame are laid between the lines of its other field, and so are the same lines of the frame before and of the one
after. Where both fields are of one moment, frames before and after fit equally badly, whatever moves and however. Where
they are not, the top lines of the frame after lie as near in time to the bottom lines as their own (top field first),
or those of the frame before (bottom field first). Sums over the top lines and over the bottom ones, with before and
after exchanged, so that neither acceleration nor noise nor fine horizontal texture tells one order from the other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
LOOKED_AT, ENOUGH = 40, 4  # frames that are looked at, at most; threes of frames with motion that are enough
COLUMNS = 480  # of an image that are looked at
MOVED_LEVELS, MOVED_RATIO = 10, 0.01  # a pixel moves that differs by more, in grey levels; share for a vote
FAR_OVER_NEAR = 1.12  # misfit of the further frame over that of the nearer: 1.00 to 1.02 where fields are of one moment
OWN_OVER_NEAR = 0.7  # misfit of a frame's own lines over that of the nearer frame's: about 1 where it is interlaced
ORDERS = {2: True, 3: False, 4: False, 5: True}  # libavcodec's AVFieldOrder: True where the top field is shown first


@dataclass(frozen=True)
class Interlacing:
    """That a video is interlaced, and how."""

    top_first: bool | None  # None: as the frames themselves say
    flagged: bool  # frames say of themselves whether they are interlaced

    @property
    def note(self) -> str:
        """One line for the notes."""
        order = "" if self.top_first is None else f", {'top' if self.top_first else 'bottom'} field first"
        return f"interlaced{order}{'' if self.flagged else ' (measured, the file does not say so)'}: deinterlaced"


def interlacing_of(frames: Iterable[Any], coded_order: int) -> Interlacing | None:
    """Whether and how a video is interlaced, by its first ``frames`` (av.VideoFrame); None where it is not.

    coded_order: libavcodec's field order of the stream, 0 where it is unknown. The order that is measured goes before
    the one that the file says. Looks at no more than ``LOOKED_AT`` frames, and stops where they have shown enough.
    """
    flagged = coded_order in ORDERS
    votes: list[Array] = []
    three: deque[Array] = deque(maxlen=3)
    for frame in islice(frames, LOOKED_AT):
        flagged = flagged or bool(getattr(frame, "interlaced_frame", False))
        luma = frame.reformat(format="gray").to_ndarray()
        if three and luma.shape[0] != three[-1].shape[0]:
            three.clear()
        three.append(luma[:, :: -(-luma.shape[1] // COLUMNS)])
        if len(three) == 3 and (vote := misfits(*three)) is not None:
            votes.append(vote)
        if len(votes) == ENOUGH:
            break
    top_first = _order(votes)
    if not flagged:
        return None if top_first is None else Interlacing(top_first, flagged=False)
    return Interlacing(ORDERS.get(coded_order) if top_first is None else top_first, flagged=True)


def misfits(before: Array, now: Array, after: Array) -> Array | None:
    """(3,) how badly lines lie between those of the other field of ``now``, summed over what moves.

    Lines of a frame half a frame away if the top field is first; half a frame away if the bottom field is first; the
    frame's own. Images (h, w) uint8. None where too little moves.
    """
    height = now.shape[0] // 2 * 2
    before, now, after = (image[:height].astype(np.int16) for image in (before, now, after))
    top, bottom = slice(0, None, 2), slice(1, None, 2)
    between = (now[bottom][:-1] + now[bottom][1:], now[top][:-1] + now[top][1:])  # at the place of top, bottom lines

    def inner(image: Array, parity: int) -> Array:
        return image[top][1:] if parity == 0 else image[bottom][:-1]

    moved = [np.abs(inner(after, p) - inner(before, p)) > MOVED_LEVELS for p in (0, 1)]
    if height < 4 or np.mean([m.mean() for m in moved]) < MOVED_RATIO:
        return None

    def misfit(image: Array, parity: int) -> float:
        off: Array = np.abs(between[parity] - 2 * inner(image, parity))
        return float(off.sum(where=moved[parity], dtype=np.float64))

    return np.array(
        [
            misfit(after, 0) + misfit(before, 1),
            misfit(before, 0) + misfit(after, 1),
            misfit(now, 0) + misfit(now, 1),
        ]
    )


def _order(votes: list[Array]) -> bool | None:
    """True where the top field is first, False where the bottom is, None where the video is not seen to be interlaced.

    Together the votes must be clear, and no more than one in four against it.
    """
    if not votes:
        return None
    total = np.sum(votes, axis=0)
    near = int(np.argmin(total[:2]))
    agreeing = np.mean([v[near] < v[1 - near] for v in votes])
    far_ratio, own_ratio = (total[k] / max(float(total[near]), 1.0) for k in (1 - near, 2))
    if far_ratio < FAR_OVER_NEAR or own_ratio < OWN_OVER_NEAR or agreeing < 0.75:
        return None
    return near == 0


def deinterlaced(items: Iterable[Any], interlacing: Interlacing) -> Iterator[Any]:
    """The items (dataclasses) with their ``frame`` (av.VideoFrame) deinterlaced: as many, in order, one item later.

    libavfilter's bwdif: the lines of the field that is shown first stay, those between are made of them and of the
    fields before and after.
    """
    waiting: deque[Any] = deque()
    graph, form = None, None
    for item in items:
        frame = item.frame
        if graph is None or (frame.width, frame.height, frame.format.name) != form:
            if graph is not None:
                yield from _given(graph, waiting, last=True)
            graph, form = _filter(frame, interlacing), (frame.width, frame.height, frame.format.name)
        waiting.append(item)
        graph.push(frame)
        yield from _given(graph, waiting)
    if graph is not None:
        yield from _given(graph, waiting, last=True)


def _filter(frame: Any, interlacing: Interlacing) -> Any:
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base or av.time_base
    )
    parity = {True: "tff", False: "bff", None: "auto"}[interlacing.top_first]
    which = "interlaced" if interlacing.flagged else "all"
    bwdif, sink = graph.add("bwdif", f"mode=send_frame:parity={parity}:deint={which}"), graph.add("buffersink")
    source.link_to(bwdif)
    bwdif.link_to(sink)
    graph.configure()
    return graph


def _given(graph: Any, waiting: deque[Any], *, last: bool = False) -> Iterator[Any]:
    """What the filter gives by now, each to the item that has waited longest."""
    if last:
        graph.push(None)
    while waiting:
        try:
            frame = graph.pull()
        except (av.BlockingIOError, av.EOFError):
            return
        yield replace(waiting.popleft(), frame=frame)
