"""Make src/mastd3r/networks/weights/people.npy from the file that MediaPipe ships, and say whether it is the same.

usage: python benchmarks/people_weights.py selfie_segmentation.tflite [--out people.npy]

Where that file is from stands in src/mastd3r/networks/weights/README.md. It is a flatbuffer: tables that begin with the
way back to a list of where each of their fields lies.
"""

from __future__ import annotations

import argparse
import hashlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mastd3r.networks.people import WEIGHTS

CONV, DEPTHWISE, DEQUANTIZE, CUSTOM = 3, 4, 6, 32  # TFLite's BuiltinOperator
FLOAT32, FLOAT16 = 0, 1  # and TensorType
DTYPES = {FLOAT32: np.float32, FLOAT16: np.float16}


class Table:
    """One table of a flatbuffer."""

    def __init__(self, data: bytes, at: int) -> None:
        self.data, self.at = data, at
        self._fields = at - struct.unpack_from("<i", data, at)[0]

    def _place(self, field: int) -> int | None:
        size = struct.unpack_from("<H", self.data, self._fields)[0]
        offset = 4 + 2 * field
        found = struct.unpack_from("<H", self.data, self._fields + offset)[0] if offset < size else 0
        return self.at + found if found else None

    def number(self, field: int, layout: str) -> int:
        """A scalar field; 0 where it is not there."""
        place = self._place(field)
        return 0 if place is None else int(struct.unpack_from("<" + layout, self.data, place)[0])

    def array(self, field: int, dtype: Any) -> NDArray[Any]:
        """A vector of numbers."""
        place = self._place(field)
        if place is None:
            return np.zeros(0, dtype)
        start = place + struct.unpack_from("<I", self.data, place)[0]
        return np.frombuffer(self.data, dtype, struct.unpack_from("<I", self.data, start)[0], start + 4)

    def tables(self, field: int) -> list[Table]:
        """A vector of tables."""
        place = self._place(field)
        if place is None:
            return []
        start = place + struct.unpack_from("<I", self.data, place)[0] + 4
        offsets = self.array(field, np.uint32)
        return [Table(self.data, start + 4 * n + int(offset)) for n, offset in enumerate(offsets)]


def weights_of(data: bytes) -> NDArray[np.float16]:
    """Kernel and bias of every convolution of a TFLite model, in the order of execution, as one row of float16."""
    model = Table(data, struct.unpack_from("<I", data, 0)[0])
    codes = [max(c.number(0, "b"), c.number(3, "i")) for c in model.tables(1)]
    graph, buffers = model.tables(2)[0], model.tables(4)
    tensors = graph.tables(0)

    def values(n: int) -> NDArray[Any]:
        tensor = tensors[n]
        return buffers[tensor.number(2, "I")].array(0, np.uint8).view(DTYPES[tensor.number(1, "b")])

    halves: dict[int, int] = {}  # tensor -> the half-precision one that it is made of
    rows: list[NDArray[Any]] = []
    for operator in graph.tables(3):
        code = codes[operator.number(0, "I")]
        inputs = [int(n) for n in operator.array(1, np.int32)]
        if code == DEQUANTIZE:
            halves[int(operator.array(2, np.int32)[0])] = inputs[0]
        elif code in (CONV, DEPTHWISE, CUSTOM):
            rows += [values(halves.get(n, n)) for n in inputs[1:3]]
    flat = np.concatenate([r.astype(np.float32) for r in rows])
    out = flat.astype(np.float16)
    if not np.array_equal(out.astype(np.float32), flat):
        raise SystemExit("expected weights of half precision, got some that are not")
    return out


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    data = args.model.read_bytes()
    found = weights_of(data)
    same = np.array_equal(found, np.load(WEIGHTS))
    print(f"{len(found)} numbers of {args.model.name} ({hashlib.sha256(data).hexdigest()}): "
          f"{'those' if same else 'NOT those'} of {WEIGHTS.name}")  # fmt: skip
    if args.out is not None:
        np.save(args.out, found)
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
