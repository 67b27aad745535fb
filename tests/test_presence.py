"""Presence by hand-checked numbers and by simulation of what it claims."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tracking.presence import after_group_miss, after_miss, any_present, persisted

share = st.floats(0.01, 0.99)


def test_by_hand() -> None:
    np.testing.assert_allclose(persisted(np.array([0.8]), 0.1, 2.0), 0.8 * 0.81)
    np.testing.assert_allclose(after_miss(np.array([0.5]), 0.8), 0.1 / 0.6)
    assert any_present(np.array([0.5, 0.5])) == 0.75
    # m = (1 - 0.9 * 0.8)^2 = 0.0784; w = 0.2 / (0.2 + 0.8 * 0.0784); missed one by one: 0.9 * 0.2 / 0.28
    w = 0.2 / (0.2 + 0.8 * 0.0784)
    np.testing.assert_allclose(
        after_group_miss(np.array([0.9, 0.9]), 0.8, 0.2), w * 0.9 + (1 - w) * 0.18 / 0.28, rtol=1e-12
    )


@given(share, share, share)
def test_a_miss_never_makes_it_likelier(presence: float, detection: float, hidden: float) -> None:
    p = np.array([presence, presence])
    alone, group = after_miss(p, detection), after_group_miss(p, detection, hidden)
    assert (alone <= p).all()
    assert (alone <= group + 1e-12).all()  # that all were missed together speaks for a leaf before them
    assert (group <= p + 1e-12).all()


@given(share)
def test_nothing_is_learned_from_no_look(presence: float) -> None:
    assert after_miss(np.array([presence]), 0.0)[0] == presence
    assert persisted(np.array([presence]), 0.02, 0.0)[0] == presence


def test_it_is_as_often_there_as_it_says() -> None:
    """Groups of three, hidden together in 20 % of the looks; of those of which none was seen, how many are there?"""
    rng = np.random.default_rng(5)
    n, p, d, hidden = 400_000, 0.7, 0.6, 0.2
    there = rng.random((n, 3)) < p
    seen = there & (rng.random((n, 3)) < d) & (rng.random((n, 1)) >= hidden)
    missed = ~seen.any(axis=1)
    claimed = after_group_miss(np.full(3, p), d, hidden)[0]
    measured = there[missed].mean()
    assert abs(claimed - measured) < 4 * 0.5 / np.sqrt(3 * missed.sum())
