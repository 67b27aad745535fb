"""Places that were seen for less than a swing: how uncertain they are said to be, against how far off they are."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.geometry import Array
from cluster_slam.smoothing.displaced import Displaced
from cluster_slam.smoothing.glimpses import _added, _constant, widened

FPS, HZ, WIDE, NOISE = 30.0, 1.0, 0.01, 0.001
REST, LASTING_S = 0.0003, 0.6
N = 300  # clusters


def test_the_constant_is_that_of_generalised_least_squares() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, 5, 5))
    covs, y = root @ np.swapaxes(root, 1, 2) + np.eye(5), rng.normal(size=(5, 3))
    found = _constant(covs, y)
    one = np.ones(5)
    for h, S in enumerate(covs):
        information = one @ np.linalg.solve(S, one)
        rest = one @ np.linalg.solve(S, y) / information
        left = y - rest
        log_det = np.linalg.slogdet(S)[1]
        assert found.var[h] == pytest.approx(1.0 / information)
        np.testing.assert_allclose(found.rest[h], rest)
        expected = -0.5 * np.trace(left.T @ np.linalg.solve(S, left)) - 1.5 * log_det - 1.5 * np.log(information)
        assert found.log_likelihood[h] == pytest.approx(expected)


@pytest.mark.parametrize("more", [0.0, 0.3, 50.0])
def test_the_weighted_mean_is_worse_by_what_was_asked(more: float) -> None:
    var = np.array([1.0, 2.0, 7.0])
    after = 1.0 / (1.0 / (var + _added(var, more))).sum()
    assert after - 1.0 / (1.0 / var).sum() == pytest.approx(more, rel=1e-3)


def swinging(seen_s: float, rng: np.random.Generator) -> tuple[Displaced, Array]:
    """Clusters that swing all the time, a third of which are seen for long, and how far their places are off."""
    frame, cluster, d, off = [], [], [], []
    for c in range(N):
        n = round(FPS * (8.0 if c % 3 == 0 else seen_s))
        t = np.arange(n) / FPS
        along = rng.normal(size=3) / np.sqrt(3.0)
        s = WIDE * np.sqrt(2.0) * np.sin(2 * np.pi * HZ * t + rng.uniform(0, 2 * np.pi))[:, None] * along
        s += rng.normal(0.0, NOISE, (n, 3))
        off.append(s.mean(axis=0))
        d.append(s - off[-1])
        frame.append(np.arange(n))
        cluster.append(np.full(n, c))
    frames, clusters, of = np.concatenate(frame), np.concatenate(cluster), np.concatenate(d)
    # What is seen for less than a tenth of a swing is not known to move.
    usual = np.where((clusters % 3 == 0) | (seen_s > 0.1), WIDE / np.sqrt(3.0), 0.0)
    cov = np.tile(NOISE**2 * np.eye(3), (len(of), 1, 1))
    moved = Displaced(of, cov, np.ones(len(of)), usual, frames, clusters, np.arange(round(FPS * 8)) / FPS)
    return moved, np.array(off)


@pytest.mark.parametrize("seen_s", [0.1, 0.25, 0.5])
def test_places_are_as_uncertain_as_they_are_off(seen_s: float) -> None:
    moved, off = swinging(seen_s, np.random.default_rng(1))
    block = np.floor(moved.stamps[moved.frame] * 4.0 * HZ).astype(np.int64)
    key, stretch = np.unique(moved.cluster * 100 + block, return_inverse=True)
    before = np.maximum(np.bincount(stretch, moved.scale) / np.bincount(stretch), REST)
    sigma = 0.8 * before[stretch]
    after = widened(moved, REST, LASTING_S, 0.25 / HZ, stretch, before, sigma)
    assert (after >= before).all()

    def var(stretch_sigma: Array) -> Array:
        own = 1.0 / np.bincount(stretch, 1.0 / (sigma**2 + NOISE**2))
        return np.asarray(1.0 / np.bincount(key // 100, 1.0 / (stretch_sigma**2 + own)))

    glimpsed = np.arange(N) % 3 != 0
    mean_square = (off[glimpsed] ** 2).sum(axis=1).mean() / 3.0
    assert 0.5 < mean_square / var(after)[glimpsed].mean() < 1.6
    # Long looks tell of themselves.
    np.testing.assert_allclose(var(after)[~glimpsed], var(before)[~glimpsed])


def test_where_nothing_swings_nothing_is_wider() -> None:
    moved, _ = swinging(0.1, np.random.default_rng(2))
    still = Displaced(moved.d, moved.cov, moved.share, np.zeros(len(moved.d)), moved.frame, moved.cluster, moved.stamps)
    stretch = moved.cluster
    before = np.full(N, REST)
    after = widened(still, REST, LASTING_S, 0.25, stretch, before, np.full(len(stretch), REST))
    np.testing.assert_array_equal(after, before)
