"""New points are called flowers only where more of their kind became flowers than not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam import OnlineTracker
from cluster_slam.config import OnlineConfig
from cluster_slam.live.replay import Replay
from cluster_slam.online.births import ALONE, BESIDE, DOUBTFUL, Births
from cluster_slam.online.life import may_be_missing
from cluster_slam.online.world import World
from cluster_slam.records import RejectReason
from cluster_slam.simulate import PRESETS, simulate_session

ONCE = np.array([1])


def kind(place: int, is_fresh: bool) -> np.ndarray:
    return Births.kind(np.array([place]), np.array([is_fresh]))


def test_before_anything_is_known_a_fresh_place_has_flowers_and_mid_air_has_none() -> None:
    births = Births()
    assert births.is_flower(kind(ALONE, True), ONCE).all()
    assert births.is_flower(kind(BESIDE, True), ONCE).all()
    assert not births.is_flower(kind(ALONE, False), ONCE).any()
    assert not births.is_flower(kind(BESIDE, False), ONCE).any()
    assert not births.is_flower(kind(DOUBTFUL, True), ONCE).any()


def test_counts_decide_at_one_half() -> None:
    """One flower and three false ones count beforehand: at 3 to 3 nothing is said, at 4 to 3 it is."""
    births = Births()
    alone = kind(ALONE, False)
    for n, expected in ((2, False), (1, True)):
        births.became_flowers(np.repeat(alone, n))
        assert births.is_flower(alone, ONCE).all() == expected
    births.were_false(alone, ONCE)
    assert not births.is_flower(alone, ONCE).any()
    assert births.is_flower(alone, np.array([2])).all()  # none of the false ones was seen twice


def test_old_counts_fade() -> None:
    births = Births()
    alone = kind(ALONE, False)
    births.were_false(np.repeat(alone, 10_000), np.ones(10_000, dtype=int))
    births.became_flowers(np.repeat(alone, 250))
    assert births.is_flower(alone, ONCE).all()


def test_the_view_of_half_a_second_ago_is_kept() -> None:
    births = Births()
    for k in range(100):
        births.note_view(0.1 * k, np.full((4, 4), k))
    assert births.past[0][1][0, 0] == 94
    assert len(births.past) == 6


def test_lone_clutter_gets_no_name_and_flowers_get_theirs_at_once() -> None:
    """The first frame is named whole; later most false points are not, and hardly any flower waits."""
    world = simulate_session(replace(PRESETS["moderate"], duration_s=8.0, clutter_per_frame=0.5), seed=71)
    session, truth = world.session, world.truth
    assert truth.flower_ids is not None
    tracker = OnlineTracker(session.noise, session.T_flange_camera)
    order = np.argsort(session.observations.frame, kind="stable")
    updates = [tracker.step(frame) for frame in Replay(session).frames()]
    assert (updates[0].flower_ids >= 0).all()
    found = np.concatenate([update.flower_ids for update in updates])
    true = truth.flower_ids[order]
    late = session.observations.frame[order] > 60
    assert (found[late & (true < 0)] < 0).mean() > 0.7
    assert (found[late & (true >= 0)] >= 0).mean() > 0.98
    unnamed = np.concatenate([u.reasons for u in updates])[found < 0]
    assert np.isin(unnamed, [RejectReason.UNCONFIRMED, RejectReason.TAKEN]).mean() > 0.95


def test_a_new_flower_may_be_a_landmark_nearby_that_was_moved() -> None:
    world = World(OnlineConfig(), None, 0)
    world.widen_view(np.array([[-0.5, -0.5, 0.5], [0.5, 0.5, 1.5]]))
    cov, lever = np.tile(1e-6 * np.eye(3), (2, 1, 1)), np.zeros((2, 3, 6))
    places = np.array([[0.0, 0.0, 1.0], [0.03, 0.0, 1.0]])
    table = world.flowers
    landmark, new = table.add(places, cov, lever, np.full(2, world.new_cluster(0.0)), 0.0).tolist()
    table.confirmed[landmark] = table.told[landmark] = True
    world.place_anchors(np.array([0]))
    rows = np.array([landmark, new])

    def blocked(last: float) -> list[bool]:
        """With the landmark last seen then; the frame is at 2 s."""
        table.last[landmark], table.last[new] = last, 2.0
        found: list[bool] = may_be_missing(world, rows, world.snapshot(2.0), np.eye(4), 2.0).tolist()
        return found

    assert blocked(1.9) == [False, True]  # it went when the other came
    assert blocked(0.5) == [False, False]  # it has long been hidden
    table.place[new] = [0.3, 0.0, 1.0]
    assert blocked(1.9) == [False, False]  # too far
    table.place[new] = [0.03, 0.0, 1.0]
    assert blocked(2.0) == [False, False]  # both are there ...
    assert blocked(1.9) == [False, False]  # ... so they are two
