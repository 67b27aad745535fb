"""Grouping while the session goes on: what motion says, a round spread over frames, and how much one look holds."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from cluster_slam.config import OnlineConfig
from cluster_slam.grouping import Motion
from cluster_slam.grouping.comotion import motion_evidence
from cluster_slam.online.comotion import CommonMotion
from cluster_slam.online.regrouping import Round
from cluster_slam.online.upkeep import regrouped
from cluster_slam.online.world import World

SIGMA = 0.002
FPS = 30.0
PLACES = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.06, 0.0, 0.0]])


def swinging(seed: int, n: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) and displacements (n, 3, 3) of two flowers that swing as one and a third that swings otherwise."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / FPS
    one, other = (0.02 * np.sin(2 * np.pi * hz * t)[:, None] * rng.normal(size=3) for hz in (1.1, 1.7))
    true = np.stack([one, one, other], axis=1)
    return t, true + rng.normal(0.0, SIGMA, true.shape)


def told(t: np.ndarray, u: np.ndarray) -> np.ndarray:
    motion = CommonMotion(4)
    seats = np.array([2, 0, 3])
    for stamp, shift in zip(t, u, strict=True):
        motion.observe(float(stamp), seats, shift, np.full(3, SIGMA**2), PLACES, 1.0)
    return np.asarray(motion.evidence(seats, PLACES, 1.0).todense())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_motion_tells_who_belongs_together_as_after_the_session(seed: int) -> None:
    t, u = swinging(seed)
    value = told(t, u)
    after = np.asarray(motion_evidence(PLACES, Motion(u, np.full(u.shape[:2], SIGMA**2), t), 1.0).todense())
    assert value[0, 1] > 2.0
    assert max(value[0, 2], value[1, 2]) < -2.0
    assert (np.sign(value) == np.sign(after)).all()
    np.testing.assert_allclose(value[0, 1], after[0, 1], rtol=0.3)  # stretches are cut elsewhere


def test_one_wrong_observation_parts_nobody_and_a_seat_is_left_clean() -> None:
    t, u = swinging(4)
    u[50, 1] += 0.1
    assert told(t, u)[0, 1] > 2.0
    motion = CommonMotion(4)
    for stamp, shift in zip(t, u, strict=True):
        motion.observe(float(stamp), np.arange(3), shift, np.full(3, SIGMA**2), PLACES, 1.0)
    motion.clear(np.array([1]))
    motion.grow(8)
    value = np.asarray(motion.evidence(np.arange(3), PLACES, 1.0).todense())
    assert value[0, 1] == value[1, 2] == 0.0
    assert value[0, 2] < -2.0


def test_flowers_at_rest_say_nothing() -> None:
    t, u = swinging(5)
    rest = np.random.default_rng(6).normal(0.0, SIGMA, u.shape)
    assert not told(t, rest).any()


def clusters(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    centres = 0.3 * np.stack(np.meshgrid(*[np.arange(2)] * 3), axis=-1).reshape(-1, 3)
    true = np.repeat(np.arange(len(centres)), 5)
    return centres[true] + rng.normal(0.0, 0.015, (len(true), 3)), true


def begun(places: np.ndarray, label: np.ndarray) -> Round:
    n = len(places)
    return Round(np.arange(n), places, label, 0.3, csr_matrix((n, n)), np.ones(n, dtype=bool))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_round_spread_over_frames_and_resumed_is_the_same(seed: int) -> None:
    places, true = clusters(seed)
    wrong = true.copy()
    wrong[true == 1], wrong[3] = 0, 5
    at_once, spread = begun(places, wrong), begun(places, wrong)
    while not at_once.work(10**6):
        pass
    n_frames = 1
    while not spread.work(5):
        n_frames += 1
        spread = pickle.loads(pickle.dumps(spread))
    assert n_frames > 20
    label = at_once.label(1.0)
    np.testing.assert_array_equal(label, spread.label(1.0))
    assert len(np.unique(np.stack([label, true]), axis=1).T) == true.max() + 1
    between = np.linalg.norm(places[:, None] - places, axis=-1)[true[:, None] != true].min()
    assert 0.015 < spread.link(label) < between


def test_how_much_a_look_holds_is_not_taken_from_a_few_points() -> None:
    """The view is a frustum of half a metre about the axis, one metre away: its sides as seen by five points."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(400):
        world = World(OnlineConfig(), None, 0)
        depth = rng.uniform(0.8, 1.2, 5)
        world.widen_view(np.column_stack([rng.uniform(-0.25, 0.25, (5, 2)) * depth[:, None], depth]))
        found.append(world.view_volume())
    # Width times height times mean depth; independent sides have independent ranges.
    assert np.mean(found) == pytest.approx(0.25, rel=0.1)


def test_of_two_flowers_that_part_the_older_one_keeps_the_name() -> None:
    world = World(OnlineConfig(), None, 0)
    slot = world.new_cluster(0.0)
    name = world.clusters[slot].id
    for place in (0.0, 0.1):
        added = world.flowers.add(
            np.array([[place, 0.0, 0.5]]), 1e-6 * np.eye(3)[None], np.zeros((1, 3, 6)), np.array([slot]), 0.0
        )
        world.flowers.confirmed[added] = True
    world.flowers.n[:] = 4, 400
    regrouped(world, np.arange(2), np.array([0, 1]), 1.0)
    assert world.names()[world.flowers.slot[1]] == name
    assert world.names()[world.flowers.slot[0]] != name
