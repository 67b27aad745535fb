"""One pose refined: who is who, then Gauss-Newton with a displacement that the flowers of each cluster share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, se3_exp, skew, transform
from cluster_slam.localisation import sway
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.scene import ErrorScale, Look, covs_at
from cluster_slam.localisation.shifts import settled
from cluster_slam.records import BoolArray, IntArray
from tracking.assignment import assign
from tracking.gating import mahalanobis_sq, matching_log_likelihood

GATE_CHI2 = 16.3  # 3 degrees of freedom: 99.9 % of true matches
LOG_2PI = float(np.log(2.0 * np.pi))
_STILL = 1e-6  # squared step over its covariance, and relative change of weights, below which the solution stands


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose with its matches: point ``rows[k]`` is flower ``flowers[k]`` (both (m,))."""

    T_map_camera: Array  # (4, 4)
    information: Array  # (6, 6) of the tangent on the right
    rows: IntArray
    flowers: IntArray
    offsets: Array  # (c, 3) displacement of each of the clusters seen, map, m
    offset_vars: Array  # (c,) posterior variance of a displacement, mean over the axes, m^2
    clusters: IntArray  # (c,) which they are
    swinging: Array  # (c,) probability that each was touched of late
    chi2: Array  # (m,) of each matched point, its cluster's displacement taken out
    log_likelihood: float  # of the matched points at the best pose, displacements integrated out
    redundancy: float  # of the points' errors: what the sum of chi2 would be, were their covariances true

    @property
    def cov(self) -> Array:
        """Covariance (6, 6) of the tangent; infinite where the points do not determine the pose."""
        if np.linalg.eigvalsh(self.information)[0] < 1e-6:
            return np.full((6, 6), np.inf)
        half = np.linalg.solve(self.information, np.eye(6))
        out: Array = 0.5 * (half + half.T)
        return out


def point_jacobian(R: Array, points: Array) -> Array:
    """Derivative (n, 3, 6) of the points in the map by the tangent of the camera pose."""
    return np.concatenate([-R @ skew(points), np.broadcast_to(R, (len(points), 3, 3))], axis=-1)


def associate(
    look: Look, marks: Landmarks, T: Array, pose_cov: Array | None, scale: ErrorScale, null_density: float
) -> tuple[IntArray, IntArray]:
    """Points (m,) and flowers (m,) matched one to one, with all that is uncertain in the gate.

    A point is left alone where a flower that the map does not have (``null_density``, 1/m^3) explains it better.
    """
    R = T[:3, :3]
    seen = transform(T, look.points)
    pose = np.zeros((len(look), 3, 3))
    if pose_cov is not None:
        J = point_jacobian(R, look.points)
        pose = J @ pose_cov @ np.swapaxes(J, 1, 2)
    point_cov = R @ look.covs @ R.T + pose
    shared = marks.shared_covs + scale.sway_m**2 * np.eye(3)
    largest = np.sqrt(GATE_CHI2 * (np.trace(point_cov, axis1=1, axis2=2).max() + 3.0 * _largest(marks, shared)))
    own = R @ look.covs @ R.T
    drifted = marks.drifted(scale.sway_m)
    if drifted.any():
        places, covs, free = _settled(marks, seen, own.mean(0), pose, shared, drifted, null_density)
    else:
        places, covs, free = marks.positions, marks.covs + shared[marks.cluster], np.ones(len(marks), bool)
    off = seen[:, None] - places
    i, j = np.nonzero(((off**2).sum(-1) < largest**2) & free)
    if len(i) == 0:
        return i, j
    innovation = off[i, j]
    S = np.where(drifted[marks.cluster[j], None, None], own[i], point_cov[i]) + covs[j]
    d2 = mahalanobis_sq(innovation, S)
    likelihood = matching_log_likelihood(innovation, S)
    near, column = np.unique(j, return_inverse=True)
    cost = np.full((len(look), len(near)), np.inf)
    cost[i, column] = np.where(d2 < GATE_CHI2, -likelihood, np.inf)
    rows, columns = assign(cost, -float(np.log(null_density)))
    return rows, near[columns]


