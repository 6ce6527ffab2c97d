"""Videos that are stored lying on their side: the quarter turn or mirroring that their metadata ask for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Turn = tuple[int, int, int, int]  # row-major 2x2 of 0, 1, -1: (x, y) as stored to (x, y) as shown
UPRIGHT: Turn = (1, 0, 0, 1)


def turn_of(display_matrix: bytes) -> Turn:
    """Nearest turn by quarters (with mirroring) of a 3x3 display matrix: nine int32, 16.16 fixed point.

    The file stores [a b u; c d v; x y w] for x' = a x + c y, y' = b x + d y (ISO/IEC 14496-12, tkhd).
    """
    a, b, _, c, d = np.frombuffer(display_matrix, np.int32)[:5].astype(np.int64)
    if max(abs(a), abs(d)) >= max(abs(b), abs(c)):
        return (-1 if a < 0 else 1, 0, 0, -1 if d < 0 else 1)
    return (0, -1 if c < 0 else 1, -1 if b < 0 else 1, 0)


def turned(image: Array, turn: Turn) -> Array:
    """(h, w, 3) as stored to (h, w, 3) or (w, h, 3) as shown."""
    if turn[0] == 0:
        image = image.transpose(1, 0, 2)
    if turn[0] + turn[1] < 0:
        image = image[:, ::-1]
    if turn[2] + turn[3] < 0:
        image = image[::-1]
    return np.ascontiguousarray(image)


def turn_of_frame(frame: Any) -> Turn:
    """The turn that a frame asks for. Only for the first: a frame whose side data was read is freed late."""
    matrix = frame.side_data.get("DISPLAYMATRIX")  # by name: what iterating gives is another thing since PyAV 19
    return UPRIGHT if matrix is None else turn_of(bytes(matrix))
