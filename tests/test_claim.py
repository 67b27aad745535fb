"""Wild errors claimed, false detections let go, single observations that need support."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.association.alone import without_support
from cluster_slam.association.claim import WILD, WildErrors, claim_wild, let_go
from cluster_slam.association.frames import Frames
from cluster_slam.geometry import Array

SIGMA = 0.002
PLACES = np.array([[0.0, 0.0, 0.5], [0.04, 0.0, 0.5], [0.0, 0.04, 0.5], [0.05, 0.05, 0.5]])
CLUSTER = np.zeros(4, dtype=np.int64)


def frames_of(points: list[Array]) -> Frames:
    counts = [len(p) for p in points]
    m = sum(counts)
    return Frames(
        order=np.arange(m),
        starts=np.concatenate([[0], np.cumsum(counts)]),
        frame=np.repeat(np.arange(len(points)), counts),
        points=np.concatenate(points),
        covs=np.tile(SIGMA**2 * np.eye(3), (m, 1, 1)),
        stamps=np.arange(len(points)) / 30.0,
    )


def scene(n: int, wild_share: float, clutter: float, *, rng: np.random.Generator) -> tuple[Frames, Array, Array]:
    """Frames with all four flowers, some wildly off, and false detections; the true landmark of each; gated matches."""
    points, truth = [], []
    for _ in range(n):
        wild = rng.random(4) < wild_share
        flowers = PLACES + SIGMA * np.where(wild, WILD, 1.0)[:, None] * rng.standard_normal((4, 3))
        false = rng.uniform([-0.3, -0.3, 0.3], [0.3, 0.3, 0.7], (rng.poisson(clutter), 3))
        points.append(np.concatenate([flowers, false]))
        truth += [0, 1, 2, 3, *[-1] * len(false)]
    frames, true = frames_of(points), np.array(truth)
    off = np.linalg.norm(frames.points - PLACES[true], axis=1)
    return frames, true, np.where((true >= 0) & (off < 4.0 * SIGMA), true, -1)


def claimed(frames: Frames, landmark: Array) -> tuple[Array, WildErrors]:
    n = frames.n_frames
    still, seen = np.zeros((n, 1, 3)), np.ones((n, 1), dtype=bool)
    return claim_wild(frames, np.tile(np.eye(4), (n, 1, 1)), PLACES, CLUSTER, landmark, still, seen)


def test_wild_errors_are_claimed_and_their_share_is_found() -> None:
    frames, true, matched = scene(800, 0.05, 1.0, rng=np.random.default_rng(1))
    out, errors = claimed(frames, matched)
    missing = (true >= 0) & (matched < 0)
    assert (out[missing] == true[missing]).mean() > 0.8
    assert (out[true < 0] < 0).mean() > 0.99
    # Of errors five times as large, those beyond four sigma: P(chi2_3 > (4 / 5)^2) = 0.887
    assert errors.share == pytest.approx(0.05 * 0.887, rel=0.25)


def test_without_wild_errors_nothing_is_claimed() -> None:
    frames, _, matched = scene(300, 0.0, 5.0, rng=np.random.default_rng(2))
    out, errors = claimed(frames, matched)
    assert errors.share < 0.003
    assert (out != matched).sum() <= 3


def test_density_of_false_detections() -> None:
    frames, true, _ = scene(800, 0.0, 30.0, rng=np.random.default_rng(3))
    keep = true != 3  # one flower is missed in every frame: the shell about it counts
    frames = frames_of([frames.points[frames.of(i)][keep[frames.of(i)]] for i in range(frames.n_frames)])
    _, errors = claimed(frames, true[keep])
    assert errors.clutter_density == pytest.approx(30.0 / (0.6 * 0.6 * 0.4), rel=0.2)


def test_log_ratio_by_hand() -> None:
    # One unit of volume a sigma, no wild errors: log N(0; I) - log density = -2.7568 - log 2
    assert WildErrors(0.0, 2.0).log_ratio(np.zeros(1), np.zeros(1))[0] == pytest.approx(-2.7568 - np.log(2.0), abs=1e-3)


def test_what_fits_nothing_is_let_go() -> None:
    frames = frames_of([PLACES])
    chi2 = np.array([1.0, 10.0, 1e4, np.nan])
    out = let_go(np.array([0, 1, 2, -1]), chi2, frames, WildErrors(0.01, 10.0), 0.001)
    np.testing.assert_array_equal(out, [0, 1, -1, -1])


def swinging(lone: Array) -> tuple[Frames, Array]:
    """Two flowers that move 1 mm a frame; in frame 5 only one point, ``lone``."""
    points = [PLACES[:2] + np.array([0.03 + 0.001 * i, 0, 0]) for i in range(11)]
    points[5] = lone[None]
    landmark = np.array([0, 1] * 5 + [0] + [0, 1] * 5)
    return frames_of(points), landmark


@pytest.mark.parametrize(("shift", "agree", "lost"), [(0.0, False, False), (0.08, False, True), (0.08, True, False)])
def test_single_observations_off_rest_need_support(shift: float, agree: bool, lost: bool) -> None:
    frames, landmark = swinging(PLACES[0] + [0.035 + shift, 0, 0])
    both = np.ones(len(landmark), dtype=bool)
    both[10] = agree
    T = np.tile(np.eye(4), (11, 1, 1))
    out = without_support(frames, T, PLACES, CLUSTER, landmark, both, 0.001, 16.0)
    assert out[10] == lost
    assert out.sum() == int(lost)