def _settled(
    marks: Landmarks, seen: Array, point_cov: Array, pose_covs: Array, shared: Array, drifted: BoolArray, density: float
) -> tuple[Array, Array, BoolArray]:
    """The clusters that have drifted, settled; what the pose errs by at each is that at the point nearest."""
    nearest = ((seen - marks.centres[:, None]) ** 2).sum(-1).argmin(1)
    with_pose = shared + np.where(drifted[:, None, None], pose_covs[nearest], 0.0)
    return settled(seen, point_cov, marks.positions, marks.covs, marks.cluster, with_pose, drifted, density)


def _largest(marks: Landmarks, shared: Array) -> float:
    return float((np.trace(marks.covs, axis1=1, axis2=2).max() + np.trace(shared, axis1=1, axis2=2).max()) / 3.0)


def solve(
    look: Look,
    marks: Landmarks,
    T: Array,
    rows: IntArray,
    flowers: IntArray,
    scale: ErrorScale,
    n_iterations: int = 5,
    prior: Array | None = None,
) -> Fit:
    """The pose of least squares for given matches, each cluster's displacement eliminated (Schur complement).

    ``prior`` (6, 6) is information that ties the pose to ``T``; None: no prior at all.
    """
    clusters, group = np.unique(marks.cluster[flowers], return_inverse=True)
    n = len(clusters)
    points, places = look.points[rows], marks.positions[flowers]
    covs = covs_at(look, rows, transform(inverse(T), places)[:, 2], scale)
    shared = marks.shared_covs[clusters] + scale.sway_m**2 * np.eye(3)
    offsets, tie = np.zeros((n, 3)), _inverse(shared)
    swinging, cost = np.zeros(n), 0.0
    tied = np.zeros((6, 6)) if prior is None else prior
    moved = np.zeros(6)
    for _ in range(n_iterations):
        R = T[:3, :3]
        V = R @ covs @ R.T + marks.covs[flowers]
        r = places - transform(T, points)
        J = point_jacobian(R, points)
        weighted = np.linalg.solve(V, np.concatenate([J, r[..., None], np.broadcast_to(np.eye(3), V.shape)], axis=-1))
        data = _sums(weighted[..., 7:], group, n)
        A = data + tie
        B = _sums(weighted[..., :6], group, n)
        b = _sums(weighted[..., 6], group, n)
        half = np.linalg.solve(A, np.concatenate([B, b[..., None]], axis=-1))
        H = np.einsum("nia,nib->ab", J, weighted[..., :6]) - np.einsum("cia,cib->ab", B, half[..., :6])
        g = np.einsum("nia,ni->a", J, weighted[..., 6]) - np.einsum("cia,ci->a", B, half[..., 6])
        ridge = 1e-9 * float(np.trace(H)) * np.eye(6)
        step = np.linalg.solve(H + tied + ridge, g - tied @ moved)
        T = T @ se3_exp(step)
        moved = moved + step
        offsets = -(half[..., 6] - half[..., :6] @ step)
        d2 = np.einsum("ca,cab,cb->c", offsets, tie, offsets)
        used = tie
        tie, swinging, cost = _tie(data, b - (B @ step), shared, scale)
        if step @ H @ step < _STILL and np.abs(tie - used).max() < _STILL * np.abs(used).max():
            break
    r = transform(T, points) - places - offsets[group]
    chi2 = mahalanobis_sq(r, V)
    log_dets = (V, 1.0), (A, 1.0), (used, -1.0)
    log_det = sum(sign * float(np.linalg.slogdet(M)[1].sum()) for M, sign in log_dets)
    square = float(chi2.sum() + d2.sum())
    own = _inverse(A)
    by_pose = half[..., :6] @ np.linalg.solve(H + tied + ridge, np.swapaxes(half[..., :6], 1, 2))
    return Fit(
        T_map_camera=T,
        information=H + tied,
        rows=rows,
        flowers=flowers,
        offsets=offsets,
        offset_vars=np.trace(own + by_pose, axis1=1, axis2=2) / 3.0,
        clusters=clusters,
        chi2=chi2,
        log_likelihood=-0.5 * (square + log_det + 3.0 * len(rows) * LOG_2PI) - cost,
        swinging=swinging,
        redundancy=_redundancy(J, weighted, B, A, data, H + tied + ridge, group, n),
    )


