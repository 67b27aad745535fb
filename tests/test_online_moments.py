"""Moments in which flowers are seen together, however often each is missed."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.online.moments import Moments


@pytest.mark.parametrize("hit", [0.3, 0.6, 1.0])
def test_flowers_missed_by_chance_share_their_moments(hit: float) -> None:
    rng, moments = np.random.default_rng(3), Moments(4)
    for _ in range(600):
        moments.observe(np.flatnonzero(rng.random(4) < hit))
    each = np.diag(moments.counts)
    assert (moments.counts >= 0.9 * np.minimum(each[:, None], each)).all()


def test_who_is_never_in_view_together_shares_none() -> None:
    moments = Moments(2)
    for k in range(400):
        moments.observe(np.array([k // 20 % 2]))
    assert moments.counts[0, 1] <= 0.1 * moments.counts[0, 0]


def test_a_seat_that_was_left_is_new_and_more_room_keeps_what_is_known() -> None:
    moments = Moments(2)
    for _ in range(20):
        moments.observe(np.array([0, 1]))
    moments.grow(4)
    known = moments.counts[1, 1]
    moments.clear(np.array([0]))
    moments.observe(np.array([1, 3]))
    assert known > 0.0
    assert moments.counts[1, 1] == known + 1.0
    assert moments.counts[0, 1] == moments.counts[0, 0] == 0.0
    assert moments.counts[1, 3] == 1.0
