"""Process models: what a swaying, a resting and a growing group do next."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tracking.motion import (
    MotionConfig,
    MotionKind,
    advance,
    amplitude,
    process_noise,
    state_at_rest,
    touch_noise,
)

CONFIG = MotionConfig()
ANCHOR = np.array([0.3, -0.2, 1.1])


def state(d: float, v: float, hz: float) -> np.ndarray:
    x, _ = state_at_rest(ANCHOR, CONFIG)
    x[0] += d
    x[3] = v
    x[7] = np.log(2 * np.pi * hz)
    return x


@pytest.mark.parametrize("hz", [0.5, 1.3, 3.0])
def test_sway_is_the_damped_oscillator(hz: float) -> None:
    omega = 2 * np.pi * hz

    def slope(_t: float, y: np.ndarray) -> list[float]:
        return [y[1], -(omega**2) * y[0] - 2 * CONFIG.damping * omega * y[1]]

    exact = solve_ivp(slope, (0, 0.4), [0.02, 0.1], rtol=1e-10, atol=1e-13).y[:, -1]
    moved = advance(state(0.02, 0.1, hz), 0.4, ANCHOR, MotionKind.SWAY, CONFIG)
    np.testing.assert_allclose(moved[[0, 3]] - [ANCHOR[0], 0], exact, atol=1e-8)


def test_two_steps_are_one_long_one() -> None:
    x = state(0.02, -0.3, 1.7)
    for kind in MotionKind:
        twice = advance(advance(x, 0.1, ANCHOR, kind, CONFIG), 0.2, ANCHOR, kind, CONFIG)
        np.testing.assert_allclose(twice, advance(x, 0.3, ANCHOR, kind, CONFIG), atol=1e-12)


def test_rest_forgets_and_stays_as_wide_as_it_trembles() -> None:
    """The stationary variance of the trembling is that of the configuration."""
    var = 0.0
    for _ in range(400):
        x = state(0.0, 0.0, 1.0)
        Q = process_noise(x, 0.05, ANCHOR, MotionKind.REST, CONFIG)
        var = var * np.exp(-2 * 0.05 / CONFIG.tremble_s) + Q[0, 0]
    assert np.sqrt(var) == pytest.approx(CONFIG.tremble_m, rel=1e-6)


def test_growth_goes_on_and_stacks_are_like_single_states() -> None:
    x = state(0.0, 0.001, 1.0)
    assert advance(x, 10.0, ANCHOR, MotionKind.GROWTH, CONFIG)[0] == pytest.approx(ANCHOR[0] + 0.01)
    stack = np.stack([state(0.01, 0.1, 1.0), state(-0.02, 0.3, 2.0)])
    moved = advance(stack, 0.033, ANCHOR, MotionKind.SWAY, CONFIG)
    for one, row in zip(stack, moved, strict=True):
        np.testing.assert_allclose(advance(one, 0.033, ANCHOR, MotionKind.SWAY, CONFIG), row, atol=1e-15)


def test_amplitude_is_kept_without_damping() -> None:
    calm = MotionConfig(damping=0.0)
    x = state(0.02, 0.1, 1.3)
    before = amplitude(x, ANCHOR)
    assert before == pytest.approx(np.hypot(0.02, 0.1 / (2 * np.pi * 1.3)))
    assert amplitude(advance(x, 0.21, ANCHOR, MotionKind.SWAY, calm), ANCHOR) == pytest.approx(before, rel=1e-9)


def test_process_noise_is_a_covariance() -> None:
    for kind in MotionKind:
        for dt in (1e-3, 0.033, 0.4):
            Q = process_noise(state(0.03, 0.2, 2.0), dt, ANCHOR, kind, CONFIG)
            assert np.linalg.eigvalsh(Q)[0] >= -1e-18


def test_unrest_scales_accelerations_of_sway_only() -> None:
    x = state(0.03, 0.2, 2.0)
    for kind, times in ((MotionKind.SWAY, 9.0), (MotionKind.REST, 1.0)):
        usual, wild = (process_noise(x, 0.03, ANCHOR, kind, CONFIG, unrest) for unrest in (1.0, 3.0))
        assert wild[:6, :6] == pytest.approx(times * usual[:6, :6])
        assert wild[6:, 6:] == pytest.approx(usual[6:, 6:])


def test_a_touch_is_a_velocity_for_a_part_of_the_time() -> None:
    rng = np.random.default_rng(3)
    v = rng.normal(size=200_000) * CONFIG.touch_speed
    moved = v * rng.uniform(0.0, 0.05, len(v))
    sampled = np.cov(moved, v)
    N = touch_noise(0.05, CONFIG)
    assert N[::3, ::3] == pytest.approx(sampled, rel=0.03)
    assert N[0, 4] == 0.0
