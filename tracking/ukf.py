"""The unscented Kalman filter: filterpy's, kept from ever working on a covariance that is none.

The only import of filterpy. Sigma points go through a process or measurement function as one stack, and are drawn anew
before every update, so that two updates without a prediction between them are as right as one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from tracking.errors import CovarianceError, ParameterError
from tracking.gaussian import Array, ensure_positive_definite, symmetrise

_FLOOR = 1e-12  # least eigenvalue of a repaired covariance over its largest
Function = Callable[[Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Measured minus predicted (d,), its covariance (d, d), and its squared Mahalanobis length."""

    value: Array
    cov: Array
    nis: float


def safe_root(cov: Array) -> Array:
    """Upper factor (n, n) with U' U = C, of the nearest positive definite matrix where rounding has spoiled C.

    Raises
    ------
    CovarianceError
        C is not finite.
    """
    if not np.isfinite(cov).all():
        raise CovarianceError("state covariance: not finite")
    try:
        return np.asarray(np.linalg.cholesky(cov).T, np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.cholesky(repaired(cov)).T, np.float64)


def repaired(cov: Array) -> Array:
    """The symmetric matrix (n, n) with eigenvalues of at least ``_FLOOR`` times the largest, in units of each state."""
    scale = np.sqrt(np.maximum(np.diag(cov), 1e-300))
    values, axes = np.linalg.eigh(symmetrise(cov / scale[:, None] / scale))
    lifted = (axes * np.maximum(values, _FLOOR * max(float(values[-1]), 1.0))) @ axes.T
    return symmetrise(lifted * scale[:, None] * scale)


@lru_cache(maxsize=1)
def _filter_class() -> type[Any]:
    """filterpy's filter with stacked sigma points; imported when first needed (it takes a second)."""
    from filterpy.kalman import UnscentedKalmanFilter

    class Stacked(UnscentedKalmanFilter):  # type: ignore[misc]
        """The same filter: what it calls once a sigma point is called once for all."""

        def compute_process_sigmas(self, dt: float, fx: Function | None = None, **_: Any) -> None:
            function = self.fx if fx is None else fx
            self.sigmas_f = function(self.points_fn.sigma_points(self.x, self.P))

        def cross_variance(self, x: Array, z: Array, sigmas_f: Array, sigmas_h: Array) -> Array:
            return np.asarray((sigmas_f - x).T @ (self.Wc[:, None] * (sigmas_h - z)))

    return Stacked


@lru_cache(maxsize=8)
def _sigma_points(n: int, alpha: float) -> Any:
    from filterpy.kalman import MerweScaledSigmaPoints

    class Drawn(MerweScaledSigmaPoints):  # type: ignore[misc]
        """The same points, drawn at once."""

        def sigma_points(self, x: Array, P: Array) -> Array:
            spread = self.alpha**2 * (self.n + self.kappa)
            U = safe_root(spread * P)
            return np.concatenate([x[None], x + U, x - U])

    return Drawn(n, alpha, 2.0, 0.0)


def _moments(points: Array, Wm: Array, Wc: Array, noise_cov: Array, *_: Any) -> tuple[Array, Array]:
    """Mean and covariance of weighted sigma points (s, n), as filterpy's ``unscented_transform``, symmetric."""
    mean = Wm @ points
    delta = points - mean
    return mean, symmetrise(delta.T @ (Wc[:, None] * delta) + noise_cov)


def prepare() -> None:
    """Import filterpy now, so that the first filter is not late."""
    _filter_class()


class UnscentedFilter:
    """One Gaussian state, predicted and updated through functions of stacks of states.

    Parameters
    ----------
    x, P
        Mean (n,) and covariance (n, n).
    alpha
        Spread of the sigma points, in (0, 1].

    Raises
    ------
    CovarianceError
        ``P`` is not finite, symmetric and positive definite.
    """

    def __init__(self, x: Array, P: Array, *, alpha: float = 0.5) -> None:
        n = len(x)
        self._alpha = alpha
        self._ukf = _filter_class()(n, 1, 1.0, None, None, _sigma_points(n, alpha))
        self.reset(x, P)

    def __reduce__(self) -> tuple[Any, ...]:
        """Written down as mean, covariance and spread."""
        return _again, (self.x, self.P, self._alpha)

    @property
    def x(self) -> Array:
        """Mean (n,)."""
        return np.asarray(self._ukf.x)

    @property
    def P(self) -> Array:
        """Covariance (n, n), positive definite."""
        return np.asarray(self._ukf.P)

    def reset(self, x: Array, P: Array) -> None:
        """Forget, and be in this state."""
        if not np.isfinite(x).all():
            raise ParameterError("state: not finite")
        self._ukf.x, self._ukf.P = np.array(x, float), ensure_positive_definite(P, "state covariance")
        self._are_drawn = False  # sigma points of this very state

    def predict(self, process: Function, Q: Array) -> None:
        """Move all by ``process`` ((s, n) -> (s, n)) and add noise Q (n, n)."""
        self._ukf.Q = Q
        self._ukf.predict(UT=_moments, fx=process)
        self._are_drawn = True

    def innovation(self, z: Array, R: Array, measure: Function) -> Innovation:
        """What an update with this measurement would see; nothing is changed."""
        ukf = self._ukf
        zp, S = _moments(measure(ukf.points_fn.sigma_points(ukf.x, ukf.P)), ukf.Wm, ukf.Wc, R)
        return _innovation(z - zp, S)

    def update(self, z: Array, R: Array, measure: Function) -> Innovation:
        """Take in a measurement z (d,) of covariance R (d, d), predicted by ``measure`` ((s, n) -> (s, d)).

        Raises
        ------
        CovarianceError
            R, or the innovation's covariance, is not positive definite: the state is as before.
        ParameterError
            z is not finite: the state is as before.
        """
        if not np.isfinite(z).all():
            raise ParameterError("measurement: not finite")
        R = ensure_positive_definite(R, "measurement covariance")
        ukf = self._ukf
        before = ukf.x, ukf.P
        if not self._are_drawn:
            ukf.sigmas_f = ukf.points_fn.sigma_points(ukf.x, ukf.P)
        self._are_drawn = False
        predicted = measure(ukf.sigmas_f)
        rows = iter(predicted)
        ukf._dim_z = len(z)
        ukf.update(z, R=R, UT=_moments, hx=lambda _: next(rows))
        P = symmetrise(ukf.P)
        try:
            np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            P = repaired(P) if np.isfinite(P).all() else P
        if not (np.isfinite(P).all() and np.isfinite(ukf.x).all()):
            ukf.x, ukf.P = before
            raise CovarianceError("the update gave a covariance that is not finite; it was not made")
        ukf.P = P
        return _innovation(ukf.y, ukf.S)


def _again(x: Array, P: Array, alpha: float) -> UnscentedFilter:
    return UnscentedFilter(x, P, alpha=alpha)


def _innovation(value: Array, S: Array) -> Innovation:
    return Innovation(value, S, float(value @ np.linalg.solve(S, value)))
