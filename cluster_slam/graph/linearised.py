"""A session's problem at an estimate, linearised: what two ways of solving it share."""

from __future__ import annotations

from dataclasses import dataclass

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """What is connected with what: of q observations, p pairs, s stretches; observations sorted by frame, then pair."""

    frame: IntArray  # (q,)
    pair: IntArray  # (q,)
    landmark: IntArray  # (q,)
    pair_frame: IntArray  # (p,) sorted
    stretch: IntArray  # (p,) -1 for none
    n_frames: int
    n_places: int
    n_stretches: int


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Whitened Jacobians and residuals at an estimate, and the priors as information and its vector."""

    A_z: Array  # (q, 3, 6) by the pose
    A_l: Array  # (q, 3, 3) by the place, or the displacement
    r: Array  # (q, 3)
    d: Array  # (p, 3) displacements, less the means of their stretches ...
    d_information: Array  # (p,) ... known so well
    b: Array  # (s, 3) means of stretches ...
    b_information: Array  # (s,) ... known so well
    z_information: Array  # (n, 6, 6)
    z_vector: Array  # (n, 6)
    chain: Array | None  # (n - 1, 6, 6) information of each pose with the next; None: each for itself. With it z less x
    zx_information: Array  # (n, 6, k) of poses with the hand-eye tangent; k is 6, or 0 where there is none
    x_information: Array  # (k, k)
    x_vector: Array  # (k,)
    place_information: float
    tied: Array | None = None  # (3 l, 3 l) information of places with each other ...
    tied_vector: Array | None = None  # (3 l,) ... and its vector


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """What poses (n, 6), displacements (p, 3), stretches (s, 3), places (l, 3) and the hand-eye (k,) change by."""

    z: Array
    d: Array
    b: Array
    places: Array
    x: Array
