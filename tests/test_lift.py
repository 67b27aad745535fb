"""The camera model against OpenCV and numerical derivatives; lifted covariances against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster_slam.lift import lift
from cluster_slam.sensors.camera import Camera, distort

PLUMB_BOB = np.array([-0.28, 0.09, 0.001, -0.0007, -0.012, 0, 0, 0])  # a wide machine-vision lens
RATIONAL = np.array([0.62, -1.1, 0.0006, -0.0002, 0.4, 0.5, -0.98, 0.35])  # a depth camera's colour lens


def camera(distortion: np.ndarray) -> Camera:
    return Camera(420.0, 425.0, 322.0, 238.0, distortion, 640, 480)


@pytest.mark.parametrize("distortion", [PLUMB_BOB, RATIONAL], ids=["plumb_bob", "rational"])
def test_projection_is_opencvs(distortion: np.ndarray) -> None:
    import cv2

    points = np.random.default_rng(0).uniform([-0.5, -0.4, 0.8], [0.5, 0.4, 1.5], (50, 3))
    K = np.array([[420.0, 0, 322], [0, 425, 238], [0, 0, 1]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera(distortion).project(points), expected, atol=1e-9)


@pytest.mark.parametrize("distortion", [PLUMB_BOB, RATIONAL], ids=["plumb_bob", "rational"])
@settings(max_examples=60, deadline=None)
@given(st.floats(0, 639), st.floats(0, 479), st.floats(0.1, 5))
def test_lifting_undoes_projection(distortion: np.ndarray, u: float, v: float, depth: float) -> None:
    pixels = np.array([[u, v]])
    for convention in ("z", "ray"):
        points, _ = lift(
            camera(distortion), pixels, np.array([depth]), convention=convention, sigma_px=1.0, depth_coefficient=0.01
        )
        np.testing.assert_allclose(camera(distortion).project(points), pixels, atol=1e-8)
        measured = points[0, 2] if convention == "z" else np.linalg.norm(points[0])
        assert measured == pytest.approx(depth, rel=1e-12)


@pytest.mark.parametrize("distortion", [PLUMB_BOB, RATIONAL], ids=["plumb_bob", "rational"])
def test_jacobians_are_the_numerical_ones(distortion: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-0.6, 0.6, (30, 2))
    step = 1e-6
    numerical = [(distort(xy + step * e, distortion)[0] - distort(xy - step * e, distortion)[0]) for e in np.eye(2)]
    np.testing.assert_allclose(distort(xy, distortion)[1], np.stack(numerical, axis=-1) / (2 * step), atol=1e-8)
    pixels = rng.uniform([0, 0], [640, 480], (30, 2))
    c = camera(distortion)
    numerical = [(c.normalise(pixels + 1e-3 * e)[0] - c.normalise(pixels - 1e-3 * e)[0]) / 2e-3 for e in np.eye(2)]
    np.testing.assert_allclose(c.normalise(pixels)[1], np.stack(numerical, axis=-1), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("convention", ["z", "ray"])
@pytest.mark.parametrize("distortion", [np.zeros(8), PLUMB_BOB], ids=["none", "plumb_bob"])
def test_covariance_is_that_of_monte_carlo(convention: str, distortion: np.ndarray) -> None:
    """400,000 draws: a variance has a standard error of 0.22 %, so 1 % is 4.5 of them."""
    rng = np.random.default_rng(2)
    n, sigma_px, coefficient = 400_000, 2.0, 0.02
    for pixel, depth in (((560.0, 90.0), 0.8), ((330.0, 250.0), 1.5)):
        options = {"convention": convention, "sigma_px": sigma_px, "depth_coefficient": coefficient}
        points, covs = lift(camera(distortion), np.array([pixel]), np.array([depth]), **options)
        noisy_pixels = pixel + rng.normal(0, sigma_px, (n, 2))
        noisy_depths = depth + rng.normal(0, coefficient * points[0, 2] ** 2, n)
        drawn, _ = lift(camera(distortion), noisy_pixels, noisy_depths, **options)
        expected = np.cov(drawn.T)
        L = np.linalg.cholesky(covs[0])
        whitened = np.linalg.solve(L, np.linalg.solve(L, expected).T)
        np.testing.assert_allclose(whitened, np.eye(3), atol=0.01)


def test_a_pixel_that_no_ray_reaches_is_nan() -> None:
    strong = np.array([-0.5, 0, 0, 0, 0, 0, 0, 0])  # r (1 - 0.5 r^2) never exceeds 0.544
    c = Camera(100.0, 100.0, 0.0, 0.0, strong)
    xy, _ = c.normalise(np.array([[54.0, 0.0], [60.0, 0.0], [10.0, 0.0]]))
    assert np.isnan(xy).any(axis=1).tolist() == [False, True, False]
    assert xy[0, 0] * (1 - 0.5 * xy[0, 0] ** 2) == pytest.approx(0.54, abs=1e-12)


def test_no_pixels() -> None:
    points, covs = lift(
        camera(RATIONAL), np.zeros((0, 2)), np.zeros(0), convention="z", sigma_px=1.0, depth_coefficient=0.01
    )
    assert (points.shape, covs.shape) == ((0, 3), (0, 3, 3))
