"""Bands of normalised errors against SciPy and by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tracking.consistency import coverage, mean_band, nees, nis, share_band
from tracking.errors import ParameterError


def test_bands_of_a_mean_are_scipys() -> None:
    band = mean_band(3, 50, 0.95)
    assert band.low == pytest.approx(stats.chi2.ppf(0.025, 150) / 50)
    assert band.high == pytest.approx(stats.chi2.ppf(0.975, 150) / 50)
    assert 3.0 in band
    assert 2.0 not in band


@pytest.mark.parametrize(("p", "n"), [(0.95, 1), (0.95, 40), (0.5, 1000), (0.999, 100_000)])
def test_bands_of_a_share_are_scipys(p: float, n: int) -> None:
    band = share_band(p, n, 0.95)
    assert band.low * n == pytest.approx(stats.binom.ppf(0.025, n, p))
    assert band.high * n == pytest.approx(stats.binom.ppf(0.975, n, p))


def test_true_covariances_are_consistent_and_wrong_ones_are_not() -> None:
    rng = np.random.default_rng(5)
    n = 4000
    a = rng.standard_normal((n, 3, 3))
    covs = a @ np.swapaxes(a, 1, 2) + 0.1 * np.eye(3)
    errors = (np.linalg.cholesky(covs) @ rng.standard_normal((n, 3, 1)))[..., 0]
    assert nees(errors, covs).mean() in mean_band(3, n, 0.999)
    assert coverage(nees(errors, covs), 3, 0.95, 0.999).is_consistent
    assert nis(errors, 1.15 * covs).mean() not in mean_band(3, n, 0.999)
    assert not coverage(nees(errors, covs / 1.5), 3, 0.95, 0.999).is_consistent


def test_bad_input() -> None:
    with pytest.raises(ParameterError, match="at least one sample"):
        mean_band(3, 0)
    with pytest.raises(ParameterError, match=r"\(0, 1\)"):
        share_band(1.0, 10)
