"""How float32 products may round while a network runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock

import torch

_ONE_AT_A_TIME = RLock()  # the setting is the process's, and networks run in several threads


@contextmanager
def products(dtype: torch.dtype) -> Iterator[None]:
    """Exact for a network in float32. For one in half precision, what is left in float32 (the heads) may round to
    TF32 on a device that has it. The process's own setting is put back."""
    rounds = dtype != torch.float32
    with _ONE_AT_A_TIME:
        before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
        torch.set_float32_matmul_precision("high" if rounds else "highest")
        torch.backends.cudnn.allow_tf32 = rounds
        try:
            yield
        finally:
            torch.set_float32_matmul_precision(before[0])
            torch.backends.cudnn.allow_tf32 = before[1]
