"""Located poses against the truth: numbers by hand."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.evaluation.localised import evaluate_localisation, is_near, pose_nees
from cluster_slam.geometry import se3_exp
from cluster_slam.records import Observations, PoseHypotheses, Session, SessionLocalisation, StatedNoise, Truth


def located(errors: np.ndarray, reasons: tuple[str, ...]) -> tuple[SessionLocalisation, Truth]:
    n = len(reasons)
    true = se3_exp(np.random.default_rng(0).normal(size=(n, 6)))
    frame = np.arange(n)
    seen = Observations(frame, np.ones((n, 3)), np.tile(1e-6 * np.eye(3), (n, 1, 1)), np.full(n, np.nan))
    session = Session("s", 1.0 + frame, true, "T_world_camera", "absolute", None, StatedNoise(), seen)
    none = PoseHypotheses(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 4, 4)))
    T = true @ se3_exp(errors)
    covs = np.tile(np.diag(np.repeat([1e-4, 1e-6], 3)), (n, 1, 1))
    flowers = np.array([4, 5, -1, 6])
    found = SessionLocalisation(
        session,
        reasons,
        ("p",) * n,
        frame,
        np.ones(n),
        T,
        covs,
        flowers,
        flowers,
        none,  # type: ignore[arg-type]
    )
    truth = Truth(true, np.array([40, 50, -1, -1]), np.array([40, 50, -1, -1]), T_map_world=np.eye(4))
    return found, truth


def test_figures_by_hand() -> None:
    """Errors of 3 mm and 0.01 rad: NEES (0.003 / 0.001)^2 and (0.01 / 0.01)^2; the fourth frame is lost."""
    errors = np.zeros((4, 6))
    errors[0, 3], errors[1, 0] = 0.003, 0.01
    errors[3, 3] = 1.0
    found, truth = located(errors, ("", "", "", "ambiguous"))
    metrics = evaluate_localisation(found, truth)
    assert metrics.located == 0.75
    assert not metrics.is_aligned
    assert metrics.ate_rmse_m == pytest.approx(0.003 / np.sqrt(3.0))
    assert metrics.ate_rotation_rad == pytest.approx(0.01 / np.sqrt(3.0))
    assert metrics.nees_poses == pytest.approx((9.0 + 1.0) / 3.0 / 6.0)
    assert metrics.within_1cm_1deg == 1.0
    assert metrics.flower_idf1 == 1.0  # 40 is 4 and 50 is 5: names need not agree; frame four is lost
    assert metrics.clutter_precision == metrics.clutter_recall == 1.0


def test_a_centimetre_and_a_degree_are_the_border() -> None:
    true = np.tile(np.eye(4), (4, 1, 1))
    errors = np.zeros((4, 6))
    errors[0, 4], errors[1, 4], errors[2, 1], errors[3, 1] = 0.0099, 0.0101, np.radians(0.99), np.radians(1.01)
    np.testing.assert_array_equal(is_near(se3_exp(errors), true), [True, False, True, False])
    np.testing.assert_allclose(pose_nees(se3_exp(errors), np.tile(1e-4 * np.eye(6), (4, 1, 1)), true)[0], 0.9801)


def test_nothing_located_says_so() -> None:
    found, truth = located(np.zeros((4, 6)), ("no_match",) * 4)
    assert evaluate_localisation(found, truth).as_json() == {"located": 0.0, "is_aligned": False}
