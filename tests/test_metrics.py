"""Identity scores, HOTA and GOSPA: cases to check by hand, laws, and two oracles."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.metrics import gospa, hota, identity_scores

LABELS = st.lists(st.tuples(st.integers(-1, 4), st.integers(-1, 4)), min_size=1, max_size=30)
FEW = st.lists(st.tuples(st.integers(-1, 2), st.integers(-1, 2)), min_size=1, max_size=15)  # for brute force


def rows(pairs: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    true, estimated = zip(*pairs, strict=True)
    return np.array(true), np.array(estimated)


def brute_idf1(true: np.ndarray, estimated: np.ndarray) -> float:
    """Every one-to-one matching of ids tried."""
    a, b = sorted(set(true) - {-1}), sorted(set(estimated) - {-1})
    padded = b + [None] * len(a)
    best = 0
    for order in itertools.permutations(padded, len(a)):
        partner = dict(zip(a, order, strict=True))
        best = max(best, sum(t != -1 and e != -1 and partner[t] == e for t, e in zip(true, estimated, strict=True)))
    whole = (true != -1).sum() + (estimated != -1).sum()
    return 2 * best / whole if whole else 1.0


def brute_hota(true: np.ndarray, estimated: np.ndarray) -> tuple[float, float]:
    """Detection and association score with one loop a row, as the paper's definitions read."""
    tp = [(t, e) for t, e in zip(true, estimated, strict=True) if t != -1 and e != -1]
    fn = ((true != -1) & (estimated == -1)).sum()
    fp = ((true == -1) & (estimated != -1)).sum()
    scores = []
    for t, e in tp:
        tpa = sum(pair == (t, e) for pair in tp)
        fna = sum((true == t) & (estimated != e))
        fpa = sum((true != t) & (estimated == e))
        scores.append(tpa / (tpa + fna + fpa))
    return len(tp) / (len(tp) + fn + fp), float(np.mean(scores))


def test_identity_swap_by_hand() -> None:
    # object 0 is called 7 three times and 8 once; 1 is called 8 twice and is missed once; one clutter row is called 8
    true = np.array([0, 0, 0, 0, 1, 1, 1, -1, -1])
    estimated = np.array([7, 7, 7, 8, 8, 8, -1, 8, -1])
    scores = identity_scores(true, estimated)
    assert (scores.n_idtp, scores.n_idfp, scores.n_idfn) == (5, 2, 2)
    assert scores.idf1 == pytest.approx(10 / 14)
    assert scores.precision == scores.recall == pytest.approx(5 / 7)
    assert scores.true_ids.tolist() == [0, 1]
    assert scores.estimated_ids.tolist() == [7, 8]


def test_identity_matching_is_global_and_not_greedy() -> None:
    # greedy takes 0-10 (3 rows) and is left with nothing for 1; the best is 0-11 (2) and 1-10 (2)
    true = np.array([0] * 5 + [1] * 2)
    estimated = np.array([10] * 3 + [11] * 2 + [10] * 2)
    assert identity_scores(true, estimated).n_idtp == 4


def test_a_second_id_of_one_object_costs_both_ways() -> None:
    scores = identity_scores(np.zeros(10, int), np.repeat([3, 4], [8, 2]))
    assert (scores.n_idtp, scores.n_idfp, scores.n_idfn) == (8, 2, 2)
    assert scores.true_ids.tolist() == [0]


def test_hota_by_hand() -> None:
    # 4 rows right and 1 false positive and 1 miss: DetA = 4 / 6; object 0: two ids, 2 rows each
    true = np.array([0, 0, 0, 0, 0, -1])
    estimated = np.array([5, 5, 6, 6, -1, 6])
    scores = hota(true, estimated)
    assert scores.detection == pytest.approx(4 / 6)
    assert scores.association == pytest.approx((2 * 2 / (2 + 3 + 0) + 2 * 2 / (2 + 3 + 1)) / 4)
    assert scores.hota == pytest.approx(np.sqrt(scores.detection * scores.association))


@given(FEW)
def test_scores_equal_brute_force(pairs: list[tuple[int, int]]) -> None:
    true, estimated = rows(pairs)
    assert identity_scores(true, estimated).idf1 == pytest.approx(brute_idf1(true, estimated))
    if ((true != -1) & (estimated != -1)).any():
        scores = hota(true, estimated)
        assert (scores.detection, scores.association) == pytest.approx(brute_hota(true, estimated))


@given(LABELS, st.permutations(range(5)), st.permutations(range(5)))
def test_names_of_ids_do_not_matter(pairs: list[tuple[int, int]], p: list[int], q: list[int]) -> None:
    true, estimated = rows(pairs)
    renamed = np.append(p, -1)[true], np.append(q, -1)[estimated] * 10**9
    renamed[1][estimated == -1] = -1
    assert identity_scores(*renamed).idf1 == pytest.approx(identity_scores(true, estimated).idf1)
    assert hota(*renamed).hota == pytest.approx(hota(true, estimated).hota)


