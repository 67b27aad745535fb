"""Flowers whose errors last: each is looked at from several views, and stands a little elsewhere in each.

What a flower's observations from one view agree on is its place plus an error that lasts, and is no measurement of its
own in each frame. So the graph gets a place for each flower and view (a look); looks of one flower are tied to each
other, as their errors are alike where the views are. From the looks follows the flower, with what lasts in its
covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from cluster_slam.association.frames import Frames
from cluster_slam.config import SmoothConfig
from cluster_slam.geometry import Array
from cluster_slam.graph.batch import BatchSmoother, Estimate, Marginals
from cluster_slam.graph.poses import PoseModel
from cluster_slam.records import IntArray
from cluster_slam.smoothing.lasting import LastingErrors, lasting_errors, one_view, views
from cluster_slam.smoothing.rounds import solve
from cluster_slam.smoothing.world import World, for_solving, learn

_STEP = 0.15  # of the turn over which errors change: frames of one look
_MOST_LOOKS = 600  # of a session: with more, looks are wider, as solving takes their cube
COMMON = 0.1  # of the variance of what lasts: flowers of one plant are alike, and face the same way
_OWN = 1e-5  # m: two looks are never quite alike


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """Looks at flowers: which flower each is of, which look each observation belongs to, and what ties them.

    Places of looks (3 a,) have the information ``tied`` (3 a, 3 a) of each other whatever the flowers' places are;
    these are ``mean`` (3 l, 3 a) times them, but for errors of covariance ``left`` (3 l, 3 l).
    """

    flower: IntArray  # (a,)
    of: IntArray  # (m,) -1 none
    tied: Array
    mean: Array
    left: Array

    def flowers(self, estimate: Estimate) -> Estimate:
        """The estimate with places of flowers in place of those of looks."""
        return replace(estimate, places=(self.mean @ estimate.places.ravel()).reshape(-1, 3))

    def flowers_marginals(self, marginals: Marginals) -> Marginals:
        """Joint covariance of the flowers' places."""
        return replace(marginals, places=self.mean @ marginals.places @ self.mean.T + self.left)


@dataclass(frozen=True, slots=True, eq=False)
class InLooks:
    """A session solved with looks in place of flowers: its world and estimate are of looks, too."""

    world: World
    smoother: BatchSmoother
    estimate: Estimate
    looks: Looks
    lasting: LastingErrors


def solve_in_looks(
    stated: Frames, stated_poses: PoseModel, world: World, estimate: Estimate, config: SmoothConfig
) -> InLooks | None:
    """The session solved once more with looks in place of flowers, if errors of flowers last; else None.

    ``estimate`` is the solution without: what it found of noise and sway mistook errors that last for both.
    """
    frames, _ = for_solving(stated, stated_poses, world)
    used = estimate.weight > 0.5
    lasting = lasting_errors(frames, world.T, world.landmark, world.places, world.cluster, used)
    if lasting is None:
        return None
    by_look = looks(frames, world.T, world.landmark, len(world.places), lasting)
    world = replace(
        world, landmark=by_look.of, places=world.places[by_look.flower], cluster=world.cluster[by_look.flower]
    )
    for in_stretches in (False, False, True):
        frames, model = for_solving(stated, stated_poses, world)
        frames = replace(frames, covs=lasting.new(frames.points, frames.covs))
        smoother, estimate = solve(frames, model, world, config, 2, in_stretches=in_stretches, tied=by_look.tied)
        world = learn(world, smoother, estimate)
    return InLooks(world, smoother, estimate, by_look, lasting)


def looks(frames: Frames, T: Array, landmark: IntArray, n_flowers: int, lasting: LastingErrors) -> Looks:
    """Observations of each flower (``landmark`` (m,), -1 none) by views, from poses T (n, 4, 4)."""
    view = views(frames, T)
    step = _STEP * lasting.turn
    of, flower = _by_views(view, landmark, n_flowers, step)
    while len(flower) > _MOST_LOOKS and step < np.pi:
        step *= 1.2
        of, flower = _by_views(view, landmark, n_flowers, step)
    used = of >= 0
    n = np.maximum(np.bincount(of[used], minlength=len(flower)), 1)

    def means(x: Array) -> Array:
        flat = x[used].reshape(int(used.sum()), -1)
        total = np.stack([np.bincount(of[used], column, len(flower)) for column in flat.T], axis=1)
        return (total / n[:, None]).reshape(-1, *x.shape[1:])

    root = T[frames.frame][:, :3, :3] @ lasting.root(frames.points) @ np.swapaxes(T[frames.frame][:, :3, :3], 1, 2)
    return _tied(flower, of, means(view), means(root), n_flowers, lasting)


def _by_views(view: Array, landmark: IntArray, n_flowers: int, step: float) -> tuple[IntArray, IntArray]:
    of = np.full(len(landmark), -1, dtype=np.int64)
    flower: list[int] = []
    for j in range(n_flowers):
        k = np.flatnonzero(landmark == j)
        if len(k):
            number = one_view(view[k], step)
            of[k] = len(flower) + number
            flower += [j] * (int(number.max()) + 1)
        else:
            flower.append(j)
    return of, np.array(flower, dtype=np.int64)


def _tied(flower: IntArray, of: IntArray, view: Array, root: Array, n_flowers: int, lasting: LastingErrors) -> Looks:
    n, same = len(flower), flower[:, None] == flower
    rho = lasting.correlation(view, view) * np.where(same, 1.0, COMMON)
    C = np.einsum("aij,ab,bkj->aibk", root, rho, root).reshape(3 * n, 3 * n)
    factor = cho_factor(C + _OWN**2 * np.eye(3 * n), overwrite_a=True)
    one = np.kron(np.eye(n_flowers)[flower], np.eye(3))
    by_one = cho_solve(factor, one)
    left = cho_solve(cho_factor(one.T @ by_one), np.eye(3 * n_flowers))
    mean = left @ by_one.T
    return Looks(flower, of, cho_solve(factor, np.eye(3 * n)) - by_one @ mean, mean, left)
