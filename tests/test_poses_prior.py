"""What odometry tells of poses and of the hand-eye transform, against its definition."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.association.frames import Frames
from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, se3_log, transform
from cluster_slam.graph.batch import BatchSmoother, Estimate, Pairs
from cluster_slam.graph.poses import PoseModel, pose_prior

N = 5
_FIRST = 1e-6  # sigma of the first pose: next to exact
_SIGMA = np.array([2e-3, 3e-3, 1e-3, 1e-3, 2e-3, 4e-3])
_HAND_EYE = np.diag(np.repeat([0.01, 0.005], 3) ** 2)


def _model(*, flange: bool, size: float, n: int = N) -> tuple[PoseModel, Array, Array]:
    """A drive with errors of ``size``, the camera's poses T (n, 4, 4), and the hand-eye transform (4, 4)."""
    rng = np.random.default_rng(3)
    X = se3_exp(np.array([0.3, -0.2, 0.1, 0.05, 0.02, -0.1])) if flange else np.eye(4)
    given = [se3_exp(rng.normal(0, 0.5, 6))]
    for _ in range(n - 1):
        given.append(given[-1] @ se3_exp(rng.normal(0, 0.1, 6)))
    T = np.array(given) @ X @ se3_exp(size * rng.normal(0, 1, (n, 6)))
    T[0] = given[0] @ X @ se3_exp(1e-3 * size * rng.normal(0, 1, 6))
    X0 = X @ se3_exp(size * rng.normal(0, 1, 6)) if flange else None
    step = np.tile(np.diag(_SIGMA**2), (n - 1, 1, 1)) * rng.uniform(0.5, 2.0, (n - 1, 1, 1))
    return PoseModel(np.array(given), np.eye(6), step, X0, _HAND_EYE), T, X


def _residuals(model: PoseModel, T: Array, X: Array | None) -> Array:
    """Errors of the first pose, of the steps and of the hand-eye transform, each over its sigma."""
    by_flange = T @ inverse(X) if X is not None else T
    first = se3_log(inverse(model.given[0]) @ by_flange[0])
    first = first if X is None else adjoint(inverse(X)) @ first  # as the camera has it
    told, now = (inverse(P[:-1]) @ P[1:] for P in (model.given, by_flange))
    assert model.cov_step is not None
    sigma = np.sqrt(np.diagonal(model.cov_step, axis1=1, axis2=2))
    r = [first / _FIRST, (se3_log(inverse(told) @ now) / sigma).ravel()]
    if X is not None and model.X0 is not None:
        r.append(se3_log(inverse(model.X0) @ X) / np.sqrt(np.diag(_HAND_EYE)))
    return np.concatenate(r)


@pytest.mark.parametrize("flange", [False, True])
def test_odometry_is_the_least_squares_of_its_steps(flange: bool) -> None:
    """The steps err at the flange: the camera's poses and the hand-eye transform move them together."""
    model, T, X = _model(flange=flange, size=1e-5)
    k = 6 if flange else 0
    prior = pose_prior(model, adjoint(inverse(X)), T, X if flange else None)

    def at(change: Array) -> Array:
        moved = T @ se3_exp(change[: 6 * N].reshape(N, 6))
        return _residuals(model, moved, X @ se3_exp(change[6 * N :]) if flange else None)

    eye = 1e-6 * np.eye(6 * N + k)
    J = np.array([(at(h) - at(-h)) / 2e-6 for h in eye]).T
    H = np.zeros((6 * N + k, 6 * N + k))
    for i in range(N):
        here = slice(6 * i, 6 * i + 6)
        H[here, here], H[here, 6 * N :] = prior.z_information[i], prior.zx_information[i]
        H[6 * N :, here] = prior.zx_information[i].T
    assert prior.chain is not None
    for i, C in enumerate(prior.chain):
        H[6 * i : 6 * i + 6, 6 * i + 6 : 6 * i + 12] = C
        H[6 * i + 6 : 6 * i + 12, 6 * i : 6 * i + 6] = C.T
    H[6 * N :, 6 * N :] = prior.x_information
    less_x = np.eye(6 * N + k)  # y = z - x
    less_x[: 6 * N, 6 * N :] = -np.tile(np.eye(6), (N, 1))[:, :k]
    H = less_x.T @ H @ less_x
    scale = np.sqrt(np.diag(H))
    np.testing.assert_allclose(H / scale / scale[:, None], J.T @ J / scale / scale[:, None], atol=1e-4)
    vector = less_x.T @ np.concatenate([prior.z_vector.ravel(), prior.x_vector])
    np.testing.assert_allclose(vector / scale, -J.T @ at(0 * eye[0]) / scale, atol=1e-3 * np.abs(at(0 * eye[0])).max())


