"""Lifting of boxes: the unscented transform against Monte Carlo, petals against what is before and behind them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cluster_slam.errors import ConfigError
from cluster_slam.lift import lift, lift_boxes, lift_unscented
from cluster_slam.lift.petals import petal_depth
from cluster_slam.records import ImageDetections
from cluster_slam.sensors.camera import Camera
from cluster_slam.sensors.depth import DEPTH_CAMERAS, SUBPIXEL, DepthModel, depth_model

RATIONAL = np.array([0.62, -1.1, 0.0006, -0.0002, 0.4, 0.5, -0.98, 0.35])
EXACT = DepthModel("exact", 1e-5, 4.0, 1e-6, 0.05, 10.0, 0.0, 0.0)


def camera(distortion: NDArray | None = None) -> Camera:
    return Camera(430.0, 430.0, 423.5, 239.5, np.zeros(8) if distortion is None else distortion, 848, 480)


@pytest.mark.parametrize("convention", ["z", "ray"])
@pytest.mark.parametrize("distortion", [np.zeros(8), RATIONAL], ids=["none", "rational"])
def test_the_unscented_covariance_is_that_of_monte_carlo(convention: str, distortion: NDArray) -> None:
    """Six errors at once, on a tilted surface; 200,000 draws: a variance has a standard error of 0.3 %."""
    rng = np.random.default_rng(3)
    n, pixel, depth = 200_000, np.array([640.0, 120.0]), 0.6
    sigma_px, sigma_depth, focal_sigma, centre_sigma = 1.5, 0.004, 0.004, 0.8
    slope = np.array([0.002, -0.001])
    points, covs = lift_unscented(
        camera(distortion), pixel[None], np.array([depth]), convention=convention, sigma_px=np.array([sigma_px]),
        sigma_depth=np.array([sigma_depth]), slopes=slope[None], focal_sigma=focal_sigma, centre_sigma_px=centre_sigma,
    )  # fmt: skip
    error = rng.normal(0, sigma_px, (n, 2))
    pixels, depths = pixel + error, depth + rng.normal(0, sigma_depth, n) + error @ slope
    principal = np.array([423.5, 239.5])
    seen = (pixels - principal - rng.normal(0, centre_sigma, (n, 2))) / (1 + rng.normal(0, focal_sigma, (n, 1)))
    drawn, _ = lift(
        camera(distortion), seen + principal, depths, convention=convention, sigma_px=1.0, depth_coefficient=1.0
    )
    L = np.linalg.cholesky(covs[0])
    whitened = np.linalg.solve(L, np.linalg.solve(L, np.cov(drawn.T)).T)
    np.testing.assert_allclose(whitened, np.eye(3), atol=0.015)
    np.testing.assert_allclose(points[0], drawn.mean(0), atol=5 * np.sqrt(covs[0].trace() / n))


def test_what_it_costs_to_mix_up_z_and_ray() -> None:
    """At 45 degrees a depth z of 0.5 m is a range of 0.707 m: taken for one another they are 0.207 m apart."""
    pixel = np.array([[423.5 + 430.0, 239.5]])
    as_z, _ = lift(camera(), pixel, np.array([0.5]), convention="z", sigma_px=1.0, depth_coefficient=0.01)
    as_ray, _ = lift(camera(), pixel, np.array([0.5]), convention="ray", sigma_px=1.0, depth_coefficient=0.01)
    np.testing.assert_allclose(as_z, [[0.5, 0.0, 0.5]], atol=1e-12)
    assert np.linalg.norm(as_z - as_ray) == pytest.approx(0.5 * (np.sqrt(2) - 1), rel=1e-12)


def test_depth_noise_is_that_of_disparity() -> None:
    """sigma_z = z^2 sigma_d / (f b): 0.5^2 * 0.08 / (430 * 0.018) = 2.58 mm for a D405, 0.93 mm for a D435."""
    for name, expected in (("d405", 0.25 * SUBPIXEL / (430 * 0.018)), ("d435", 0.25 * SUBPIXEL / (430 * 0.050))):
        model = depth_model(name, focal_px=430.0)
        step = model.unit_m / np.sqrt(12)
        assert model.sigma(np.array([0.5]))[0] == pytest.approx(np.hypot(expected, step), rel=1e-9)
        assert model.disparity_m_px == pytest.approx(430 * (0.018 if name == "d405" else 0.05))
    assert depth_model("generic", focal_px=500.0, coefficient=0.01).coefficient == 0.01
    with pytest.raises(ConfigError, match="unknown depth camera 'd999'"):
        depth_model("d999", focal_px=430.0)


def test_a_mean_over_a_patch_that_errs_alike() -> None:
    """Noise smoothed to the model's correlation; its means over discs, against the formula."""
    model, rng = depth_model("generic", focal_px=430.0), np.random.default_rng(5)
    f = np.fft.fftfreq(256)
    shape = np.exp(-2 * (np.pi * model.correlation_px) ** 2 * (f[:, None] ** 2 + f[None] ** 2))
    v, u = np.mgrid[:256, :256] - 128
    for radius in (6, 12):
        disc = u**2 + v**2 <= radius**2
        means, spread = [], []
        for _ in range(60):
            field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(256, 256))) * shape).real
            spread.append(field.std())
            for shift in range(0, 256, 64):
                means.append(np.roll(field, (shift, 128 - shift), (0, 1))[disc].mean())
        measured = np.std(means) / np.mean(spread)
        formula = model.mean_sigma(np.array([1.0]), np.array([float(disc.sum())]))[0] / model.sigma(np.array([1.0]))[0]
        assert measured == pytest.approx(formula, rel=0.2)


