"""Rendered sessions: geometry against projection, depth against a plane, stereo's faults, and the whole on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cluster_slam.cli.app import run
from cluster_slam.detect import ColourDetector
from cluster_slam.errors import ConfigError
from cluster_slam.io.session import open_session, open_truth
from cluster_slam.sensors.camera import Camera
from cluster_slam.sensors.depth import SUBPIXEL, DepthModel, depth_model
from cluster_slam.simulate.config import PRESETS
from cluster_slam.simulate.render.config import LookConfig
from cluster_slam.simulate.render.facets import Builder
from cluster_slam.simulate.render.frames import Picture, Renderer
from cluster_slam.simulate.render.lens import photograph
from cluster_slam.simulate.render.raster import Placed, paint, rays_of
from cluster_slam.simulate.render.shapes import SQUARE
from cluster_slam.simulate.render.stereo import measure
from cluster_slam.simulate.session import Simulated, simulate_session

CONFIG = replace(PRESETS["sample"], level=1, fps=0.4)


@pytest.fixture(scope="module")
def made() -> Simulated:
    return simulate_session(CONFIG, seed=3)


@pytest.fixture(scope="module")
def renderer(made: Simulated) -> Renderer:
    return Renderer(made, seed=3)


@pytest.fixture(scope="module")
def pictures(renderer: Renderer) -> list[Picture]:
    return [renderer.frame(k) for k in range(3)]


def camera(distortion: float = 0.0) -> Camera:
    coefficients = np.zeros(8)
    coefficients[0] = distortion
    return Camera(300.0, 300.0, 159.5, 119.5, coefficients, 320, 240)


@pytest.mark.parametrize("distortion", [0.0, 0.08])
def test_a_tilted_square_is_where_and_as_deep_as_it_should_be(distortion: float) -> None:
    """A pixel on it, lifted by its painted depth, gives back the plane and the place on it."""
    out = Builder()
    origin, e1, e2 = np.array([-0.1, -0.08, 0.5]), np.array([0.2, 0.0, 0.1]), np.array([0.0, 0.16, -0.05])
    out.add(origin, e1, e2, SQUARE, np.ones(3))
    facets = out.build()
    rays = rays_of(camera(distortion))
    _, painted = paint(facets, Placed(np.arange(1), facets.origins, facets.e1, facets.e2), rays)
    rows, columns = np.nonzero(painted.facet == 0)
    z = painted.z[rows, columns].astype(float)
    points = np.column_stack([rays.x[rows, columns] * z, rays.y[rows, columns] * z, z])
    normal = np.cross(e1, e2) / np.linalg.norm(np.cross(e1, e2))
    assert np.abs((points - origin) @ normal).max() < 1e-6
    expected = origin + painted.s[rows, columns, None] * e1 + painted.t[rows, columns, None] * e2
    np.testing.assert_allclose(points, expected, atol=1e-6)
    corners = camera(distortion).project(origin + SQUARE[:, :1] * e1 + SQUARE[:, 1:] * e2)
    np.testing.assert_allclose([columns.min(), columns.max()], [corners[:, 0].min(), corners[:, 0].max()], atol=1.0)


def test_nearer_things_hide_farther_ones() -> None:
    out = Builder()
    for z in (0.4, 0.8, 0.6):
        out.add(np.array([-0.1, -0.1, z]), np.array([0.2, 0, 0]), np.array([0, 0.2, 0]), SQUARE, np.ones(3))
    facets = out.build()
    kept, painted = paint(facets, Placed(np.arange(3), facets.origins, facets.e1, facets.e2), rays_of(camera()))
    assert painted.z[120, 160] == pytest.approx(0.4)
    assert kept.index[painted.facet[120, 160]] == 0


def test_boxes_lie_on_the_flowers(made: Simulated, pictures: list[Picture]) -> None:
    """A wholly visible flower's middle has the flower's depth, and the picture is brighter there than about it."""
    picture = max(pictures, key=lambda p: (p.boxes.visible > 0.97).sum())
    b = picture.boxes
    whole = np.flatnonzero(
        (b.visible > 0.97) & (b.sizes.min(1) > 9) & (b.centres > 20).all(1) & (b.centres < 440).all(1)
    )
    assert len(whole) >= 2
    for k in whole:
        u, v = np.rint(b.centres[k]).astype(int)
        assert picture.z[v, u] == pytest.approx(b.depths[k], abs=0.008)
        inside = picture.colour[v - 2 : v + 3, u - 2 : u + 3].max()
        assert inside > np.median(picture.colour[v - 20 : v + 20, u - 20 : u + 20])


def test_a_frame_is_the_same_whatever_was_rendered_before(made: Simulated, pictures: list[Picture]) -> None:
    again = Renderer(made, seed=3).frame(2)
    np.testing.assert_array_equal(again.colour, pictures[2].colour)
    np.testing.assert_array_equal(again.depth, pictures[2].depth)


def test_depth_noise_is_that_of_the_model() -> None:
    """A wall at 0.5 m: sigma 0.006 * 0.25 = 1.5 mm; no hole but at the left margin, where one eye does not see."""
    model = depth_model("generic", focal_px=430.0)
    rng, z = np.random.default_rng(0), np.full((240, 320), 0.5, np.float32)
    grey = np.full((240, 320, 3), 100, np.uint8)
    shots = [measure(z, model, grey, 0.0, rng)[:, 40:].astype(float) * model.unit_m for _ in range(12)]
    assert min(shot.min() for shot in shots) > 0
    assert np.mean([shot.std() for shot in shots]) == pytest.approx(0.0015, rel=0.12)
    assert np.mean([shot.mean() for shot in shots]) == pytest.approx(0.5, abs=2e-4)


def test_the_left_of_a_near_thing_is_hidden_from_the_other_eye() -> None:
    """A post at 0.4 m before a wall at 0.8 m: f b (1 / 0.4 - 1 / 0.8) pixels of the wall left of it have no depth."""
    model = DepthModel("exact", SUBPIXEL / 20.0, 4.0, 0.001, 0.1, 10.0)  # f b = 20 m px: 25 px
    z = np.full((60, 200), 0.8, np.float32)
    z[:, 120:140] = 0.4
    found = measure(z, model, np.zeros((60, 200, 3), np.uint8), 0.0, np.random.default_rng(1))
    hidden = (found[:, 30:118] == 0).sum(1)
    assert np.median(hidden) == pytest.approx(25, abs=4)
    assert (found[:, 150:] > 0).mean() > 0.98


def test_limits_holes_and_saturation() -> None:
    model = depth_model("d435", focal_px=430.0)
    rng, grey = np.random.default_rng(2), np.full((100, 400, 3), 100, np.uint8)
    assert (measure(np.full((100, 400), 0.15, np.float32), model, grey, 0.0, rng) == 0).all()
    assert (measure(np.full((100, 400), np.inf, np.float32), model, grey, 0.0, rng) == 0).all()
    wall = np.full((100, 400), 0.6, np.float32)
    share = [(measure(wall, model, grey, 1.0, rng)[:, 60:] == 0).mean() for _ in range(20)]
    assert np.mean(share) == pytest.approx(0.004, rel=0.6)
    white = measure(wall, model, np.full((100, 400, 3), 255, np.uint8), 1.0, rng)
    assert (white[:, 60:] == 0).mean() > 0.4


def test_motion_blurs_along_the_motion_and_keeps_the_place() -> None:
    look = LookConfig(noise=0.0, blur_px=0.3)
    dot = np.zeros((41, 41, 3), np.float32)
    dot[20, 20] = 1.0
    image = photograph(dot, look, 1.0, np.array([8.0, 0.0]), np.random.default_rng(0)).astype(float)[..., 1]
    v, u = np.mgrid[:41, :41]
    assert (u * image).sum() / image.sum() == pytest.approx(20, abs=0.1)
    spread = np.sqrt([((u - 20) ** 2 * image).sum() / image.sum(), ((v - 20) ** 2 * image).sum() / image.sum()])
    assert spread[0] > 2.0 > 1.0 > spread[1]


def test_more_exposure_is_brighter(made: Simulated, pictures: list[Picture]) -> None:
    bright = replace(made, config=replace(made.config, look=replace(made.config.look, exposure=1.6)))
    assert Renderer(bright, seed=3).frame(0).colour.mean() > 1.15 * pictures[0].colour.mean()


@pytest.mark.parametrize("changes", [{"exposure": -1.0}, {"jpeg_quality": 0}, {"depth_camera": "kinect"}])
def test_looks_out_of_range_are_refused(changes: dict) -> None:
    with pytest.raises(ConfigError, match=r"look\."):
        LookConfig(**changes)


def test_a_rendered_session_on_disk(tmp_path: Path) -> None:
    """Written, read, detected and lifted; true identities follow from the boxes of its truth."""
    arguments = ["simulate", str(tmp_path / "s"), "--preset", "sample"]
    options = ["level=1", "duration_s=1.0", "fps=3.0"]
    assert run([*arguments, "--seed", "3", "--quiet", *(x for o in options for x in ("--set", o))]) == 0
    session = open_session(tmp_path / "s", detector=ColourDetector())
    truth = open_truth(tmp_path / "s", session)
    assert session.level == 1
    assert session.n_frames == 3
    assert truth is not None
    assert truth.flower_ids is not None
    shown = truth.flower_ids >= 0
    assert shown.sum() >= 6
    true = truth.rest_positions[truth.flower_ids[shown]]
    T = truth.T_world_camera[session.observations.frame[shown]]
    seen = (T[:, :3, :3] @ session.observations.points[shown, :, None])[..., 0] + T[:, :3, 3]
    assert np.median(np.linalg.norm(seen - true, axis=1)) < 0.008
    assert run(["detect", str(tmp_path / "s"), "-o", str(tmp_path / "d"), "--detector", "colour", "--quiet"]) == 0
    level2 = open_session(tmp_path / "d")
    assert level2.level == 2
    np.testing.assert_allclose(level2.observations.points, session.observations.points, atol=2e-3)


def test_our_detector_finds_what_is_rendered(pictures: list[Picture]) -> None:
    """A small file; of flowers wholly seen and 10 pixels wide it finds most, within a fifth of their width."""
    from cluster_slam.detect import open_detector
    from cluster_slam.detect.onnx import own_model

    assert own_model().stat().st_size < 1_000_000
    detector = open_detector()
    n_found, n_shown = 0, 0
    for picture in pictures:
        found, b = detector.detect(picture.colour), picture.boxes
        for k in np.flatnonzero((b.visible > 0.9) & (b.sizes.min(1) > 10)):
            n_shown += 1
            away = np.linalg.norm(found.centres - b.centres[k], axis=1).min(initial=np.inf)
            n_found += int(away < 0.2 * b.sizes[k].max())
    assert n_shown >= 8
    assert n_found >= 0.7 * n_shown
