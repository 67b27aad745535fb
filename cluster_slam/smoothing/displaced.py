"""Displacements of clusters as they were measured, as series over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import Frames, information, point_jacobian
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

FEWEST = 30  # products that make a covariance


@dataclass(frozen=True, slots=True, eq=False)
class Displaced:
    """Measured displacements d (p, 3) m of clusters (p,) in frames (p,) at ``stamps`` (n,) s, with noise cov (p, 3, 3).

    ``share`` (p,) of a displacement's square is left in d, the rest went into the frame's pose; ``scale`` (p,) m is how
    far each cluster is known to have swung around that time, zero where it is not known to have moved.
    """

    d: Array
    cov: Array
    share: Array
    scale: Array
    frame: IntArray
    cluster: IntArray
    stamps: Array

    @property
    def noise(self) -> Array:
        """Mean variance (p,) of the measurements along any axis, m^2."""
        noise: Array = np.trace(self.cov, axis1=1, axis2=2) / 3.0
        return noise


class Series:
    """Displacements as series (n, c, 3) with weights (n, c), zero where unseen."""

    def __init__(self, moved: Displaced, which: BoolArray, weight: Array) -> None:
        """Of ``which`` (p,) displacements, each with its ``weight`` (p,)."""
        frame, cluster, w, n = moved.frame[which], moved.cluster[which], weight[which], len(moved.stamps)
        shape = (n, int(moved.cluster.max(initial=0)) + 1)
        self.dt = float(np.median(np.diff(moved.stamps))) if n > 1 else 1.0
        self.values, self.weight, self.kept = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
        self.values[frame, cluster] = moved.d[which] * w[:, None]
        self.weight[frame, cluster] = w
        self.kept[frame, cluster] = np.sqrt(moved.share[which]) * w
        # Places were fitted to the same displacements: noise of theirs is missing in each product.
        information = np.bincount(cluster, 1.0 / moved.noise[which], shape[1])
        self.fitted = 1.0 / np.maximum(information, 1e-12)

    def own_covariance(self, lag: int) -> tuple[float, float]:
        """The same without what all clusters have in common: that is an error of the pose, or of the mounting."""
        value, count = self.covariance(lag)
        if lag >= len(self.values):
            return value, count
        early, late = self.values[:-lag], self.values[lag:]
        kept_early, kept_late = self.kept[:-lag], self.kept[lag:]
        same = float((kept_late * kept_early).sum())
        both = float((kept_early.sum(axis=1) * kept_late.sum(axis=1)).sum()) - same
        product = float((early.sum(axis=1) * late.sum(axis=1)).sum()) - float((early * late).sum())
        common = product / (3.0 * both) if both >= same > 0.0 else value  # one cluster alone cannot tell
        return value - max(common, 0.0), count

    def covariance(self, lag: int) -> tuple[float, float]:
        """Mean product along any axis of displacements ``lag`` frames apart, and how many products that is."""
        if lag >= len(self.values):
            return 0.0, 0.0
        early, late = self.weight[:-lag], self.weight[lag:]
        count = float(((early > 0) & (late > 0)).sum())
        kept = float((self.kept[lag:] * self.kept[:-lag]).sum())
        missing = 3.0 * float(((early * late).sum(axis=0) * self.fitted).sum())
        return (float((self.values[lag:] * self.values[:-lag]).sum()) + missing) / max(3.0 * kept, 1e-30), count


def taken_by_poses(
    frames: Frames, T: Array, of: IntArray, frame: IntArray, cov: Array, cov_pose: Array
) -> tuple[Array, Array]:
    """What displacements lose where their frames' poses were solved from the same flowers.

    A pose has six unknowns, five clusters have fifteen coordinates. Of a frame's displacements d stays
    ``d - H G H' W d``, with H the Jacobians by the pose, W the weights and G the covariance of the pose.

    Parameters
    ----------
    T : (n, 4, 4) camera poses.
    of : (m,) displacement that each observation shows, -1 none.
    frame, cov : (p,), (p, 3, 3) frame and noise of each displacement.
    cov_pose : (6, 6) how well each pose is known without its flowers, camera tangent.

    Returns
    -------
    Share (p,) of the square of each displacement that is left, and covariance (p, 3, 3) of the noise that is left.
    """
    used, p = of >= 0, len(frame)
    count = np.bincount(of[used], minlength=p)[:, None]
    middle = np.stack([np.bincount(of[used], x, p) for x in frames.points[used].T], axis=-1) / count
    H = point_jacobian(T[frame, :3, :3], middle)
    HW = np.swapaxes(H, 1, 2) @ information(cov)
    known = np.linalg.inv(cov_pose)
    normal, square = np.tile(known, (frames.n_frames, 1, 1)), np.zeros((frames.n_frames, 6, 6))
    np.add.at(normal, frame, HW @ H)
    np.add.at(square, frame, HW @ np.swapaxes(HW, 1, 2))
    G = np.linalg.inv(normal)[frame]
    GH = G @ np.swapaxes(H, 1, 2)
    lost = 2.0 * np.einsum("pai,pai->p", GH, HW) - np.einsum("pai,pab,pbi->p", GH, square[frame], GH)
    return np.clip(1.0 - lost / 3.0, 0.0, 1.0), cov - H @ GH
