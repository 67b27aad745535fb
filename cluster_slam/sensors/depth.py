"""How depth cameras err: stereo with subpixel disparity.

A disparity d = f b / z that is measured to sigma_d pixels gives sigma_z = z^2 sigma_d / (f b). Matching compares
windows, so that neighbouring pixels err alike and averaging over a petal helps little: errors are correlated over
``correlation_px``, as exp(-r^2 / (4 correlation_px^2)).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.errors import ConfigError
from cluster_slam.geometry import Array

SUBPIXEL = 0.08  # sigma of a disparity on textured things, pixels: what active stereo reaches


@dataclass(frozen=True, slots=True)
class DepthModel:
    """A depth camera at one image size."""

    name: str
    coefficient: float  # sigma of a pixel's depth at one metre, 1/m: sigma = coefficient z^2
    correlation_px: float  # over which errors are alike
    unit_m: float  # step of the numbers that it gives
    near_m: float  # nothing nearer is measured ...
    far_m: float  # ... and nothing farther is trusted
    focal_sigma: float = 0.001  # sigma of the focal length, relative, after the factory's calibration
    centre_sigma_px: float = 0.3  # sigma of the principal point

    @property
    def disparity_m_px(self) -> float:
        """Focal length times baseline, m px: a depth z has the disparity this / z."""
        return SUBPIXEL / self.coefficient

    def sigma(self, z: Array) -> Array:
        """Sigma (n,) of single pixels' depths (n,), m: noise and step."""
        sigma: Array = np.sqrt((self.coefficient * z**2) ** 2 + self.unit_m**2 / 12.0)
        return sigma

    def mean_sigma(self, z: Array, n_pixels: Array) -> Array:
        """Sigma (n,) of the mean over a patch of n pixels (n,), which err alike.

        The variance of a mean over an area A is that of a pixel over 1 + A / (4 pi correlation_px^2), to a few
        percent for compact patches.
        """
        independent = 1.0 + n_pixels / (4.0 * np.pi * self.correlation_px**2)
        sigma: Array = np.sqrt((self.coefficient * z**2) ** 2 / independent + self.unit_m**2 / 12.0 / n_pixels)
        return sigma


_GENERIC = DepthModel("generic", 0.006, 4.0, 0.001, 0.10, 3.0)
_BASELINES = {"d405": 0.018, "d435": 0.050}  # m
_UNITS = {"d405": 0.0001, "d435": 0.001}  # m
_NEAR = {"d405": 0.07, "d435": 0.175}  # m, at 848 x 480


def depth_model(name: str, *, focal_px: float, coefficient: float | None = None) -> DepthModel:
    """The model of a camera by its name: generic, d405 or d435.

    Parameters
    ----------
    focal_px
        Of the depth image, pixels.
    coefficient
        What a session states in place of the camera's own, 1/m.

    Raises
    ------
    ConfigError
        The name is unknown.
    """
    if name == "generic":
        return _GENERIC if coefficient is None else replace(_GENERIC, coefficient=coefficient)
    if name not in _BASELINES:
        raise ConfigError(f"unknown depth camera {name!r} (known: {', '.join(DEPTH_CAMERAS)})")
    own = SUBPIXEL / (focal_px * _BASELINES[name])
    far = 1.5 if name == "d405" else 6.0
    return DepthModel(name, own if coefficient is None else coefficient, 4.0, _UNITS[name], _NEAR[name], far)


DEPTH_CAMERAS = ("generic", *_BASELINES)
