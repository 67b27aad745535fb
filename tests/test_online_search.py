"""What is looked for where flowers are not in their place: touched clusters, and touched flowers that are alone."""

from __future__ import annotations

import numpy as np

from cluster_slam.config import TemplateConfig
from cluster_slam.online.matching import Matches
from cluster_slam.online.search import Scene, find_moved
from cluster_slam.online.strays import find_strays

SIGMA = 0.002
OFFSETS = np.array(
    [[0, 0, 0], [0.03, 0, 0], [0, 0.035, 0.01], [-0.03, 0.01, 0], [0.01, -0.03, 0.02], [0.02, 0.03, -0.02]]
)
NONE = np.zeros(0, dtype=np.int64)


def scene(points: np.ndarray) -> Scene:
    n = len(points)
    return Scene(
        places=OFFSETS,
        slot=np.zeros(len(OFFSETS), dtype=np.int64),
        w=points,
        S=np.tile(SIGMA**2 * np.eye(3), (n, 1, 1)),
        d=np.zeros((1, 3)),
        P=np.tile(0.0004**2 * np.eye(3), (1, 1, 1)),
        unseen_s=np.array([0.033]),
    )


def test_a_touched_cluster_is_found_where_it_went() -> None:
    rng = np.random.default_rng(3)
    step = np.array([0.012, -0.006, 0.004])
    seen = np.array([0, 2, 3, 5])
    found = find_moved(
        scene(OFFSETS[seen] + step + rng.normal(0, 0.001, (4, 3))), Matches(NONE, NONE, np.zeros(0)), TemplateConfig()
    )
    assert found[0].is_jump
    assert dict(zip(found[0].rows.tolist(), found[0].cols.tolist(), strict=True)) == {0: 0, 2: 1, 3: 2, 5: 3}
    np.testing.assert_allclose(found[0].d, step, atol=0.003)


def test_noise_of_three_seen_flowers_of_six_is_no_touch() -> None:
    """Half a cluster is missed, and the seen half is off by its noise: in a hundred frames hardly ever a jump."""
    rng, jumps = np.random.default_rng(4), 0
    for _ in range(100):
        seen = rng.choice(6, 3, replace=False)
        points = OFFSETS[seen] + rng.normal(0, SIGMA, (3, 3))
        rows, cols = seen[:2], np.arange(2)
        found = find_moved(scene(points), Matches(rows, cols, np.array([3.0, 3.0])), TemplateConfig())
        jumps += any(m.is_jump for m in found.values())
    assert jumps <= 3


def test_a_missed_flower_is_the_point_nearby_unless_such_points_are_many() -> None:
    expected, cov = np.array([[0.0, 0, 1], [0.5, 0, 1]]), np.tile(0.005**2 * np.eye(3), (2, 1, 1))
    points, S = np.array([[0.508, 0, 1], [0.009, 0.002, 1], [0.2, 0.2, 1]]), np.tile(SIGMA**2 * np.eye(3), (3, 1, 1))
    rows, cols = find_strays(expected, cov, points, S, density=5.0)
    assert dict(zip(rows.tolist(), cols.tolist(), strict=True)) == {0: 1, 1: 0}
    assert not len(find_strays(expected, cov, points, S, density=1e6)[0])
    assert not len(find_strays(expected, cov, points + np.array([0.0, 0.0, 0.05]), S, density=5.0)[0])
