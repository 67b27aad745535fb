"""The observations of a session, sorted by frame, and small linear algebra on stacks of 3 x 3 covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, skew
from cluster_slam.records import BoolArray, IntArray, Observations


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Observations in the order of their frames.

    ``order`` (m,) leads back to the input's rows: ``sorted[i]`` is row ``order[i]``; ``starts`` (n + 1,) bounds frames.
    """

    order: IntArray
    starts: IntArray
    frame: IntArray  # (m,)
    points: Array  # (m, 3) camera frame, m
    covs: Array  # (m, 3, 3) camera frame, m^2
    stamps: Array  # (n,) s

    @property
    def n_frames(self) -> int:
        return len(self.starts) - 1

    def __len__(self) -> int:
        return len(self.frame)

    def of(self, i: int) -> slice:
        """The observations of frame i."""
        return slice(int(self.starts[i]), int(self.starts[i + 1]))

    def only(self, which: BoolArray) -> Frames:
        """The same with some of the observations (m,), in all frames."""
        frame = self.frame[which]
        return Frames(
            order=self.order[which],
            starts=np.searchsorted(frame, np.arange(self.n_frames + 1)),
            frame=frame,
            points=self.points[which],
            covs=self.covs[which],
            stamps=self.stamps,
        )

    def reversed(self) -> Frames:
        """The same session played backwards (frame n - 1 first); time runs from zero again."""
        n = self.n_frames
        order = np.argsort(n - 1 - self.frame, kind="stable")
        counts = np.diff(self.starts)[::-1]
        return Frames(
            order=order,
            starts=np.concatenate([[0], np.cumsum(counts)]),
            frame=(n - 1 - self.frame)[order],
            points=self.points[order],
            covs=self.covs[order],
            stamps=self.stamps[-1] - self.stamps[::-1],
        )


def sort_by_frame(observations: Observations, stamps: Array) -> Frames:
    """Sort the observations of a session by frame; within a frame the input's order is kept."""
    order = np.argsort(observations.frame, kind="stable")
    frame = observations.frame[order]
    return Frames(
        order=order,
        starts=np.searchsorted(frame, np.arange(len(stamps) + 1)),
        frame=frame,
        points=observations.points[order],
        covs=observations.covs[order],
        stamps=stamps,
    )


def field_of_view(frames: Frames, quantile: float = 0.002) -> tuple[Array, Array]:
    """Bounds (3,), (3,) of x / z, y / z and z in which flowers were seen at all, with a little more in depth."""
    p = frames.points
    if len(p) == 0:
        return np.zeros(3), np.zeros(3)
    rays = np.column_stack([p[:, 0] / p[:, 2], p[:, 1] / p[:, 2], p[:, 2]])
    return np.quantile(rays, quantile, axis=0), np.quantile(rays, 1.0 - quantile, axis=0)


def view_volume(frames: Frames) -> float:
    """How much space one look holds, m^3: the field of view at the usual depth, as deep as that depth."""
    if len(frames) == 0:
        return 1.0
    low, high = field_of_view(frames)
    depth = float(np.median(frames.points[:, 2]))
    width, height = np.maximum(high - low, 0.1)[:2] * depth
    return float(width * height * depth)


def point_jacobian(R: Array, points: Array) -> Array:
    """d (T exp(z) c) / d z at z = 0, (..., 3, 6), for rotations R (..., 3, 3) of T and camera points c (..., 3)."""
    return np.concatenate([-R @ skew(points), np.broadcast_to(R, (*points.shape[:-1], 3, 3))], axis=-1)


def adjugate(S: Array) -> tuple[Array, Array]:
    """Adjugates (..., 3, 3) and determinants (...) of symmetric matrices (..., 3, 3)."""
    a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 0, 2]
    d, e, f = S[..., 1, 1], S[..., 1, 2], S[..., 2, 2]
    A = np.empty_like(S)
    A[..., 0, 0], A[..., 1, 1], A[..., 2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
    A[..., 0, 1] = A[..., 1, 0] = c * e - b * f
    A[..., 0, 2] = A[..., 2, 0] = b * e - c * d
    A[..., 1, 2] = A[..., 2, 1] = b * c - a * e
    return A, a * A[..., 0, 0] + b * A[..., 0, 1] + c * A[..., 0, 2]


def information(S: Array) -> Array:
    """Inverses (..., 3, 3) of well-scaled positive definite covariances, in closed form (hot path)."""
    A, det = adjugate(S)
    return A / det[..., None, None]


def chi2_and_log_det(innovation: Array, S: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distances and log determinants (...) of innovations (..., 3) under S (..., 3, 3)."""
    A, det = adjugate(S)
    chi2 = np.einsum("...i,...ij,...j->...", innovation, A, innovation) / det
    return chi2, np.log(det)
