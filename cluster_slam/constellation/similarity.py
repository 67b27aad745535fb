"""Similarities in d = 2 or 3 dimensions, in stacks: p' = scale * R p + t."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Similarities:
    """A stack of similarities."""

    R: Array  # (h, d, d)
    t: Array  # (h, d)
    scale: Array  # (h,)

    def __len__(self) -> int:
        return len(self.t)

    def take(self, index: IntArray | BoolArray) -> Similarities:
        """Those of these rows."""
        return Similarities(self.R[index], self.t[index], self.scale[index])

    def apply(self, points: Array) -> Array:
        """Points (n, d) moved by each: (h, n, d)."""
        moved: Array = self.scale[:, None, None] * np.einsum("hij,nj->hni", self.R, points) + self.t[:, None]
        return moved


def concatenate(parts: list[Similarities]) -> Similarities:
    """Stacks one after another."""
    return Similarities(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("R", "t", "scale")))


def align(a: Array, b: Array, scale_range: tuple[float, float], weights: Array | None = None) -> Similarities:
    """Similarities (h) that take point sets a (h, n, d) onto b (h, n, d) with least weighted squares.

    The scale is the least-squares one, clipped to its range (Umeyama 1991, eq. 40 to 43).
    """
    w = np.ones(a.shape[:2]) if weights is None else weights
    w = w / w.sum(axis=1, keepdims=True)
    mean_a, mean_b = np.einsum("hn,hnd->hd", w, a), np.einsum("hn,hnd->hd", w, b)
    da, db = a - mean_a[:, None], b - mean_b[:, None]
    H = np.einsum("hn,hni,hnj->hij", w, da, db)
    return _from_moments(H, np.einsum("hn,hni,hni->h", w, da, da), mean_a, mean_b, scale_range)


def _from_moments(
    H: Array, var_a: Array, mean_a: Array, mean_b: Array, scale_range: tuple[float, float]
) -> Similarities:
    """The solution from cross moments H (h, d, d) of a and b, variance of a, and means."""
    d = H.shape[-1]
    U, S, Vt = np.linalg.svd(H)
    V = np.swapaxes(Vt, 1, 2)
    sign = np.ones((len(H), d))
    sign[:, -1] = np.where(np.linalg.det(V @ np.swapaxes(U, 1, 2)) < 0, -1.0, 1.0)
    R = (V * sign[:, None]) @ np.swapaxes(U, 1, 2)
    low, high = scale_range
    scale = np.clip((S * sign).sum(axis=1) / np.maximum(var_a, 1e-15), low, high)
    t = mean_b - scale[:, None] * np.einsum("hij,hj->hi", R, mean_a)
    return Similarities(R, t, scale)


def from_moments(
    H: Array, var_a: float, mean_a: Array, mean_b: Array, scale_range: tuple[float, float]
) -> Similarities:
    """One similarity from weighted moments: H (d, d) = sum w da db', var_a = sum w |da|^2."""
    return _from_moments(H[None], np.array([var_a]), mean_a[None], mean_b[None], scale_range)