def scene(petal_m: float = 0.40, behind_m: float = 0.55) -> NDArray:
    """A disc of radius 9 px about (60, 50) before a wall."""
    v, u = np.mgrid[:100, :120]
    return np.where((u - 60) ** 2 + (v - 50) ** 2 <= 81, petal_m, behind_m)


BOX = (np.array([60.0, 50.0]), np.array([18.0, 18.0]))


def test_petals_before_a_wall() -> None:
    found = petal_depth(scene(), *BOX, 430.0, EXACT)
    assert found.depth == pytest.approx(0.40, abs=1e-6)


def test_petals_with_gaps_that_show_the_wall() -> None:
    depth = scene()
    v, u = np.mgrid[:100, :120]
    depth[(np.arctan2(v - 50, u - 60) % 1.2566) < 0.4] = 0.55
    assert petal_depth(depth, *BOX, 430.0, EXACT).depth == pytest.approx(0.40, abs=1e-4)


def test_a_tilted_flower_half_without_depth() -> None:
    """The plane says the depth of the middle, where a mean of what is left would be off by 2 mm."""
    u = np.arange(120) + np.zeros((100, 1))
    depth = np.where(scene() < 0.5, 0.40 + 0.0005 * (u - 60), 0.55)
    depth[:, :60] = np.where(scene()[:, :60] < 0.5, 0.0, 0.55)
    found = petal_depth(depth, *BOX, 430.0, EXACT)
    assert found.depth == pytest.approx(0.40, abs=2e-4)
    assert found.slope_u == pytest.approx(0.0005, rel=0.1)


def test_a_twig_in_front_is_not_the_flower() -> None:
    depth = scene()
    depth[47:52, :] = 0.30
    found = petal_depth(depth, *BOX, 430.0, EXACT)
    assert np.isnan(found.depth) or found.depth == pytest.approx(0.40, abs=1e-3)


def test_a_flower_on_a_wall_has_its_depth_and_a_leaf_that_covers_all_has_none() -> None:
    """Depths alone cannot tell them apart; colours can."""
    flat, image = np.full((100, 120), 0.3), np.full((100, 120, 3), (20, 90, 30), np.uint8)
    assert np.isnan(petal_depth(flat, *BOX, 430.0, EXACT, image).depth)
    image[scene() < 0.5] = 240
    assert petal_depth(flat, *BOX, 430.0, EXACT, image).depth == pytest.approx(0.3, abs=1e-6)


def test_no_depth_and_outside() -> None:
    assert np.isnan(petal_depth(np.zeros((100, 120)), *BOX, 430.0, EXACT).depth)
    assert np.isnan(petal_depth(scene(), np.array([500.0, 50.0]), BOX[1], 430.0, EXACT).depth)


def _principal(model: DepthModel, rng: np.random.Generator) -> tuple[float, float]:
    u, v = np.array([423.5, 239.5]) + model.centre_sigma_px * rng.normal(size=2)
    return float(u), float(v)


