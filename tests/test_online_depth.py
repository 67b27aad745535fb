"""Live tracking with noise that grows with depth: places must not come out too near."""

from __future__ import annotations

import numpy as np

from cluster_slam import OnlineTracker
from cluster_slam.records import Frame, StatedNoise

SIGMA = 0.02  # of depth, times depth squared


def test_noise_stated_at_the_measured_depth_does_not_draw_flowers_near() -> None:
    rng = np.random.default_rng(4)
    x, y = np.meshgrid([-0.4, 0.0, 0.4], [-0.3, 0.0, 0.3])
    flowers = np.column_stack([x.ravel(), y.ravel(), rng.uniform(1.0, 1.5, 9)])
    rays = flowers / flowers[:, 2:]
    tracker = OnlineTracker(StatedNoise(pose_translation=0.001, pose_rotation=0.001))
    for k in range(300):
        z = flowers[:, 2] + SIGMA * flowers[:, 2] ** 2 * rng.normal(size=9)
        across = np.broadcast_to(np.diag([1.0, 1.0, 0.0]) * (0.001 * z[:, None, None]) ** 2, (9, 3, 3))
        covs = across + (SIGMA * z[:, None, None] ** 2) ** 2 * rays[:, :, None] * rays[:, None]
        points = rays * z[:, None] + np.column_stack([0.001 * z * rng.normal(size=9) for _ in range(2)] + [np.zeros(9)])
        tracker.step(Frame(stamp=k / 30.0, pose=np.eye(4), points=points, covs=covs, scores=None))
    table = tracker.world.flowers
    gap = np.linalg.norm(table.place[:, None, :2] - flowers[None, :, :2], axis=-1)
    assert (gap.min(0) < 0.05).all()
    error = table.place[gap.argmin(0), 2] - flowers[:, 2]
    sigma = SIGMA * flowers[:, 2] ** 2
    bias = float((4.0 * sigma**2 / flowers[:, 2]).mean())  # of weights at the measured depth, first order: 2 mm
    assert abs(error.mean()) < 0.4 * bias
