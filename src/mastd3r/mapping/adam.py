"""Adam with one learning rate a parameter, whose rows may be picked and repeated while it runs."""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

import numpy as np
import torch
from numba import njit

from ..concurrency import in_blocks
from .rasterise_cpu_matrices import JIT

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15
_SMALL = 2**16  # numbers that one thread does sooner than two can be told to


# Without the licences of fast arithmetic: it is held to torch's, and waits for memory anyway.
@njit(**{**JIT, "fastmath": False})
def _update(begin, end, value, grad, first, second, weight1, beta2, weight2, correction2, epsilon, rate):
    """Numbers begin … end-1 of one parameter, its gradient and its moments, all flat float32."""
    p, g, m, v = value[begin:end], grad[begin:end], first[begin:end], second[begin:end]  # from 0, so that it vectorises
    for i in range(len(p)):
        m[i] += weight1 * (g[i] - m[i])
        v[i] = beta2 * v[i] + weight2 * (g[i] * g[i])
        p[i] -= rate * m[i] / (np.sqrt(v[i] / correction2) + epsilon)


def _update_cpu(
    parameter: torch.Tensor,
    grad: torch.Tensor,
    first: torch.Tensor,
    second: torch.Tensor,
    rate: float,
    correction2: float,
) -> None:
    """One pass over the four arrays, where ``_update_torch`` makes seven."""
    flat = [t.detach().view(-1).numpy() for t in (parameter, grad.contiguous(), first, second)]
    numbers = [np.float32(n) for n in (1 - _BETA1, _BETA2, 1 - _BETA2, correction2, _EPSILON, rate)]
    in_blocks(_update, len(flat[0]), *flat, *numbers, threads=1 if len(flat[0]) < _SMALL else None)


def _update_torch(
    parameter: torch.Tensor,
    grad: torch.Tensor,
    first: torch.Tensor,
    second: torch.Tensor,
    rate: float,
    correction2: float,
) -> None:
    first.lerp_(grad, 1 - _BETA1)
    second.mul_(_BETA2).addcmul_(grad, grad, value=1 - _BETA2)
    scale = (second / correction2).sqrt_().add_(_EPSILON)
    parameter.addcdiv_(first, scale, value=-rate)


class RowAdam:
    """Adam (Kingma and Ba 2015) over named tensors; state follows the rows through densification."""

    def __init__(self, parameters: dict[str, torch.Tensor]) -> None:
        self._first = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self._second = {name: torch.zeros_like(p) for name, p in parameters.items()}
        self._steps = 0

    @torch.no_grad()
    def step(self, parameters: dict[str, torch.Tensor], rates: dict[str, float]) -> None:
        """One update in place; parameters without a gradient are left alone. Gradients are cleared."""
        self._steps += 1
        correction1, correction2 = 1 - _BETA1**self._steps, 1 - _BETA2**self._steps
        for name, parameter in parameters.items():
            grad = parameter.grad
            if grad is None:
                continue
            moments = self._first[name], self._second[name]
            plain = parameter.device.type == "cpu" and all(
                t.dtype == torch.float32 and t.is_contiguous() for t in (parameter, *moments)
            )
            update = _update_cpu if plain and grad.dtype == torch.float32 else _update_torch
            update(parameter, grad, *moments, rates[name] / correction1, correction2)
            parameter.grad = None

    def pick(self, rows: torch.Tensor, fresh: torch.Tensor) -> None:
        """Follow ``GaussianMap.picked(rows)``; rows where ``fresh`` is True start with empty moments."""
        for moments in (self._first, self._second):
            for name, tensor in moments.items():
                picked = tensor[rows]
                picked[fresh] = 0
                moments[name] = picked

    def grow(self, count: int) -> None:
        """Follow ``GaussianMap.joined`` with ``count`` new rows at the end, with empty moments."""
        for moments in (self._first, self._second):
            for name, tensor in moments.items():
                moments[name] = torch.cat([tensor, tensor.new_zeros(count, *tensor.shape[1:])])
