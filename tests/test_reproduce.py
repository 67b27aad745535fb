"""The paper run again: MATLAB's streams, its tables, the page."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

import cluster_slam.reproduce.matlab_rng as matlab_rng
from cluster_slam.errors import ConfigError, OutputError
from cluster_slam.reproduce import reproduce_paper
from cluster_slam.reproduce.matlab_rng import MatlabStream
from cluster_slam.reproduce.paper_page import Reproduction
from cluster_slam.reproduce.settings import Settings
from cluster_slam.reproduce.table1 import table1


def test_the_stream_is_the_documented_one() -> None:
    """MathWorks prints the mean, standard deviation and variance of 5 randn(1000, 1) + 500 under rng(0)."""
    x = 5 * MatlabStream(0).randn(1000, 1) + 500
    assert (round(x.mean(), 4), round(x.std(ddof=1), 4), round(x.var(ddof=1), 4)) == (499.8368, 4.9948, 24.9483)


def test_uniform_numbers_are_those_of_the_legacy_generator() -> None:
    expected = np.random.RandomState(7).random_sample(20)
    np.testing.assert_array_equal(MatlabStream(7).rand(4, 5), expected.reshape(5, 4).T)
    assert MatlabStream(0).rand(1)[0] == np.random.RandomState(5489).random_sample()
    whole = MatlabStream(3).randi(3, 6, 5000)
    assert sorted(set(whole.tolist())) == [3, 4, 5, 6]


def test_normal_numbers_do_not_depend_on_how_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slow paths (tail, wedge) at the ends of requests and of blocks of words."""
    expected = MatlabStream(11).randn(20_000)
    monkeypatch.setattr(matlab_rng, "BLOCK", 64)
    stream = MatlabStream(11)
    pieces = [stream.randn(n % 23) for n in range(1, 1800)]
    np.testing.assert_array_equal(np.concatenate(pieces)[:20_000], expected[: sum(map(len, pieces))])


def test_normal_numbers_are_normal() -> None:
    from scipy import stats

    x = MatlabStream(5).randn(200_000)
    assert stats.kstest(x, "norm").pvalue > 1e-3
    assert (np.abs(x) > matlab_rng.RADIUS).sum() == pytest.approx(
        200_000 * 2 * stats.norm.sf(matlab_rng.RADIUS), abs=30
    )


@pytest.fixture(scope="module")
def reproduction(tmp_path_factory: pytest.TempPathFactory) -> Reproduction:
    return reproduce_paper(tmp_path_factory.mktemp("paper") / "out")


def table(reproduction: Reproduction, name: str) -> list[dict[str, str]]:
    with (reproduction.out / name).open(newline="") as file:
        return list(csv.DictReader(file))


def test_table_1_is_the_printed_one(reproduction: Reproduction) -> None:
    rows = table(reproduction, "table1.csv")
    assert [tuple(row.values()) for row in rows] == [
        ("0.01", "1.2314e-06", "5.01"),
        ("0.02", "4.1397e-06", "4.93"),
        ("0.03", "4.1437e-05", "4.83"),
        ("0.04", "1.5409e-04", "4.75"),
        ("0.05", "4.0231e-04", "4.65"),
    ]
    assert list(rows[0]) == ["noise", "frobenius_norm", "outlier_percent"]
    assert reproduction.is_table1_exact


def test_the_transforms_error_is_the_beta_term(reproduction: Reproduction) -> None:
    for row in reproduction.table1:  # 71 sigma^4: 60 of it from var(I), (2 d^2 - 2 d) sigma^4 with d = 6
        assert row.transform_error == pytest.approx(71.1 * row.noise**4, rel=0.002)
        assert abs(row.exact_outlier_percent - 5.0) < 0.2


def test_table_2_is_what_the_protocol_gives(reproduction: Reproduction) -> None:
    rows = {(row["reading"].split(":")[0], row["padding"]): row for row in table(reproduction, "table2.csv")}
    literal = rows["literal", "none"]
    assert (int(literal["correct_match"]), float(literal["false_positive_avg"])) == (9494, 21.2287)
    assert int(rows["literal", "sigma"]["correct_match"]) == 9991
    assert int(rows["both frames noisy", "none"]["correct_match"]) == 7786
    for (reading, padding), row in rows.items():
        if padding != "none":  # the paper's claim: padding raises both
            assert int(row["correct_match"]) > int(rows[reading, "none"]["correct_match"])
            assert float(row["false_positive_avg"]) > float(rows[reading, "none"]["false_positive_avg"])


def test_table_3_resembles_the_printed_one(reproduction: Reproduction) -> None:
    share = {row.comparison: row.match / row.n_frames for row in reproduction.table3}
    assert share["Data1-Data1"] >= 0.995
    assert 0.4 <= share["Data3-Data3"] <= 0.6
    assert share["Data2-Data1"] < 0.1
    assert share["Data4-Data3"] < 0.1
    assert reproduction.own_frame_matches == 4954  # whatever the data: the squared distance cannot exceed 1 / beta
    assert [row["n_frames"] for row in table(reproduction, "table3.csv")] == ["4954", "277", "2437", "1005"]


def test_the_page_holds_all_it_needs(reproduction: Reproduction) -> None:
    page = (reproduction.out / "index.html").read_text()
    assert "All ten numbers are as printed" in page
    assert "does not reproduce" in page
    assert "synthetic" in page
    assert page.count("data:image/png;base64,") == 8
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    for figure in range(2, 9):
        assert (reproduction.out / f"figure{figure}.png").stat().st_size > 10_000


def test_other_settings_are_not_called_the_papers(tmp_path: Path) -> None:
    rows = table1(Settings(alpha=1e-3, noise=0.02, scale=0.5), n_samples=200)
    assert [row.noise for row in rows] == [0.02, 0.04, 0.06, 0.08, 0.1]
    beta_true = table1(Settings(beta=1.0 / 3.0), n_samples=200)
    assert all(row.transform_error < 0.2 * 71 * row.noise**4 for row in beta_true)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"alpha": 0.0}, "alpha"),
        ({"noise": -0.01}, "noise"),
        ({"scale": float("nan")}, "scale"),
        ({"kappa": -9.0}, "kappa"),
    ],
)
def test_bad_options_are_named(tmp_path: Path, options: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        reproduce_paper(tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        reproduce_paper(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
