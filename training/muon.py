"""Steps that turn a layer's weights in all directions alike: more is learned from each picture.

Momentum whose matrix is made orthogonal by five Newton-Schulz steps: K. Jordan and others, "Muon: an optimizer for
hidden layers in neural networks", 2024.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_MOMENTUM = 0.95
_DECAY = 0.01  # of the weights, in units of the rate
_QUINTIC = (3.4445, -4.7750, 2.0315)


def dense_weights(net: nn.Module) -> list[nn.Parameter]:
    """The convolutions that mix channels, but the head: what Muon is for."""
    named = net.named_parameters()
    return [p for name, p in named if p.ndim == 4 and p.shape[1] > 1 and not name.startswith("head")]


class Muon:
    """Momentum, made orthogonal."""

    def __init__(self, weights: list[nn.Parameter]) -> None:
        self.weights = weights
        self._momenta = [torch.zeros_like(p) for p in weights]

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """One step along the gradients; they are empty afterwards."""
        for p, momentum in zip(self.weights, self._momenta, strict=True):
            momentum.mul_(_MOMENTUM).add_(p.grad)
            turned = orthogonal((p.grad + _MOMENTUM * momentum).reshape(p.shape[0], -1))
            wide = max(1.0, turned.shape[0] / turned.shape[1]) ** 0.5
            p.mul_(1 - rate * _DECAY).add_(turned.reshape(p.shape), alpha=-rate * wide)
            p.grad = None


def orthogonal(matrix: Tensor) -> Tensor:
    """About the nearest matrix with orthonormal rows or columns: singular values 0.7 to 1.2."""
    a, b, c = _QUINTIC
    x = matrix / (matrix.norm() + 1e-7)
    is_tall = x.shape[0] > x.shape[1]
    x = x.T if is_tall else x
    for _ in range(5):
        square = x @ x.T
        x = a * x + (b * square + c * square @ square) @ x
    return x.T if is_tall else x