def test_lifted_errors_are_as_large_as_stated() -> None:
    """Discs of all tilts at 0.4 m, depth noise as modelled, pixel noise 1: ANEES / 3 of 400 within 0.8 and 1.25."""
    model, rng = depth_model("generic", focal_px=430.0), np.random.default_rng(8)
    f = np.fft.fftfreq(128)
    shape = np.exp(-2 * (np.pi * model.correlation_px) ** 2 * (f[:, None] ** 2 + f[None] ** 2))
    v, u = np.mgrid[:128, :128]
    nees = []
    for _ in range(400):
        noise = np.fft.ifft2(np.fft.fft2(rng.normal(size=(128, 128))) * shape).real
        tilt = 0.4 / 430.0 * rng.normal(0, 0.5, 2)
        middle = np.array([64.0, 64.0]) + rng.uniform(-0.5, 0.5, 2)
        relief = rng.normal(0, 0.0006)  # petals are no planes: their middle lies before or behind
        z = np.where(
            (u - middle[0]) ** 2 + (v - middle[1]) ** 2 <= 110,
            0.40 + relief + (u - middle[0]) * tilt[0] + (v - middle[1]) * tilt[1],
            0.6,
        )
        z = z + model.coefficient * z**2 * noise / noise.std()
        camera_now = Camera(430.0 * (1 + model.focal_sigma * rng.normal()), 430.0, *_principal(model, rng), np.zeros(8))
        box = ImageDetections((middle + rng.normal(0, 1.0, 2))[None], np.full((1, 2), 21.0), np.ones(1))
        lifted = lift_boxes(camera_now, box, z, convention="z", model=model, sigma_px=np.ones(1))
        truth = np.array([(middle[0] - 423.5) / 430.0, (middle[1] - 239.5) / 430.0, 1.0]) * 0.40
        e = lifted.points[0] - truth
        nees.append(e @ np.linalg.solve(lifted.covs[0], e))
    assert 0.8 < np.mean(nees) / 3 < 1.25


def test_flowers_at_a_wrong_depth_are_too_large_for_the_others() -> None:
    depth = np.full((480, 848), 0.8)
    centres = np.array([[100.0 + 100 * k, 200.0] for k in range(7)])
    v, u = np.mgrid[:480, :848]
    for k, (x, y) in enumerate(centres):
        depth[(u - x) ** 2 + (v - y) ** 2 <= 100] = 0.15 if k == 3 else 0.4
    boxes = ImageDetections(centres, np.full((7, 2), 20.0), np.ones(7))
    lifted = lift_boxes(camera(), boxes, depth, convention="z", model=EXACT, sigma_px=np.ones(7))
    assert lifted.is_lifted.tolist() == [True, True, True, False, True, True, True]


def test_a_middle_that_leans_comes_back_along_the_petals_plane() -> None:
    """A flower tilted by 0.5 along u, whose box lies a tenth of its width times that to the side that it faces."""
    lean, tangent, width, middle, z = 0.1, 0.5, 20.0, np.array([300.0, 200.0]), 0.4
    v, u = np.mgrid[:480, :848]
    slope = tangent * z / 430.0
    depth = np.where((u - middle[0]) ** 2 + (v - middle[1]) ** 2 <= 90, z + slope * (u - middle[0]), 0.9)
    leant = middle + np.array([lean * tangent * width, 0.0])
    boxes = ImageDetections(leant[None], np.full((1, 2), width), np.ones(1))
    lifted = lift_boxes(camera(), boxes, depth, convention="z", model=EXACT, sigma_px=np.ones(1), lean=lean)
    np.testing.assert_allclose(lifted.centres[0], middle, atol=0.03)  # the tilt's own prior takes a little of it
    np.testing.assert_allclose(lifted.depths, z, atol=1e-4)
    np.testing.assert_allclose(camera().project(lifted.points)[0], middle, atol=0.05)
    plain = lift_boxes(camera(), boxes, depth, convention="z", model=EXACT, sigma_px=np.ones(1))
    np.testing.assert_array_equal(plain.centres, boxes.centres)
    assert lifted.sigma_px[0] >= plain.sigma_px[0] == 1.0


