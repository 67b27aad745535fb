"""One cluster followed: predicted one frame ahead, pushed, and in a motion that no model has."""

from __future__ import annotations

from functools import cache

import numpy as np

from cluster_slam.online.cluster import ClusterTrack
from tracking.consistency import mean_band
from tracking.motion import MotionConfig

DT = 1 / 30
SIGMA = np.array([0.7, 0.7, 2.0]) * 1e-3  # m, of a centroid seen by a camera half a metre away


def swing(rng: np.random.Generator, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (n, 3) of a plant touched now and then, 1 to 2 Hz; frames since the last touch (n,)."""
    t = np.arange(0.0, seconds, DT)
    omega, zeta = 2 * np.pi * rng.uniform(1.0, 2.0), rng.uniform(0.05, 0.15)
    d, since = np.zeros((len(t), 3)), np.full(len(t), 1000)
    for start in np.arange(1.0, seconds, 3.0) + rng.uniform(0, 1, len(np.arange(1.0, seconds, 3.0))):
        push = rng.normal(size=3)
        tau = np.maximum(t - start, 0.0)[:, None]
        ring = np.exp(-zeta * omega * tau) * np.sin(omega * np.sqrt(1 - zeta**2) * tau)
        d += rng.uniform(0.03, 0.05) * push / np.linalg.norm(push) * ring
        first = int(np.searchsorted(t, start))
        since[first:] = np.arange(len(t) - first)
    return d, since


def follow(track: ClusterTrack, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Innovation squared, squared errors of prediction and of "stays where it was", and whether it sways, by frame."""
    out, cov, stay = [], np.diag(SIGMA**2), np.zeros(3)
    tremble = track.config.tremble_m**2 * np.eye(3)
    for i, d in enumerate(true):
        stamp = i * DT
        track.predict(stamp)
        predicted, P = track.displacement(stamp)
        seen = d + rng.normal(size=3) * SIGMA
        nis = float((seen - predicted) @ np.linalg.solve(P + cov, seen - predicted))
        out.append([nis, ((predicted - d) ** 2).sum(), ((stay - d) ** 2).sum(), track.is_moving])
        rest, waking = (
            -0.5 * (seen @ np.linalg.solve(S, seen) + np.linalg.slogdet(S)[1])
            for S in (cov + tremble, cov + 0.004**2 * np.eye(3))
        )
        track.weigh(rest, waking, seen - predicted, cov, DT)
        if track.wants_filter(stamp):
            track.update(seen, cov, None, stamp)
        track.last = stamp
        stay = track.displacement(stamp)[0]
    return np.array(out)


def followed(true: np.ndarray, seed: int) -> np.ndarray:
    track = ClusterTrack(1, 0.0, MotionConfig())
    track.place(np.zeros(3), np.arange(4))
    track.awaken(0.0)
    return follow(track, true, np.random.default_rng(seed))


@cache
def many() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Figures of six plants, frames since a touch, and how far each is from rest."""
    rng = np.random.default_rng(8)
    worlds = [swing(rng, 24.0) for _ in range(6)]
    found = [followed(d, k) for k, (d, _) in enumerate(worlds)]
    reach = np.concatenate([np.linalg.norm(d, axis=1) for d, _ in worlds])
    return np.concatenate(found), np.concatenate([since for _, since in worlds]), reach


def test_a_swing_is_predicted_twice_as_well_as_by_staying() -> None:
    found, since, reach = many()
    use = (reach > 0.01) & (since >= 10)
    ahead, still = np.sqrt(found[use, 1].mean()), np.sqrt(found[use, 2].mean())
    assert still > 2.5 * ahead
    band = mean_band(3, int(use.sum()), 0.999)
    assert band.low * 0.85 < found[use, 0].mean() < band.high * 1.15


def test_a_touch_is_noticed_at_once() -> None:
    """Five frames after a touch that moves it by centimetres it is known to sway, and is where it is said to be."""
    found, since, reach = many()
    use = (since == 5) & (reach > 0.01)
    assert use.sum() >= 20
    assert found[use, 3].mean() > 0.95
    assert np.sqrt(np.median(found[use, 1])) < 0.005


def test_a_motion_that_no_model_has_widens_the_covariance() -> None:
    """Twice the swing's frequency on top of it, and no damping: innovations stay as large as is said."""
    t = np.arange(0.0, 20.0, DT)
    d = np.stack([0.02 * np.sin(8 * t) + 0.002 * np.sin(19 * t), 0.01 * np.cos(9.5 * t), 0 * t], axis=1)
    found = followed(d, 5)[60:]
    assert found[:, 3].all()
    assert 2.0 < found[:, 0].mean() < 4.0


def test_where_it_is_seen_does_not_follow_what_the_map_learns_of_its_rest() -> None:
    track = ClusterTrack(0, 0.0, MotionConfig())
    track.place(np.zeros(3), np.arange(4))
    track.awaken(0.0)
    track.jump(np.array([0.02, 0.0, 0.0]), 1e-6 * np.eye(3), 0.1, None, "found", 0.0)
    moved = np.array([0.008, 0.0, 0.0])
    track.place(moved, np.arange(4))
    np.testing.assert_allclose(track.now(0.0)[0], [0.02, 0.0, 0.0])
    np.testing.assert_allclose(track.displacement(0.0)[0], [0.012, 0.0, 0.0])
    track.place(2.0 * moved, np.arange(5))  # another centroid, of one flower more
    np.testing.assert_allclose(track.now(0.0)[0], [0.028, 0.0, 0.0])