def _tie(data: Array, b: Array, shared: Array, scale: ErrorScale) -> tuple[Array, Array, float]:
    """Information (c, 3, 3) that ties each displacement to zero, from what the cluster's own points say of it.

    Also the probability (c,) that each swings, and what it costs the evidence to say so.
    """
    alone: Array = np.asarray(np.linalg.solve(data, -b[..., None])[..., 0], dtype=np.float64)
    p, prior = sway.shares(alone, shared + _inverse(data), scale)
    total = shared[:, None] + sway.variances(scale)[:, None, None] * np.eye(3)
    information = np.asarray(np.linalg.solve(total, np.broadcast_to(np.eye(3), total.shape)), dtype=np.float64)
    return np.einsum("ck,ckij->cij", p, information), p[:, 1:].sum(axis=1), sway.surprise(p, prior)


def _inverse(covs: Array) -> Array:
    """Inverses of a stack (c, 3, 3)."""
    return np.asarray(np.linalg.solve(covs, np.broadcast_to(np.eye(3), covs.shape)), dtype=np.float64)


def _sums(values: Array, group: IntArray, n: int) -> Array:
    out = np.zeros((n, *values.shape[1:]))
    np.add.at(out, group, values)
    return out


def _redundancy(J: Array, weighted: Array, B: Array, A: Array, data: Array, H: Array, group: IntArray, n: int) -> float:
    """3 m minus the degrees of freedom that pose and displacements take from the points."""
    own = np.linalg.solve(A, data)
    half = np.linalg.solve(A, B)
    through = np.einsum("nia,nib->ab", J, weighted[..., :6]) - 2.0 * np.einsum("cia,cib->ab", half, B)
    through += np.einsum("cia,cij,cjb->ab", half, data, half)
    taken = float(np.trace(own, axis1=1, axis2=2).sum() + np.trace(np.linalg.solve(H, through)))
    return max(3.0 * len(J) - taken, 0.0)


def refine(
    look: Look, marks: Landmarks, T: Array, scale: ErrorScale, null_density: float, n_rounds: int = 3
) -> Fit | None:
    """Match and solve in turns from a rough pose; None where fewer than three points match."""
    rough = float(np.mean(look.sigma) ** 2) + scale.sway_m**2
    lever = float(np.sqrt((look.points**2).sum(1).mean()))
    sigma = np.repeat([2.0 * np.sqrt(rough) / lever, 2.0 * np.sqrt(rough)], 3)
    cov: Array | None = np.diag(sigma**2)
    before: tuple[IntArray, IntArray] | None = None
    fit: Fit | None = None
    for _ in range(n_rounds):
        rows, flowers = associate(look, marks, T, cov, scale, null_density)
        if len(rows) < 3:
            return None
        if before is not None and np.array_equal(before[0], rows) and np.array_equal(before[1], flowers):
            break
        before = (rows, flowers)
        fit = solve(look, marks, T, rows, flowers, scale)
        T = fit.T_map_camera
        cov = fit.cov if np.isfinite(fit.cov).all() else None
    return None if fit is None else _without_outliers(look, marks, fit, scale)


def _without_outliers(look: Look, marks: Landmarks, fit: Fit, scale: ErrorScale) -> Fit | None:
    """The fit without points that their own cluster's other flowers speak against."""
    good = fit.chi2 < GATE_CHI2
    if good.all():
        return fit
    if good.sum() < 3:
        return None
    return solve(look, marks, fit.T_map_camera, fit.rows[good], fit.flowers[good], scale)
