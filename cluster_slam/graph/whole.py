"""The whole graph in GTSAM: where odometry ties each pose to the next, and to hold other ways of solving against.

GTSAM eliminates the Gaussian factor graph: displacements first, then poses and stretches as time goes on, then places,
and the hand-eye transform last.
"""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.graph.linearised import Increments, Linearised, Links

_UNIT = gtsam.noiseModel.Unit.Create(3)


class _Keys:
    """Integer keys of the unknowns, in the order of elimination, but for b between the z's: d, z, b, l, x."""

    def __init__(self, links: Links, k: int) -> None:
        counts = [len(links.pair_frame), links.n_frames, links.n_stretches, links.n_places, 1 if k else 0]
        self.d, self.z, self.b, self.l, self.x = (int(start) for start in np.cumsum([0, *counts[:-1]]))
        self.end = self.x + counts[-1]


def solve_step(links: Links, at: Linearised) -> Increments:
    """The Gauss-Newton step. Raises RuntimeError where the problem is singular."""
    keys = _Keys(links, len(at.x_vector))
    delta = whole_graph(links, at).optimize(_in_order([*_of_frames(links, keys), *range(keys.l, keys.end)]))

    def rows(first: int, last: int, width: int) -> Array:
        return np.array([delta.at(key) for key in range(first, last)]).reshape(last - first, width)

    x = rows(keys.x, keys.end, 6).ravel()
    return Increments(
        z=rows(keys.z, keys.b, 6) + (x if _from_x(at) else 0.0),
        d=rows(keys.d, keys.z, 3),
        b=rows(keys.b, keys.l, 3),
        places=rows(keys.l, keys.x, 3),
        x=x,
    )


def remaining(links: Links, at: Linearised) -> Array:
    """Information (3 l + k, 3 l + k) of places and hand-eye transform, all else eliminated."""
    keys = _Keys(links, len(at.x_vector))
    _, rest = whole_graph(links, at).eliminatePartialMultifrontal(_in_order(_of_frames(links, keys)))
    H = np.array(rest.hessian(_in_order(range(keys.l, keys.end)))[0])
    if at.tied is not None:
        H[: len(at.tied), : len(at.tied)] += at.tied
    return H


def whole_graph(links: Links, at: Linearised) -> gtsam.GaussianFactorGraph:
    """One factor an observation, and the priors."""
    keys, graph = _Keys(links, len(at.x_vector)), gtsam.GaussianFactorGraph()
    _add_poses(graph, keys, at)
    _add_displacements(graph, keys, links, at)
    z, j, d = ((keys.z + links.frame).tolist(), (keys.l + links.landmark).tolist(), (keys.d + links.pair).tolist())
    for k in np.flatnonzero(at.A_l.any(axis=(1, 2))).tolist():  # those that have any weight
        graph.add(gtsam.JacobianFactor(z[k], at.A_z[k], j[k], at.A_l[k], d[k], at.A_l[k], at.r[k], _UNIT))
    if _from_x(at):
        _add_seen_from_x(graph, keys, links, at)
    weak = np.asfortranarray(np.sqrt(at.place_information) * np.eye(3))
    for key in range(keys.l, keys.x):
        graph.add(gtsam.JacobianFactor(key, weak, np.zeros(3), _UNIT))
    return graph


def _from_x(at: Linearised) -> bool:
    """Whether the tangents of poses are counted from where the hand-eye transform takes them: flanges in a chain."""
    return at.chain is not None and len(at.x_vector) > 0


def _add_poses(graph: gtsam.GaussianFactorGraph, keys: _Keys, at: Linearised) -> None:
    for i, (H, g) in enumerate(zip(at.z_information, at.z_vector, strict=True)):
        graph.add(gtsam.HessianFactor(keys.z + i, H, g, 0.0))
    nothing, none = np.zeros((6, 6)), np.zeros(6)
    for i, H in enumerate(at.chain if at.chain is not None else ()):
        graph.add(gtsam.HessianFactor(keys.z + i, keys.z + i + 1, nothing, H, none, nothing, none, 0.0))
    if len(at.x_vector):
        for i, H in enumerate(at.zx_information):
            graph.add(gtsam.HessianFactor(keys.z + i, keys.x, nothing, H, none, nothing, none, 0.0))
        graph.add(gtsam.HessianFactor(keys.x, at.x_information, at.x_vector, 0.0))


def _add_seen_from_x(graph: gtsam.GaussianFactorGraph, keys: _Keys, links: Links, at: Linearised) -> None:
    """What x, which moves all poses, adds to the information of the observations; factors hold three unknowns only."""
    by_x, none, nothing = np.swapaxes(at.A_z, 1, 2), np.zeros(6), np.zeros((6, 6))
    graph.add(gtsam.HessianFactor(keys.x, (by_x @ at.A_z).sum(0), (by_x @ at.r[..., None]).sum(0).ravel(), 0.0))
    for first, of, A, n in (
        (keys.z, links.frame, at.A_z, links.n_frames),
        (keys.l, links.landmark, at.A_l, links.n_places),
        (keys.d, links.pair, at.A_l, len(links.pair_frame)),
    ):
        width = A.shape[2]
        H = np.zeros((n, width, 6))
        np.add.at(H, of, np.swapaxes(A, 1, 2) @ at.A_z)
        empty, zero = np.zeros((width, width)), np.zeros(width)
        for i, block in enumerate(H):
            graph.add(gtsam.HessianFactor(first + i, keys.x, empty, block, zero, nothing, none, 0.0))


def _add_displacements(graph: gtsam.GaussianFactorGraph, keys: _Keys, links: Links, at: Linearised) -> None:
    factor, eye = gtsam.JacobianFactor, np.eye(3)
    roots = np.sqrt(at.d_information).tolist()
    for p, (root, s) in enumerate(zip(roots, links.stretch.tolist(), strict=True)):
        A, b = root * eye, -root * at.d[p]
        if s >= 0:
            graph.add(factor(keys.d + p, A, keys.b + s, -A, b, _UNIT))
        else:
            graph.add(factor(keys.d + p, A, b, _UNIT))
    for s, root in enumerate(np.sqrt(at.b_information).tolist()):
        graph.add(factor(keys.b + s, root * eye, -root * at.b[s], _UNIT))


def _of_frames(links: Links, keys: _Keys) -> list[int]:
    """Keys of what is eliminated before places: in time, so that odometry carries few stretches along."""
    end = np.zeros(links.n_stretches)
    within = links.stretch >= 0
    np.maximum.at(end, links.stretch[within], links.pair_frame[within] + 0.5)
    time = np.concatenate([np.arange(links.n_frames), end])
    return [*range(keys.z), *(keys.z + np.argsort(time, kind="stable")).tolist()]


def _in_order(keys: Iterable[int]) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering
