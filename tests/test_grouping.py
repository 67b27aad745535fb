"""Clusters from spacing and from common motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from cluster_slam.config import GroupingConfig
from cluster_slam.geometry import Array
from cluster_slam.grouping import Motion, group_flowers
from cluster_slam.grouping.comotion import Ratios, log_likelihood_ratio, motion_evidence, pair_ratios, turning_ratio
from cluster_slam.grouping.lasting import lasting_share, noise_share, without_lasting
from cluster_slam.grouping.likelihood import Likelihood
from cluster_slam.grouping.partition import improve

N_FRAMES = 600
STAMPS = np.arange(N_FRAMES) / 30.0
NOISE_M = 0.002


def motion_of(label: Array, amplitude: float, *, rng: np.random.Generator) -> Motion:
    """Flowers of clusters that each swing with a frequency and phase of their own, seen with noise."""
    swing = [amplitude * np.sin(2 * np.pi * f * STAMPS[:, None] + rng.uniform(0, 6, 3)) for f in (0.9, 1.7)]
    u = np.stack([swing[j] for j in label], axis=1)
    return Motion(u + NOISE_M * rng.standard_normal(u.shape), np.full(u.shape[:2], NOISE_M**2), STAMPS)


def ratios(ratio: list[float] | Array, sigma: float, n_stretches: list[float] | Array, lasting: float = 0.0) -> Ratios:
    """Ratios (p,) that are equally well known."""
    each = np.asarray(ratio, float)
    return Ratios(each, np.full_like(each, sigma), np.asarray(n_stretches, float), np.full_like(each, lasting))


def slow(shape: tuple[int, ...], last_s: float, *, rng: np.random.Generator) -> Array:
    """Errors of variance one, (n, ...), whose correlation falls to 1 / e within ``last_s``."""
    keep = np.exp(-(STAMPS[1] - STAMPS[0]) / last_s)
    x = rng.standard_normal(shape)
    for k in range(1, len(x)):
        x[k] = keep * x[k - 1] + np.sqrt(1.0 - keep**2) * x[k]
    return x


def two_crossed_clusters() -> tuple[Array, Array]:
    """Six flowers along a line, whose clusters alternate: where they stand says the wrong thing."""
    places = np.column_stack([0.02 * np.arange(6), np.zeros(6), np.ones(6)])
    return places, np.array([0, 0, 1, 0, 1, 1])


def grouped(places: Array, motion: Motion | None) -> Array:
    presence = csr_matrix(np.ones((len(places), N_FRAMES)))
    return group_flowers(places, presence, motion, 0.5, GroupingConfig(), rng=np.random.default_rng(0))


def test_motion_overrules_spacing() -> None:
    rng = np.random.default_rng(3)
    places, label = two_crossed_clusters()
    np.testing.assert_array_equal(grouped(places, motion_of(label, 0.01, rng=rng)), label)
    assert len(np.unique(grouped(places, None))) == 1


def test_sway_below_the_noise_of_one_frame_still_tells() -> None:
    rng = np.random.default_rng(5)
    places, label = two_crossed_clusters()
    np.testing.assert_array_equal(grouped(places, motion_of(label, NOISE_M, rng=rng)), label)


def test_no_motion_is_no_evidence() -> None:
    rng = np.random.default_rng(7)
    places, label = two_crossed_clusters()
    evidence = motion_evidence(places, motion_of(label, 0.0, rng=rng), 0.2)
    assert abs(evidence).max() < 1.5  # a few of 600 noisy frames pass the test of significance by chance


@pytest.mark.parametrize(("ratio", "sign"), [(0.0, 1.0), (0.02, 1.0), (0.6, -1.0), (1.0, -1.0)])
def test_evidence_has_the_sign_of_what_was_seen(ratio: float, sign: float) -> None:
    value = log_likelihood_ratio(ratios([ratio], 0.02, [4.0]), 0.0)[0]
    assert sign * value > 1.5


def test_turning_is_read_off_near_pairs_and_grows_with_the_square_of_the_distance() -> None:
    rng = np.random.default_rng(29)
    distance = np.concatenate([rng.uniform(0.01, 0.05, 200), [0.08]])
    ratio = 40.0 * distance**2 + 0.005 * rng.standard_normal(201)
    usual = turning_ratio(ratios(ratio, 0.005, np.full(201, 6.0)), distance, 0.05)
    np.testing.assert_allclose(usual, 40.0 * distance**2, rtol=0.1)
    known, rigid = (log_likelihood_ratio(ratios(ratio[-1:], 0.005, [6.0]), t)[0] for t in (usual[-1:], 0.0))
    assert known > 0.5 > -2.0 > rigid  # 0.26 apart is what a cluster that turns does over 8 cm


def test_rigid_clusters_do_not_turn() -> None:
    assert (
        turning_ratio(ratios(np.full(50, -0.01), 0.02, np.full(50, 6.0)), np.linspace(0.01, 0.08, 50), 0.05) == 0.0
    ).all()


def test_a_poorly_known_ratio_says_little() -> None:
    assert abs(log_likelihood_ratio(ratios([0.5], 2.0, [4.0]), 0.0)[0]) < 0.2


def test_evidence_by_hand() -> None:
    # ratio 0.01, sigma 0, no turning: N(0.01; 0, 0.02) = 17.603 against N(0.01; 0.66, 0.27) = 0.08145 by 0.7 and by 0.3
    # anywhere, with power 0.4 + 0.07 * 60 / 7 = 1: 1 / 1.4 = 0.71429, seen in bins of 0.01, the edge of which blurs it:
    # bins at 0.005 and 0.015 with sigma 0.002887: 0.0071429 * 2 * N(0.005; 0, 0.002887) = 0.44067, the next one
    # N(0.015; 0, 0.002887) = 1.9e-4 * 0.0071429; and 5 % of anything: (1 / 2.8 + N(0.01; 0.5, 0.7)) / 2 = 0.40177
    apart = 0.7 * 0.08145 + 0.3 * 0.44067
    expected = np.log((0.95 * 17.603 + 0.05 * 0.40177) / (0.95 * apart + 0.05 * 0.40177))
    value = log_likelihood_ratio(ratios([0.01], 0.0, [60 / 7]), 0.0)[0]
    assert value == pytest.approx(expected, rel=1e-3)


def test_moving_alike_again_and_again_is_stronger_evidence_than_once() -> None:
    evidence = log_likelihood_ratio(ratios(np.full(4, 0.01), 0.01, [1.0, 3.0, 9.0, 27.0]), 0.0)
    assert (np.diff(evidence) > 0.2).all()


def test_ratio_of_one_cluster_is_zero_within_its_sigma() -> None:
    """Leaving out the largest differences leaves less noise than the mean says; without that, ratios are negative."""
    rng = np.random.default_rng(19)
    label = np.zeros(12, dtype=np.int64)
    pairs = np.column_stack(np.triu_indices(12, 1))
    found = pair_ratios(pairs, motion_of(label, 3.0 * NOISE_M, rng=rng), 0.0)
    assert abs(np.mean(found.ratio / found.sigma)) < 0.4  # 66 pairs of 12 flowers: as good as 12 independent ones
    assert (found.n_stretches > 20).all()  # 20 s of undamped motion: 50 stretches of 0.4 s


@pytest.mark.parametrize("share", [0.0, 0.1, 0.4])
def test_the_share_of_errors_that_last_is_found(share: float) -> None:
    rng = np.random.default_rng(37)
    places, label = rng.uniform(0, 0.5, (12, 3)), np.zeros(12, dtype=np.int64)
    motion = motion_of(label, 0.02, rng=rng)
    u = motion.u + np.sqrt(share) * NOISE_M * slow(motion.u.shape, 2.0, rng=rng)
    moment = np.arange(N_FRAMES) // 12
    found = lasting_share(places, u, motion.var, moment)
    assert found == pytest.approx(share, rel=0.25, abs=0.01)


def test_variances_that_hold_shared_sway_are_found_too_large() -> None:
    rng = np.random.default_rng(61)
    places = 0.03 * rng.standard_normal((3, 3))
    motion = motion_of(np.zeros(3, dtype=np.int64), 2.0 * NOISE_M, rng=rng)
    assert noise_share(places, motion.u, motion.var) == pytest.approx(1.0, abs=0.06)
    stated = 5.0 * motion.var
    assert noise_share(places, motion.u, stated) == pytest.approx(0.2, rel=0.06)
    evidence = motion_evidence(places, Motion(motion.u, stated, STAMPS), 1.0).toarray()
    assert evidence[np.triu_indices(3, 1)].min() > 1.5


def test_misses_do_not_part_a_cluster_in_motion_where_errors_last() -> None:
    """Means over a spell, over the frames of one flower and of another, differ where both swing."""
    rng = np.random.default_rng(67)
    motion = motion_of(np.zeros(2, dtype=np.int64), 0.02, rng=rng)
    u = np.where((rng.random((N_FRAMES, 2)) < 0.3)[..., None], motion.u, np.nan)
    var = np.where(np.isfinite(u[..., 0]), motion.var, np.nan)
    assert pair_ratios(np.array([[0, 1]]), Motion(u, var, STAMPS), 0.1).ratio[0] < 0.02


def test_what_stays_the_same_for_a_spell_is_subtracted_and_sway_is_not() -> None:
    rng = np.random.default_rng(41)
    constant = np.array([0.02, -0.01, 0.03])
    motion = motion_of(np.array([0, 0, 1]), 0.01, rng=rng)
    u, left = without_lasting(motion.u + constant, motion.var, STAMPS, 0.5)
    inside = abs(STAMPS - STAMPS.mean()) < 0.5 * STAMPS[-1] - 1.0
    assert abs(u[inside].mean(axis=(0, 1))).max() < 0.001
    assert u[inside].std() == pytest.approx(motion.u[inside].std(), rel=0.15)
    assert (left < motion.var).all()
    unchanged, same = without_lasting(motion.u, motion.var, STAMPS, 0.0)
    np.testing.assert_array_equal(unchanged, motion.u)
    np.testing.assert_array_equal(same, motion.var)


def test_noise_that_is_left_is_what_it_says() -> None:
    rng = np.random.default_rng(43)
    noise = NOISE_M * rng.standard_normal((N_FRAMES, 200, 3))
    u, left = without_lasting(noise, np.full(noise.shape[:2], NOISE_M**2), STAMPS, 0.02)
    np.testing.assert_allclose((u**2).mean(axis=(1, 2)), left[:, 0], rtol=0.3)
    assert (u**2).mean() == pytest.approx(left.mean(), rel=0.01)


def test_errors_that_last_part_no_cluster() -> None:
    """Where a cluster hardly moves, views in which one flower errs look like a motion of its own."""
    rng = np.random.default_rng(47)
    places = np.repeat(np.array([[0.0, 0, 1], [0.2, 0, 1], [0, 0.2, 1], [0.2, 0.2, 1]]), 4, axis=0)
    places = places + 0.02 * rng.standard_normal(places.shape)
    motion = motion_of(np.zeros(16, dtype=np.int64), 0.0, rng=rng)
    heavy = np.sqrt(0.1 * 4.0 / rng.chisquare(4.0, 16))  # of each flower, over the sigma of one observation
    u = motion.u + NOISE_M * heavy[:, None] * slow(motion.u.shape, 1.5, rng=rng)
    found = grouped(places, Motion(u, motion.var, STAMPS))
    np.testing.assert_array_equal(found, np.repeat(np.arange(4), 4))


def test_lasting_errors_of_unknown_size_leave_little_evidence() -> None:
    sure, unsure = (log_likelihood_ratio(ratios([1.0], 0.05, [5.0], lasting), 0.0)[0] for lasting in (0.0, 0.3))
    assert sure < -2.5
    assert -1.0 < unsure < 0.0


def test_improving_never_makes_it_less_likely() -> None:
    rng = np.random.default_rng(11)
    places = rng.uniform(0, 0.4, (30, 3))
    likelihood = Likelihood(places, 0.5, None)
    start = rng.integers(0, 8, 30)
    assert likelihood(improve(start, likelihood)) >= likelihood(start)


def test_a_change_of_two_clusters_is_as_likely_as_the_partition_anew() -> None:
    rng = np.random.default_rng(23)
    places = rng.uniform(0, 0.4, (20, 3))
    evidence = np.triu(rng.normal(size=(20, 20)) * (rng.random((20, 20)) < 0.3), 1)
    likelihood = Likelihood(places, 0.5, csr_matrix(evidence + evidence.T))
    a, b, c = np.arange(7), np.arange(7, 12), np.arange(12, 20)
    sums = likelihood.changed(likelihood.sums([a, b, c]), [a, b], [np.arange(9), np.arange(9, 12)])
    label = np.repeat([0, 1, 2], [9, 3, 8])
    assert likelihood.of(sums) == pytest.approx(likelihood(label), abs=1e-9)


def test_evidence_of_few_pairs_is_not_diluted_by_the_other_members() -> None:
    """One known pair in a cluster of four counts as much as in a cluster of two: else it would pay to split."""
    places = np.array([[0.0, 0, 1], [0.02, 0, 1], [0.0, 0.02, 1], [0.02, 0.02, 1]])
    evidence = np.zeros((4, 4))
    evidence[0, 1] = evidence[1, 0] = 3.0
    known, unknown = (Likelihood(places, 0.5, e) for e in (csr_matrix(evidence), None))
    for label in (np.array([0, 0, 0, 0]), np.array([0, 0, 1, 1])):
        assert known(label) - unknown(label) == pytest.approx(3.0)
    full = Likelihood(places, 0.5, csr_matrix(3.0 * (1.0 - np.eye(4))))
    assert full(np.zeros(4)) - unknown(np.zeros(4)) == pytest.approx(9.0)  # six pairs, three of them new


def test_flowers_without_evidence_do_not_raise_the_weight_of_that_of_others() -> None:
    """Three flowers known to move as one: joined by others of which nothing is known, their evidence is the same."""
    places = np.random.default_rng(17).uniform(0.0, 0.1, (6, 3))
    evidence = np.zeros((6, 6))
    evidence[:3, :3] = 4.0 * (1.0 - np.eye(3))
    known, unknown = (Likelihood(places, 0.5, e) for e in (csr_matrix(evidence), None))
    for label in (np.array([0, 0, 0, 1, 1, 1]), np.zeros(6, dtype=np.int64)):
        assert known(label) - unknown(label) == pytest.approx(8.0)  # three pairs, two of them new


def test_likelihood_does_not_depend_on_names() -> None:
    rng = np.random.default_rng(13)
    places = rng.uniform(0, 0.4, (12, 3))
    label = rng.integers(0, 4, 12)
    evidence = csr_matrix(np.where(np.eye(12) > 0, 0.0, 1.0))
    likelihood = Likelihood(places, 0.5, evidence)
    assert likelihood(label) == pytest.approx(likelihood(7 - 2 * label), abs=1e-9)


def test_flowers_that_are_often_missed_come_in_clusters_all_the_same() -> None:
    """Each is found in half of the frames that show its cluster: by chance, or as it is hidden for a while."""
    rng = np.random.default_rng(2)
    middles = np.repeat(np.array([[0.0, 0, 1], [0.5, 0, 1], [0.0, 0.5, 1], [0.5, 0.5, 1]]), 4, axis=0)
    places = middles + 0.015 * rng.standard_normal((16, 3))
    share = np.tile([1.0, 0.9, 0.5, 0.25], 4)
    seen = rng.random((16, N_FRAMES)) < share[:, None]
    label = group_flowers(places, csr_matrix(1.0 * seen), None, 0.5, GroupingConfig(), rng=rng)
    np.testing.assert_array_equal(label, np.repeat(np.arange(4), 4))


@pytest.mark.parametrize("hit", [0.3, 0.5, 0.7])
def test_chance_misses_part_no_clusters(hit: float) -> None:
    """Each flower is missed for itself, frame by frame, so that few frames show two of a cluster; nothing moves."""
    rng = np.random.default_rng(5)
    middles = np.repeat(np.array([[0.0, 0, 1], [0.4, 0, 1], [0.0, 0.4, 1], [0.4, 0.4, 1]]), 3, axis=0)
    places = middles + 0.015 * rng.standard_normal((12, 3))
    seen = rng.random((12, N_FRAMES)) < hit
    label = group_flowers(places, csr_matrix(1.0 * seen), None, 0.5, GroupingConfig(), rng=rng)
    np.testing.assert_array_equal(label, np.repeat(np.arange(4), 3))


def test_flowers_that_are_seen_one_by_one_come_in_no_clusters() -> None:
    rng = np.random.default_rng(2)
    places = np.repeat(np.eye(4, 3), 4, axis=0) + 0.015 * rng.standard_normal((16, 3))
    order = rng.integers(16, size=N_FRAMES)
    seen = csr_matrix((np.ones(N_FRAMES), (order, np.arange(N_FRAMES))), shape=(16, N_FRAMES))
    label = group_flowers(places, seen, None, 0.5, GroupingConfig(), rng=rng)
    np.testing.assert_array_equal(label, np.arange(16))


def test_flowers_that_move_as_one_come_in_clusters_however_seldom_they_are_seen_together() -> None:
    rng = np.random.default_rng(31)
    places = np.array([[0.0, 0, 1], [0.03, 0, 1], [0.0, 0.04, 1]])
    seen = np.repeat(rng.random((3, N_FRAMES // 20)) < 0.35, 20, axis=1)  # each is hidden for a while, again and again
    motion = motion_of(np.zeros(3, dtype=np.int64), 0.01, rng=rng)
    hidden = Motion(np.where(seen.T[..., None], motion.u, np.nan), np.where(seen.T, motion.var, np.nan), STAMPS)
    presence = csr_matrix(1.0 * seen)
    alone, together = (group_flowers(places, presence, m, 0.5, GroupingConfig(), rng=rng) for m in (None, hidden))
    np.testing.assert_array_equal(alone, [0, 1, 2])
    np.testing.assert_array_equal(together, [0, 0, 0])


@pytest.mark.parametrize(("n_hidden", "motion", "is_cluster"), [(1, 0, True), (3, 0, False), (3, 1, True)])
def test_who_is_seen_together_less_must_move_as_one(n_hidden: int, motion: float, is_cluster: bool) -> None:
    rng = np.random.default_rng(71)
    places = np.array([[0.0, 0, 1], [0.03, 0, 1], [0.0, 0.04, 1]])
    turn = np.arange(N_FRAMES) // 10 + np.arange(3)[:, None]  # of five, in so many of which each is hidden
    seen = turn % 5 >= n_hidden
    moved = motion_of(np.zeros(3, dtype=np.int64), 0.01 * motion, rng=rng)
    hidden = Motion(np.where(seen.T[..., None], moved.u, np.nan), np.where(seen.T, moved.var, np.nan), STAMPS)
    found = group_flowers(places, csr_matrix(1.0 * seen), hidden, 0.5, GroupingConfig(), rng=rng)
    assert (found.max() == 0) == is_cluster


def test_clusters_of_two_are_clusters() -> None:
    rng = np.random.default_rng(5)
    middles = np.array([[0.0, 0, 1], [0.5, 0, 1], [0.0, 0.5, 1], [0.5, 0.5, 1], [1.0, 0.2, 1], [1.1, 0.7, 1]])
    places = np.repeat(middles, 2, axis=0) + 0.02 * rng.standard_normal((12, 3))
    np.testing.assert_array_equal(grouped(places, None), np.repeat(np.arange(6), 2))


@pytest.mark.parametrize("n", [2, 3])
def test_few_flowers_that_stand_together_are_a_cluster(n: int) -> None:
    """Where one look shows half a metre, a hand is small, though nothing else tells how far apart flowers are."""
    rng = np.random.default_rng(53)
    found = [group_few(0.02 * rng.standard_normal((n, 3)), rng=rng) for _ in range(40)]
    assert np.mean([label.max() == 0 for label in found]) > 0.75


def test_few_flowers_that_stand_anywhere_are_seldom_called_a_cluster() -> None:
    """The likeliest of many partitions has clusters by chance."""
    rng = np.random.default_rng(0)
    found = [grouped(rng.uniform(0, 1, (6, 3)) * np.array([2.0, 0.3, 0.6]), None) for _ in range(100)]
    assert np.mean([label.max() < 5 for label in found]) < 0.15
    assert np.mean([np.bincount(label).max() > 2 for label in found]) < 0.1


def group_few(places: Array, *, rng: np.random.Generator) -> Array:
    presence = csr_matrix(np.ones((len(places), N_FRAMES)))
    return group_flowers(places, presence, None, 0.15, GroupingConfig(), rng=rng)


def test_one_flower_that_moved_apart_is_one_statement() -> None:
    """Of four flowers one moved apart from each other: as much evidence as where all six pairs are known."""
    places = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]])
    star = np.zeros((4, 4))
    star[0, 1:] = star[1:, 0] = -2.0
    known = star.copy()
    known[1:, 1:] = 1e-12 * (1.0 - np.eye(3))
    whole = np.zeros(4, dtype=np.int64)
    of_star, of_all = (Likelihood(places, 1.0, csr_matrix(x)) for x in (star, known))
    assert of_star(whole) == pytest.approx(of_all(whole))
    assert of_star.sums([np.arange(4)]).motion == pytest.approx(-3.0)
