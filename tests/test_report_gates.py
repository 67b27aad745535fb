"""Gates put to the test: matches with the stated noise pass as often as they should, others do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam import smooth
from cluster_slam.records import Result
from cluster_slam.report.gates import gate_tests
from cluster_slam.simulate import PRESETS, simulate_session
from tracking.consistency import share_band


@pytest.fixture(scope="module")
def result() -> Result:
    return smooth(simulate_session(replace(PRESETS["sample"], duration_s=10.0), seed=8).session)


def test_gates_let_so_many_true_matches_pass_as_they_say(result: Result) -> None:
    tests = {test.name: test.probability for test in gate_tests(result)}
    assert list(tests) == ["position", "descriptor", "full geometry"]
    for name, probability in tests.items():
        band = share_band(0.95, min(len(probability), 100))  # views in a row share the errors of the map
        assert band.low - 0.01 <= float((probability <= 0.95).mean()) <= 1.0, name
    assert abs(float((tests["full geometry"] <= 0.5).mean()) - 0.5) < 0.15
    assert abs(float((tests["descriptor"] <= 0.5).mean()) - 0.5) < 0.15


def test_noise_that_is_twice_what_is_believed_shows_in_each_gate_of_shapes(result: Result) -> None:
    sure = replace(result.diagnostics, estimated_noise={**result.diagnostics.estimated_noise, "flower_factor": 0.5})
    tests = {test.name: test.probability for test in gate_tests(replace(result, diagnostics=sure))}
    assert float((tests["full geometry"] <= 0.95).mean()) < 0.6
    assert float((tests["descriptor"] <= 0.95).mean()) < 0.85


def test_nothing_confirmed_is_nothing_tested(result: Result) -> None:
    none = replace(result.diagnostics, nis=np.full_like(result.diagnostics.nis, np.nan))
    assert gate_tests(replace(result, diagnostics=none)) == ()
