"""Adam with one learning rate a parameter, whose rows may be picked and repeated while it runs."""

from __future__ import annotations

import torch

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15


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
            first, second = self._first[name], self._second[name]
            first.lerp_(grad, 1 - _BETA1)
            second.mul_(_BETA2).addcmul_(grad, grad, value=1 - _BETA2)
            scale = (second / correction2).sqrt_().add_(_EPSILON)
            parameter.addcdiv_(first, scale, value=-rates[name] / correction1)
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