def test_no_boxes() -> None:
    none = ImageDetections(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    lifted = lift_boxes(camera(), none, scene(), convention="z", model=EXACT, sigma_px=np.empty(0))
    assert lifted.points.shape == (0, 3)


def test_every_camera_has_a_model() -> None:
    for name in DEPTH_CAMERAS:
        assert depth_model(name, focal_px=430.0).near_m < 0.2


def test_a_flower_that_is_mostly_hidden_has_no_depth() -> None:
    """Half of it behind a leaf that ends in its box: which of the two depths is the flower's is a guess."""
    whole, hidden = scene(), scene()
    hidden[:, 58:] = 0.30
    v, u = np.mgrid[:100, :120]
    petals = np.where((u - 60) ** 2 + (v - 50) ** 2 <= 81, 200, 60).astype(np.uint8)
    image = np.repeat(petals[..., None], 3, axis=2)
    hidden_image = image.copy()
    hidden_image[:, 58:] = (30, 120, 30)
    boxes = ImageDetections(BOX[0][None], BOX[1][None], np.ones(1))
    camera = Camera(430.0, 430.0, 60.0, 50.0, np.zeros(8), 120, 100)
    for depth, picture, is_lifted in ((whole, image, True), (hidden, hidden_image, False)):
        found = lift_boxes(
            camera, boxes, depth, convention="z", model=EXACT, sigma_px=np.ones(1), image=picture
        )  # fmt: skip
        assert found.is_lifted[0] == is_lifted


def test_wide_boxes_are_no_hidden_flowers() -> None:
    """Where a detector's boxes are all half as wide again as the flowers, nothing is refused for it."""
    v, u = np.mgrid[:100, :420]
    middles = np.column_stack([np.arange(40, 400, 60), np.full(6, 50)]).astype(float)
    is_petal = ((u[..., None] - middles[:, 0]) ** 2 + (v[..., None] - middles[:, 1]) ** 2 <= 81).any(-1)
    depth = np.where(is_petal, 0.40, 0.70)
    image = np.repeat(np.where(is_petal, 200, 60).astype(np.uint8)[..., None], 3, axis=2)
    boxes = ImageDetections(middles, np.full((6, 2), 27.0), np.ones(6))
    camera = Camera(430.0, 430.0, 210.0, 50.0, np.zeros(8), 420, 100)
    found = lift_boxes(camera, boxes, depth, convention="z", model=EXACT, sigma_px=np.ones(6), image=image)
    assert found.is_lifted.all()
    np.testing.assert_allclose(found.depths, 0.40, atol=1e-3)


def test_a_flower_behind_another_is_not_at_its_depth() -> None:
    """Three quarters of its box are the other's petals; what is left of its own says its depth, or there is none."""
    v, u = np.mgrid[:100, :120]
    depth = np.full((100, 120), 0.70)
    depth[(u - 70) ** 2 + 4 * (v - 50) ** 2 <= 36] = 0.45
    depth[(u - 60) ** 2 + (v - 50) ** 2 <= 169] = 0.40
    boxes = ImageDetections(np.array([[60.0, 50.0], [70.0, 50.0]]), np.array([[26.0, 26.0], [12.0, 6.0]]), np.ones(2))
    camera = Camera(430.0, 430.0, 60.0, 50.0, np.zeros(8), 120, 100)
    found = lift_boxes(camera, boxes, depth, convention="z", model=EXACT, sigma_px=np.ones(2))
    assert found.depths[0] == pytest.approx(0.40, abs=1e-3)
    assert np.isnan(found.depths[1]) or found.depths[1] == pytest.approx(0.45, abs=1e-3)


def test_flowers_side_by_side_both_have_their_depth() -> None:
    """Their boxes overlap by a quarter; each keeps enough of its own."""
    v, u = np.mgrid[:100, :120]
    middles = np.array([[50.0, 50.0], [64.0, 50.0]])
    depth = np.where(((u[..., None] - middles[:, 0]) ** 2 + (v[..., None] - 50) ** 2 <= 64).any(-1), 0.40, 0.70)
    camera = Camera(430.0, 430.0, 60.0, 50.0, np.zeros(8), 120, 100)
    boxes = ImageDetections(middles, np.full((2, 2), 17.0), np.ones(2))
    found = lift_boxes(camera, boxes, depth, convention="z", model=EXACT, sigma_px=np.ones(2))
    assert found.is_lifted.all()
    np.testing.assert_allclose(found.depths, 0.40, atol=1e-3)
