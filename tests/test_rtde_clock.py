"""Clocks: offset and drift from stamps that arrive late."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_slam.sensors.clock import ClockEstimator, fit_clock

UNIX = 1.7e9


def arrivals(stamps: np.ndarray, offset: float, drift: float, delays: np.ndarray) -> np.ndarray:
    """When stamps arrive on a clock that began at ``offset`` and runs ``drift`` faster."""
    return offset + (1 + drift) * stamps + delays


def test_without_delays_the_line_is_exact() -> None:
    stamps = np.arange(0.0, 60.0, 0.5)
    clock = fit_clock(stamps, arrivals(stamps, 5.0, 1e-4, np.zeros(len(stamps))))
    assert clock.drift == pytest.approx(1e-4, abs=1e-9)
    assert clock.arrival(np.array([0.0, 100.0])) == pytest.approx([5.0, 105.01], abs=1e-7)
    assert clock.stamp(clock.arrival(np.array([12.5]))) == pytest.approx([12.5])


@given(st.floats(-2e-4, 2e-4), st.integers(0, 100))
def test_drift_under_exponential_delays(drift: float, seed: int) -> None:
    """Delays of 2 ms on average at 125 Hz for a minute. The smallest of n = 125 exponentials of mean m has mean m / n:
    a second's smallest delay is 16 us; the line through the hull is off by some of these over half a minute: < 5 ppm.
    """
    rng = np.random.default_rng(seed)
    stamps = 1000.0 + np.arange(0, 60, 0.008)
    clock = fit_clock(stamps, arrivals(stamps, UNIX, drift, rng.exponential(0.002, len(stamps))))
    assert clock.drift == pytest.approx(drift, abs=5e-6)
    truth = arrivals(stamps, UNIX, drift, np.zeros(len(stamps)))
    assert np.abs(clock.arrival(stamps) - truth).max() < 3e-4


def test_too_short_for_a_drift() -> None:
    stamps = np.arange(0.0, 5.0, 0.01)
    clock = fit_clock(stamps, arrivals(stamps, 5.0, 1e-3, np.zeros(len(stamps))))
    assert clock.drift == 0.0
    assert clock.arrival(stamps[:1])[0] == pytest.approx(5.0)


def test_the_estimator_agrees_with_the_fit_of_all() -> None:
    rng = np.random.default_rng(1)
    stamps = 1000.0 + np.arange(0, 60, 0.008)
    times = arrivals(stamps, UNIX, 5e-5, rng.exponential(0.002, len(stamps)))
    estimator = ClockEstimator()
    assert not any(estimator.add(s, a) for s, a in zip(stamps.tolist(), times.tolist(), strict=True))
    assert estimator.clock is not None
    assert estimator.clock.drift == pytest.approx(5e-5, abs=5e-6)
    whole = fit_clock(stamps, times)
    assert np.abs(estimator.clock.arrival(stamps) - whole.arrival(stamps)).max() < 2e-4


@pytest.mark.parametrize("step", [-900.0, 5.0, 0.5])
def test_a_clock_that_is_set_is_noticed(step: float) -> None:
    """Set back, or forward: the estimate begins anew, within two seconds where stamps only seem late."""
    estimator = ClockEstimator()
    stamps = 1000.0 + np.arange(0, 20, 0.01)
    for s in stamps[:1000].tolist():
        assert not estimator.add(s, UNIX + s)
    jumps = [s for s in stamps[1000:].tolist() if estimator.add(s + step, UNIX + s)]
    assert len(jumps) == 1
    assert jumps[0] - stamps[1000] < 2.1
    assert estimator.clock is not None
    assert estimator.clock.offset_s == pytest.approx(UNIX - step)


def test_a_clock_that_is_set_the_other_way() -> None:
    """Forward on this machine: all arrivals are late at once."""
    estimator = ClockEstimator()
    for k in range(3000):
        estimator.add(0.01 * k, UNIX + 0.01 * k + (0.4 if k >= 1000 else 0.0))
    assert estimator.n_jumps == 1
    assert estimator.clock is not None
    assert estimator.clock.offset_s == pytest.approx(UNIX + 0.4)


def test_a_pause_of_the_network_is_no_jump() -> None:
    """A second without arrivals, then all at once: late, but not for long."""
    estimator = ClockEstimator()
    for k in range(3000):
        late = max(10.0 + 1.0 - 0.01 * k, 0.0) if k >= 1000 else 0.0
        assert not estimator.add(0.01 * k, UNIX + 0.01 * k + late)
    assert estimator.n_jumps == 0