@given(LABELS)
def test_perfect_labels_score_one(pairs: list[tuple[int, int]]) -> None:
    true, _ = rows(pairs)
    assert identity_scores(true, true).idf1 == 1.0
    assert hota(true, true).hota == pytest.approx(1.0)


@given(LABELS)
def test_identity_score_is_symmetric(pairs: list[tuple[int, int]]) -> None:
    true, estimated = rows(pairs)
    assert identity_scores(true, estimated).idf1 == pytest.approx(identity_scores(estimated, true).idf1)


def test_scores_equal_motrics() -> None:
    motrics = pytest.importorskip("motrics", reason="extra `eval` is not installed")
    rng = np.random.default_rng(5)
    true = rng.integers(-1, 6, 400)
    estimated = np.where(rng.random(400) < 0.7, true, rng.integers(-1, 8, 400))
    # each row is an instant of its own, where the two detections, if both are there, are at the same place
    gt = [[int(t)] if t != -1 else [] for t in true]
    pred = [[int(e)] if e != -1 else [] for e in estimated]
    similarity = [np.ones((len(g), len(p))) for g, p in zip(gt, pred, strict=True)]
    identity = motrics.compute_identity_from_similarity(gt, pred, similarity)
    theirs = motrics.compute_hota_from_similarity(gt, pred, similarity)
    ours, ours_hota = identity_scores(true, estimated), hota(true, estimated)
    assert (ours.n_idtp, ours.n_idfp, ours.n_idfn) == (identity.idtp, identity.idfp, identity.idfn)
    assert ours.idf1 == pytest.approx(identity.idf1)
    assert ours_hota.hota == pytest.approx(theirs.hota)
    assert (ours_hota.detection, ours_hota.association) == pytest.approx((theirs.deta, theirs.assa))


def test_labels_of_two_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(2,\) and \(3,\)"):
        identity_scores(np.zeros(2, int), np.zeros(3, int))


def test_nothing_to_find_and_nothing_found() -> None:
    nothing = np.array([-1, -1])
    assert identity_scores(nothing, nothing).idf1 == hota(nothing, nothing).hota == 1.0
    assert identity_scores(nothing, np.array([3, 3])).idf1 == hota(nothing, np.array([3, 3])).hota == 0.0


def test_gospa_by_hand() -> None:
    # 0.3 and 0.4 apart, one true point missed and two false, cutoff 1: sqrt(0.09 + 0.16 + 3 / 2)
    true = np.array([[0.0, 0, 0], [5, 0, 0], [9, 9, 9]])
    estimated = np.array([[0.3, 0, 0], [5, 0.4, 0], [20, 0, 0], [30, 0, 0]])
    scores = gospa(true, estimated, cutoff=1.0)
    assert scores.total == pytest.approx(np.sqrt(0.25 + 1.5))
    assert (scores.n_missed, scores.n_false) == (1, 2)
    assert scores.localisation == pytest.approx(0.5)
    assert scores.missed == pytest.approx(np.sqrt(0.5))
    assert scores.false == pytest.approx(1.0)


def test_gospa_cuts_off_a_pair_that_is_too_far() -> None:
    scores = gospa(np.zeros((1, 3)), np.array([[2.0, 0, 0]]), cutoff=0.5, order=1.0)
    assert scores.total == pytest.approx(0.5)
    assert (scores.n_missed, scores.n_false) == (1, 1)


@given(st.integers(0, 6), st.integers(0, 6), st.integers(0, 2**32 - 1))
def test_gospa_laws(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = rng.normal(size=(n, 3)), rng.normal(size=(m, 3)), rng.normal(size=(3, 3))
    d = gospa(a, b, 1.5).total
    assert d == pytest.approx(gospa(b, a, 1.5).total)
    assert gospa(a, a[rng.permutation(n)], 1.5).total == pytest.approx(0.0)
    assert d <= gospa(a, c, 1.5).total + gospa(c, b, 1.5).total + 1e-12
    parts = gospa(a, b, 1.5)
    assert d**2 == pytest.approx(parts.localisation**2 + parts.missed**2 + parts.false**2)


@pytest.mark.parametrize(("cutoff", "order"), [(0.0, 2.0), (-1.0, 2.0), (1.0, 0.5), (np.nan, 2.0)])
def test_gospa_refuses_what_is_out_of_range(cutoff: float, order: float) -> None:
    with pytest.raises(ValueError, match="cutoff must be above 0"):
        gospa(np.zeros((1, 3)), np.zeros((1, 3)), cutoff, order)
