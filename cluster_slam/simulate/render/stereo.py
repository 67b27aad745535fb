"""The depth camera: what stereo matching makes of true depths.

Noise in disparity that neighbours share, edges that bleed and fray, holes where only one eye sees, holes where there
is nothing to match, a near and a far limit, whole steps of the unit.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cluster_slam.sensors.depth import SUBPIXEL, DepthModel
from cluster_slam.simulate.render.raster import Float32

_FIELD = 1024  # side of the pooled fields, px
_FRAY_PX = 1.6  # sigma of how far an edge is displaced
_EDGE = 0.02  # relative step in depth that is an edge
_FLYING = 0.35  # share of an edge's pixels that get a depth between
_SPECKLE = 0.004  # share of pixels in holes of their own, for ``holes = 1``
_STEPS = 32.0  # of a disparity of one pixel


def measure(
    z: Float32, model: DepthModel, picture: NDArray[np.uint8], holes: float, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """The depth image (h, w), in units of the model, 0 where there is none.

    Parameters
    ----------
    z
        True depths, m, inf where there is nothing.
    picture
        (h, w, 3): where it is saturated nothing can be matched.
    """
    true = np.where(np.isfinite(z), z, 1e3).astype(np.float32)
    seen = _frayed(true, model, rng)
    disparity = np.float32(model.disparity_m_px) / seen
    hidden = _one_eye_only(disparity)
    fields = _fields(model.correlation_px)
    disparity = disparity + np.float32(SUBPIXEL) * _piece(fields[0], z.shape, rng)
    disparity = np.rint(disparity * np.float32(_STEPS)) * np.float32(1 / _STEPS)
    with np.errstate(divide="ignore"):
        depth = np.float32(model.disparity_m_px) / np.maximum(disparity, np.float32(1e-6))
    lost = hidden | (depth < model.near_m) | (depth > model.far_m) | (true > model.far_m)
    lost |= _piece(fields[1], z.shape, rng) > np.float32(_rare(_SPECKLE * holes))
    if holes > 0:
        lost |= (picture.min(axis=2) > 250) & (_piece(fields[1], z.shape, rng) > np.float32(-0.3))
    units = np.rint(depth / np.float32(model.unit_m))
    lost |= units > 65535
    return np.where(lost, 0, units).astype(np.uint16)


def _rare(share: float) -> float:
    """What a standard normal number exceeds with this probability; never for 0."""
    from scipy.special import ndtri

    return float(-ndtri(share)) if share > 0 else np.inf


def _frayed(z: Float32, model: DepthModel, rng: np.random.Generator) -> Float32:
    """Depths with edges that stand out by a pixel or two, wander, and have flying pixels."""
    import cv2

    fat = cv2.erode(z, np.ones((3, 3), np.uint8))  # matching windows favour what is in front
    wander = _fields(2.5)
    height, width = z.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    u += np.float32(_FRAY_PX) * _piece(wander[0], z.shape, rng)
    v += np.float32(_FRAY_PX) * _piece(wander[1], z.shape, rng)
    moved = cv2.remap(fat, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    low = cv2.erode(moved, np.ones((3, 3), np.uint8))
    high = cv2.dilate(moved, np.ones((3, 3), np.uint8))
    edge = high > low * np.float32(1 + _EDGE)
    flying = edge & (_piece(_fields(1.0)[0], z.shape, rng) > np.float32(_rare(_FLYING)))
    share = np.float32(0.5) + np.float32(0.5) * np.tanh(_piece(wander[1], z.shape, rng))
    between = 1.0 / (share / low + (1 - share) / high)
    near = z < np.float32(1e2)
    smooth: Float32 = np.where(flying, between, np.where(edge | ~near, moved, z)).astype(np.float32)
    return smooth


def _one_eye_only(disparity: Float32) -> NDArray[np.bool_]:
    """Pixels that the right eye does not see: something nearer, to their right, hides them; and the left margin."""
    place = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    nearest = np.minimum.accumulate(place[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(disparity.shape, bool)
    hidden[:, :-1] = nearest[:, 1:] < place[:, :-1] - 0.5
    hidden |= place < 0
    return hidden


@lru_cache(maxsize=8)
def _fields(correlation_px: float) -> tuple[Float32, Float32]:
    """Two smooth standard normal fields that continue over their borders."""
    f = np.fft.fftfreq(_FIELD)
    shape = np.exp(-2 * (np.pi * correlation_px) ** 2 * (f[:, None] ** 2 + f[None, :] ** 2))
    rng = np.random.default_rng(11)
    made = []
    for _ in range(2):
        field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(_FIELD, _FIELD))) * shape).real
        made.append((field / field.std()).astype(np.float32))
    return made[0], made[1]


def _piece(field: Float32, shape: tuple[int, ...], rng: np.random.Generator) -> Float32:
    """A piece of a field from a random place, either way round."""
    rolled = np.roll(field, tuple(rng.integers(0, _FIELD, 2).tolist()), axis=(0, 1))
    if rng.random() < 0.5:
        rolled = rolled[::-1]
    if rng.random() < 0.5:
        rolled = rolled[:, ::-1]
    height, width = shape[:2]
    repeats = (-(-height // _FIELD), -(-width // _FIELD))
    return np.ascontiguousarray(
        np.tile(rolled, repeats)[:height, :width] if max(repeats) > 1 else rolled[:height, :width]
    )
