"""Following and learning again when flowers turn out to belong together otherwise than they were followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam import evaluate, smooth
from cluster_slam.graph.variance import VarianceFactors
from cluster_slam.simulate import PRESETS, simulate_session
from cluster_slam.smoothing.again import joined, same_noise


@pytest.mark.parametrize(
    ("before", "after", "again"),
    [
        ([0, 0, 1, 2], [0, 0, 1, 2], [0, 0, 0, 0]),
        ([0, 0, 1, 2], [5, 5, 3, 4], [0, 0, 0, 0]),  # numbers say nothing
        ([0, 1, 2, 2], [0, 0, 1, 1], [1, 1, 0, 0]),
        ([0, 0, 1, 1], [0, 1, 2, 2], [0, 0, 0, 0]),  # parted
        ([0, 0, 1, 1], [0, 1, 1, 1], [0, 1, 1, 1]),  # parted, and joined to others
    ],
)
def test_only_clusters_that_were_several_are_followed_again(
    before: list[int], after: list[int], again: list[int]
) -> None:
    np.testing.assert_array_equal(joined(np.array(before), np.array(after)), np.array(again, dtype=bool))


def test_sigmas_to_five_percent_are_the_same() -> None:
    usual = VarianceFactors(2.0, 0.5, 1.0)
    assert same_noise(usual, VarianceFactors(2.0 * 1.04**2, 0.5, 3.0))
    assert not same_noise(usual, VarianceFactors(2.0, 0.5 / 1.06**2, 1.0))


def test_three_flowers_that_were_followed_one_by_one_are_found_where_they_sway() -> None:
    """That they are one cluster shows only when all three have moved; what was missed until then is no noise."""
    made = simulate_session(replace(PRESETS["hard-tiny"], duration_s=25.0), seed=944)
    result = smooth(made.session)
    metrics = evaluate(result, made.session, made.truth)
    assert metrics.cluster_idf1 is not None
    assert metrics.cluster_idf1 > 0.98
    assert result.diagnostics.estimated_noise["flower_factor"] == pytest.approx(1.0, abs=0.15)
