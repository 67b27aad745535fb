"""Figures: all there, the same bytes twice, right numbers on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_result import Made, make
from test_evaluation import made_empty

from cluster_slam.errors import InputError, OutputError
from cluster_slam.io.result import write_result
from cluster_slam.report import drawings
from cluster_slam.report.figures import KINDS, write_figures
from cluster_slam.report.folder import open_result


@pytest.fixture(scope="module")
def made() -> Made:
    return make(0, n_frames=60)


def test_all_figures_are_written_and_the_same_twice(made: Made, tmp_path: Path) -> None:
    first = write_figures(made.result, tmp_path / "a", dpi=60)
    again = write_figures(made.result, tmp_path / "b", formats=["svg"])
    assert [p.name for p in first] == [f"{kind.name}.{suffix}" for kind in KINDS for suffix in ("png", "svg")]
    for path in again:
        assert path.read_bytes() == (tmp_path / "a" / path.name).read_bytes()
    assert (tmp_path / "a" / "map.png").read_bytes()[:4] == b"\x89PNG"
    assert "<svg" in (tmp_path / "a" / "map.svg").read_text("utf-8")


def test_ellipses_are_the_projected_95_percent_ellipsoids(made: Made) -> None:
    covs = np.tile(np.diag([4e-6, 4e-6, 4e-6]), (len(made.result.flowers), 1, 1))
    result = replace(made.result, flowers=replace(made.result.flowers, covs=covs))
    figure = drawings.draw_map(result)
    assert figure is not None
    drawn = figure.axes[0].patches[0]
    factor = float(figure.axes[0].get_title(loc="left").split("drawn ")[-1].split()[0].replace("95", "1"))
    assert drawn.width == pytest.approx(2 * factor * 0.002 * np.sqrt(7.814728), rel=1e-5)
    assert drawn.width == pytest.approx(drawn.height)


def test_map_shows_the_plant_as_the_camera_sees_it(made: Made) -> None:
    rows = drawings._axes(made.result)
    np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rows) == pytest.approx(1.0)
    T = made.result.T_world_camera
    assert rows[0] @ T[:, :3, 0].mean(0) > 0.9  # the camera's right
    assert rows[1] @ T[:, :3, 2].mean(0) > 0.7  # its forward
    assert rows[2] @ -T[:, :3, 1].mean(0) > 0.9  # its up


def test_correction_over_time_by_hand(made: Made) -> None:
    given = made.session.T_world_camera
    shifted = given.copy()
    shifted[:, :3, 3] += given[:, :3, 0] * 0.002  # 2 mm to the camera's right
    figure = drawings.draw_trajectory(replace(made.result, T_world_camera=shifted))
    assert figure is not None
    right, down, forward = (line.get_ydata() for line in figure.axes[1].get_lines())
    np.testing.assert_allclose(right, 2.0, atol=1e-9)
    np.testing.assert_allclose([down, forward], 0.0, atol=1e-9)


def test_spans_of_frames_by_hand() -> None:
    seconds = np.array([0.0, 1.0, 2.0, 3.5, 4.0])
    assert drawings._spans(np.array([0, 1, 3]), seconds) == [(0.0, 2.0), (3.5, 0.5)]
    assert drawings._spans(np.array([], dtype=int), seconds) == []


def test_what_has_no_data_is_left_out(tmp_path: Path) -> None:
    assert write_figures(made_empty().result, tmp_path) == ()


def test_unknown_formats_and_folders_in_the_way_are_refused(made: Made, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"unknown format 'gif', expected one of png, svg, pdf"):
        write_figures(made.result, tmp_path, formats=["gif"])
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_figures(made.result, tmp_path / "file", formats=["svg"])


def test_a_folder_is_enough(made: Made, tmp_path: Path) -> None:
    write_result(made.result, tmp_path / "result")
    alone = open_result(tmp_path / "result")
    np.testing.assert_allclose(alone.T_world_camera, made.result.T_world_camera, atol=1e-8)
    assert alone.session.observations.frame.tolist() == made.session.observations.frame.tolist()
    assert len(write_figures(alone, tmp_path / "figures", formats=["svg"])) == len(KINDS)
    whole = open_result(tmp_path / "result", made.session)
    assert whole.session is made.session
    with pytest.raises(InputError):
        open_result(tmp_path)