def _seen_from(model: PoseModel, T: Array, X: Array, n_places: int = 6) -> tuple[BatchSmoother, Estimate]:
    """All places seen from all poses without error."""
    n = len(T)
    places = transform(T[0], np.random.default_rng(5).uniform(-0.2, 0.2, (n_places, 3)) + np.array([0, 0, 0.6]))
    frame, label = np.repeat(np.arange(n), n_places), np.tile(np.arange(n_places), n)
    frames = Frames(
        np.arange(len(frame)),
        np.arange(n + 1) * n_places,
        frame,
        transform(inverse(T)[frame], places[label]),
        np.tile(1e-8 * np.eye(3), (len(frame), 1, 1)),
        np.arange(n) / 30,
    )
    pairs = Pairs(
        of=frame,
        frame=np.arange(n),
        cluster=np.zeros(n, dtype=np.int64),
        sigma=np.full(n, 1e-5),
        stretch=np.full(n, -1),
        stretch_sigma=np.empty(0),
    )
    smoother = BatchSmoother(frames, model, label, pairs)
    return smoother, Estimate(T, X, places, np.zeros((n, 3)), np.ones(len(frame)), np.zeros(len(frame)))


def test_an_unknown_hand_eye_transform_moves_all_places() -> None:
    """The flange's first pose is exact, the camera's is as uncertain as its mounting, and so is what it sees."""
    model, T, X = _model(flange=True, size=0.0, n=2)
    smoother, e = _seen_from(model, T, X)
    told = smoother.marginals(e)
    assert told.hand_eye is not None
    R, points = T[0, :3, :3], smoother.c[:6]
    for j, (x, y, z) in enumerate(points):
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        J = R @ np.concatenate([-across, np.eye(3)], axis=1)
        block = told.places[3 * j : 3 * j + 3, 3 * j : 3 * j + 3]
        np.testing.assert_allclose(block, J @ told.hand_eye @ J.T, rtol=0.01, atol=1e-7)
    assert told.hand_eye[0, 0] > 0.2 * _HAND_EYE[0, 0]  # one step tells little


def test_a_vehicle_that_stays_in_a_plane_is_solved() -> None:
    """Its steps are known next to exactly out of the plane, whatever the mounting of the camera."""
    n = 300
    _, _, X = _model(flange=True, size=0.0)
    steps = np.zeros((n - 1, 6))
    steps[:, [2, 3, 4]] = np.random.default_rng(7).normal(0, 0.02, (n - 1, 3))
    given = [np.eye(4)]
    for D in se3_exp(steps):
        given.append(given[-1] @ D)
    cov = np.tile(np.diag([1e-14, 1e-14, 1e-6, 1e-6, 1e-6, 1e-14]), (n - 1, 1, 1))
    model = PoseModel(np.array(given), np.eye(6), cov, X, _HAND_EYE)
    smoother, e = _seen_from(model, np.array(given) @ X, X)
    moved, change = smoother.step(e)
    assert change < 1e-8
    assert moved.X is not None
    np.testing.assert_allclose(moved.X, X, atol=1e-8)
    told = smoother.marginals(moved)
    assert told.hand_eye is not None
    size = np.linalg.eigvalsh(told.hand_eye / np.sqrt(np.outer(np.diag(_HAND_EYE), np.diag(_HAND_EYE))))
    assert 0.0 < size[0] < 0.1  # learned ...
    assert size[-1] == pytest.approx(1.0, abs=0.01)  # ... but for the height over the plane
