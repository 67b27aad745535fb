"""A plain particle filter for a vehicle on a floor: what is had for nothing, to compare with.

Particles hold place, heading and side of the map, nothing of the instruments; each point may be any landmark, or none
(Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, table 8.2). The session is taken as it was given.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array, se3_log
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.motion import motion_of
from cluster_slam.localisation.planar import flat_world
from cluster_slam.records import Session

N_FIRST, N_LATER, N_OPEN_FRAMES = 50_000, 5_000, 60
STEP_SCALE, WIDER, FALSE_SHARE = 1.5, 1.5, 0.05


def particle_filter(session: Session, marks: Landmarks, seed: int = 0) -> Array:
    """Poses (n, 4, 4): the mean of the particles within 1 m and 0.5 rad of the likeliest."""
    motion, rng = motion_of(session), np.random.default_rng(seed)
    flat = flat_world(session, motion, marks)
    assert flat is not None
    places, C = (marks.positions - flat.origin) @ flat.map[:, :2], flat.camera
    low, high = places.min(0) - 2.0, places.max(0) + 2.0
    side = np.where(rng.random(N_FIRST) < 0.5, 1.0, -1.0)
    x = np.column_stack([rng.uniform(low, high, (N_FIRST, 2)), rng.uniform(-np.pi, np.pi, N_FIRST)])
    x[:, 1] *= side
    o, out = session.observations, []
    for i in range(session.n_frames):
        if i:
            step, cov = motion.camera_step(i - 1, i, None), motion.step_cov(i - 1, i)
            sigma = STEP_SCALE * np.sqrt(
                [*np.diag(C[:, :2].T @ cov[3:, 3:] @ C[:, :2]), C[:, 2] @ cov[:3, :3] @ C[:, 2]]
            )
            moved = np.array([*(C[:, :2].T @ step[:3, 3]), C[:, 2] @ se3_log(step)[:3]])
            moved = moved + rng.normal(size=x.shape) * sigma
            x[:, :2] += np.einsum("nij,nj->ni", _turn(x[:, 2]), moved[:, :2])
            x[:, 2] += moved[:, 2]
        here, log_w = o.frame == i, np.zeros(len(x))
        for q, S in zip(o.points[here] @ C[:, :2], C[:, :2].T @ o.covs[here] @ C[:, :2], strict=True):
            log_w += _log_likelihood(x, side, q, WIDER**2 * S, places, float(np.prod(high - low)))
        w = np.exp(log_w - log_w.max())
        out.append(flat.pose(*_estimate(x, side, w / w.sum()), np.eye(3))[0])
        n = N_FIRST if i < N_OPEN_FRAMES else N_LATER
        at = np.searchsorted(np.cumsum(w / w.sum()), (rng.random() + np.arange(n)) / n)
        x, side = x[np.minimum(at, len(x) - 1)], side[np.minimum(at, len(x) - 1)]
    return np.array(out)


def _turn(heading: Array) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)


def _log_likelihood(x: Array, side: Array, q: Array, S: Array, places: Array, area: float) -> Array:
    away = places * np.stack([np.ones(len(x)), side], axis=1)[:, None] - x[:, None, :2]
    off = q - away @ _turn(x[:, 2])
    d2 = (np.linalg.solve(S, off[..., None])[..., 0] * off).sum(-1)
    each = np.exp(-0.5 * d2).mean(1) / (2.0 * np.pi * np.sqrt(np.linalg.det(S)))
    return np.asarray(np.log((1.0 - FALSE_SHARE) * each + FALSE_SHARE / area))


def _estimate(x: Array, side: Array, w: Array) -> tuple[Array, float]:
    best = int(w.argmax())
    turned = np.angle(np.exp(1j * (x[:, 2] - x[best, 2])))
    near = (side == side[best]) & (np.linalg.norm(x[:, :2] - x[best, :2], axis=1) < 1.0) & (np.abs(turned) < 0.5)
    share = w[near] / w[near].sum()
    return np.array([*(share @ x[near, :2]), x[best, 2] + share @ turned[near]]), float(side[best])
