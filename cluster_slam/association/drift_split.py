"""Landmarks that may be two are tried as two, the reverse of merging.

Two landmarks that stand close together are one as long as few points are known, and what shows later that they are two
never finds them apart: each point alone fits the one in the middle (compare Ueda, Nakano, Ghahramani, Hinton, "SMEM
algorithm for mixture models", 2000).
"""

from __future__ import annotations

import numpy as np

from cluster_slam.association.drift_labels import Labelling, State, Trial
from cluster_slam.association.drift_smoother import DriftSmoother
from cluster_slam.geometry import Array, rotate_cov, transform
from cluster_slam.records import BoolArray

_FEWEST = 4  # points of a landmark that is tried as two
_LIKELY = 0.4  # of what the choice between the two costs must be saved before poses have adapted
_N_ROUNDS = 8


def split(labels: Labelling, state: State, price: float, n_tries: int = 8) -> State:
    """Try landmarks as two, those first whose points say so most clearly; keep what makes the whole likelier."""
    return labels.improve(state, lambda now: _candidates(labels, now), price, n_tries)


def _candidates(labels: Labelling, state: State) -> list[Trial]:
    """Every landmark as two, the clearest gain first."""
    smoother = labels.smoother(len(state.T))
    frame, points = smoother.frames.frame, smoother.frames.points
    world = transform(state.T[frame], points)
    information = rotate_cov(state.T[frame, :3, :3], smoother.information)
    found = []
    for j in range(len(state.places)):
        rows = np.flatnonzero(state.label == j)
        if len(rows) < _FEWEST:
            continue
        second, pair, gain = _as_two(smoother, world[rows], information[rows], state.places[j])
        if min(int(second.sum()), len(rows) - int(second.sum())) < 2:
            continue
        label = state.label.copy()
        label[rows[second]] = len(state.places)
        places = np.concatenate([state.places, pair[1:]])
        places[j] = pair[0]
        choice = _choice_cost(float(second.mean()), len(rows))
        if gain > _LIKELY * choice:
            found.append((gain - choice, Trial.of(label, places, state.places[j])))
    return [candidate for _, candidate in sorted(found, key=lambda item: -item[0])]


def _choice_cost(share: float, n: int) -> float:
    """Twice the negative log-probability of n labels that are one or the other, the first with this share."""
    return -2.0 * n * float(share * np.log(share) + (1.0 - share) * np.log(1.0 - share))


def _as_two(smoother: DriftSmoother, world: Array, information: Array, place: Array) -> tuple[BoolArray, Array, float]:
    """Which points (k,) are the second of two landmarks, where those are (2, 3), and the cost saved at these poses."""

    def cost(places: Array) -> Array:
        error = world[:, None] - places
        return smoother.point_cost(np.einsum("kpi,kij,kpj->kp", error, information, error))

    before = float(cost(place[None]).sum())
    axes = np.linalg.eigh(np.cov((world - place).T))
    best = (np.zeros(len(world), dtype=bool), np.stack([place, place]), -np.inf)
    for axis in (2, 1):
        step = np.sqrt(max(axes.eigenvalues[axis], 0.0)) * axes.eigenvectors[:, axis]
        places = np.stack([place - step, place + step])
        for _ in range(_N_ROUNDS):
            second = cost(places).argmin(axis=1) == 1
            if not second.any() or second.all():
                break
            for side, members in ((0, np.logical_not(second)), (1, second)):
                total = information[members].sum(axis=0)
                places[side] = np.linalg.solve(total, np.einsum("kij,kj->i", information[members], world[members]))
        saved = before - float(cost(places).min(axis=1).sum())
        if saved > best[2]:
            best = (cost(places).argmin(axis=1) == 1, places, saved)
    return best
