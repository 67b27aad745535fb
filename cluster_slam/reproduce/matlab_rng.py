"""MATLAB's random streams: `rng(seed, 'twister')` with `rand`, `randn` and `randi`, number for number.

The generator is the Mersenne twister of Matsumoto and Nishimura (1998); `randn` is the ziggurat of Marsaglia and Tsang
(2000) with 256 layers. Which words of the twister go where was inferred from outputs that MathWorks has published.
"""

from __future__ import annotations

from math import exp, log

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array

LAYERS = 256
RADIUS = 3.6541528853610088  # where the tail begins
AREA = 0.00492867323399  # of a layer
DEFAULT_SEED = 5489  # what seed 0 stands for
BLOCK = 1 << 16  # pairs of words drawn at once


def _layers() -> tuple[Array, Array]:
    x = np.zeros(LAYERS + 1)
    x[0], x[1] = AREA / exp(-0.5 * RADIUS**2), RADIUS
    for k in range(2, LAYERS):
        x[k] = np.sqrt(-2.0 * log(AREA / x[k - 1] + exp(-0.5 * x[k - 1] ** 2)))
    return x, np.exp(-0.5 * x * x)


EDGE, HEIGHT = _layers()


class MatlabStream:
    """One stream, as after `rng(seed)`. Arrays fill in column-major order."""

    def __init__(self, seed: int) -> None:
        self._bits = np.random.MT19937()
        state = {"key": _twister_key(seed or DEFAULT_SEED), "pos": 624}
        self._bits.state = {"bit_generator": "MT19937", "state": state}  # type: ignore[typeddict-item]
        self._pairs = np.zeros((0, 2), dtype=np.uint64)  # words not used yet, two by two
        self._at = 0

    def rand(self, *shape: int) -> Array:
        """Uniform numbers in (0, 1), as `rand(shape)`."""
        n = int(np.prod(shape))
        self._need(n)
        out = _uniform(self._pairs[self._at : self._at + n])
        self._at += n
        if (out == 0.0).any():  # once in 2^53
            out = np.concatenate([out[out != 0.0], self.rand(int((out == 0.0).sum()))])
        return out.reshape(shape, order="F")

    def randi(self, low: int, high: int, *shape: int) -> NDArray[np.int64]:
        """Whole numbers from `low` to `high`, as `randi([low high], shape)`."""
        return (low + np.floor(self.rand(*shape) * (high - low + 1))).astype(np.int64)

    def randn(self, *shape: int) -> Array:
        """Standard normal numbers, as `randn(shape)`."""
        n = int(np.prod(shape))
        found: list[Array] = []
        while (missing := n - sum(map(len, found))) > 0:
            found.append(self._normals(missing))
        return np.concatenate([np.zeros(0), *found]).reshape(shape, order="F")

    def _normals(self, n: int) -> Array:
        """At most n normal numbers, at least none: as many as lie in the words at hand."""
        self._need(n)
        start, words = self._at, self._pairs
        x, layer, fast = _tries(words[start : start + n])
        pieces: list[Array] = []
        for slow in np.flatnonzero(~fast).tolist():
            done = self._at - start
            if slow < done:
                continue  # a slow try before it has used this pair
            value = self._take_slow(start + slow + 1, float(x[slow]), int(layer[slow]))
            pieces += [x[done:slow], np.array([value] if value is not None else [])]
            if self._pairs is not words:
                return np.concatenate(pieces)
        pieces.append(x[self._at - start :])
        self._at = max(self._at, start + n)
        return np.concatenate(pieces)

    def _take_slow(self, after: int, x: float, layer: int) -> float | None:
        self._at = after
        return self._slow(x, layer)

    def _slow(self, x: float, layer: int) -> float | None:
        """What becomes of a try that missed its layer's core: the tail, the wedge, or nothing."""
        if layer == 0:
            while True:
                t = -log(self._one()) / RADIUS
                y = -log(self._one())
                if 2.0 * y > t * t:
                    return RADIUS + t if x > 0 else -(RADIUS + t)
        height = HEIGHT[layer] + self._one() * (HEIGHT[layer + 1] - HEIGHT[layer])
        return x if height < exp(-0.5 * x * x) else None

    def _one(self) -> float:
        return float(self.rand(1)[0])

    def _need(self, n: int) -> None:
        missing = n - (len(self._pairs) - self._at)
        if missing > 0:
            fresh = self._bits.random_raw(2 * max(missing, BLOCK)).reshape(-1, 2)
            self._pairs, self._at = np.concatenate([self._pairs[self._at :], fresh]), 0


def _uniform(pairs: NDArray[np.uint64]) -> Array:
    a, b = (pairs[:, 0] >> np.uint64(5)).astype(float), (pairs[:, 1] >> np.uint64(6)).astype(float)
    out: Array = (a * 67108864.0 + b) / 9007199254740992.0
    return out


def _tries(pairs: NDArray[np.uint64]) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Each pair of words as a try: its number, its layer, and whether it lies in the layer's core."""
    a, b = pairs[:, 0].astype(float), pairs[:, 1]
    layer = LAYERS - 1 - (b >> np.uint64(24)).astype(np.int64)
    fraction = (b & np.uint64(0xFFFFFF)).astype(float) / 16777216.0
    x = (2.0 * (a + fraction) / 4294967296.0 - 1.0) * EDGE[layer]
    return x, layer, np.abs(x) < EDGE[layer + 1]


def _twister_key(seed: int) -> NDArray[np.uint32]:
    """The twister's first state (`init_genrand` of its authors)."""
    key = [seed & 0xFFFFFFFF]
    for i in range(1, 624):
        key.append((1812433253 * (key[-1] ^ (key[-1] >> 30)) + i) & 0xFFFFFFFF)
    return np.array(key, dtype=np.uint32)
