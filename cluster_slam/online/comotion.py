"""What the flowers' motion says of whether they belong together, added up while it goes on.

The ratio is that of ``cluster_slam.grouping.comotion``: zero where two flowers move as one. There each frame is judged
by all frames around it, and displacements count from places at rest that the whole session tells. Here only sums are
kept, over spells of 0.8 s, each looked at when it is over; and as places at rest are not yet known well, what a flower
did in a spell counts from its mean in this spell: errors that last longer have no say.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from cluster_slam.geometry import Array
from cluster_slam.grouping.comotion import (
    FEWEST_FRAMES,
    NEAR,
    SIGNIFICANT,
    SURE,
    SYSTEMATIC,
    WINDOW_S,
    Ratios,
    log_likelihood_ratio,
    turning_ratio,
)
from cluster_slam.grouping.lasting import share_of_smallest
from cluster_slam.records import BoolArray, IntArray

_FEWEST = 3  # frames of a stretch that show a pair: the worst of them is left out
_MOST = 64  # frames, from which on the share that is left hardly changes
_N_FRAMES = np.arange(_FEWEST, _MOST + 1)
_LEFT = np.concatenate([np.ones(_FEWEST), share_of_smallest(1.0 - 1.0 / _N_FRAMES)])  # of noise, by number of frames
_N_SUMS = 8
_SPELL_S = 2.0 * WINDOW_S
_AROUND_S = 0.1  # how far something moved is told by the frames so near


class _Spell(NamedTuple):
    """Frames (n,) of a spell, with the half (n,) of it that each is in: where flowers stood.

    Positions ``w`` (n, l, 3) m, ``information`` (n, l), zero where unseen, ``places`` (l, 3) at rest.
    """

    half: IntArray
    seats: IntArray
    w: Array
    information: Array
    places: Array


class CommonMotion:
    """Sums over spells in which one of two flowers moved, all (n, n) over seats.

    Weighted squares of differences, of both motions, of noise, and of the noise that is left without the worst frames;
    fourth power of noise; motion, and its square, in halves of spells; frames.
    """

    def __init__(self, room: int) -> None:
        self.sums = np.zeros((_N_SUMS, room, room))
        self._begun = -np.inf
        self._frames: list[tuple[float, IntArray, Array, Array, Array]] = []

    def grow(self, n: int) -> None:
        """Room for ``n`` seats."""
        old = self.sums.shape[1]
        sums = np.zeros((_N_SUMS, n, n))
        sums[:, :old, :old] = self.sums
        self.sums = sums

    def clear(self, seats: IntArray) -> None:
        """Nothing is known of who sits there."""
        self.sums[:, seats] = 0.0
        self.sums[:, :, seats] = 0.0
        kept = [~np.isin(frame[1], seats) for frame in self._frames]
        self._frames = [(t, *(x[k] for x in of)) for k, (t, *of) in zip(kept, self._frames, strict=True)]  # type: ignore[misc]

    def observe(self, stamp: float, seats: IntArray, w: Array, var: Array, places: Array, reach: float) -> None:
        """Flowers were seen at w (q, 3), variances (q,) along an axis, that at rest are at ``places`` (q, 3).

        Pairs farther apart than ``reach`` m are of no interest.
        """
        if stamp - self._begun >= _SPELL_S:
            self._add(reach)
            self._begun, self._frames = stamp, []
        self._frames.append((stamp, seats, w, var, places))

    def evidence(self, seats: IntArray, places: Array, reach: float) -> csr_matrix:
        """Log-likelihood ratios (l, l) that two of these flowers within ``reach`` move as one, against that not."""
        n = len(seats)
        f, g = np.nonzero(np.triu(self.sums[-1][seats[:, None], seats] >= FEWEST_FRAMES, 1))
        apart, power, noise, left, fourth, motion, motion_sq, _ = self.sums[:, seats[f], seats[g]]
        distance = np.linalg.norm(places[f] - places[g], axis=1)
        total = power - noise
        moved = np.where(total > 0.0, total, np.inf)
        sigma = np.hypot(np.sqrt(6.0 * fourth), SYSTEMATIC * noise) / moved
        known = (total > 0.0) & (sigma < SURE) & (distance < reach)
        if not known.any():
            return csr_matrix((n, n))
        n_stretches = motion**2 / np.maximum(motion_sq, 1e-300)
        ratios = Ratios(*(x[known] for x in ((apart - left) / moved, sigma, n_stretches, np.zeros_like(sigma))))
        value = log_likelihood_ratio(ratios, turning_ratio(ratios, distance[known], NEAR * reach))
        upper = csr_matrix((value, (f[known], g[known])), shape=(n, n))
        return csr_matrix(upper + upper.T)

    def _add(self, reach: float) -> None:
        """The spell is over: who moved, and who with whom?"""
        if len(self._frames) < _FEWEST:
            return
        spell = _spell_of(self._frames, self._begun)
        power = _power(spell, max(1, round(_AROUND_S / max(self._frames[1][0] - self._frames[0][0], 1e-3))))
        moved = np.asarray((power > 0.0).any(axis=0))
        if not moved.any():
            return
        gap = spell.places[:, None] - spell.places[None]
        near = np.einsum("fgi,fgi->fg", gap, gap) < reach * reach
        f, g = np.nonzero(np.triu(near & (moved[:, None] | moved), 1))
        enough, sums = _pair_sums(spell, power, f, g)
        a, b = spell.seats[f[enough]], spell.seats[g[enough]]
        self.sums[:, a, b] += sums
        self.sums[:, b, a] += sums


def _spell_of(frames: list[tuple[float, IntArray, Array, Array, Array]], begun: float) -> _Spell:
    seats = np.unique(np.concatenate([frame[1] for frame in frames]))
    n, size = len(frames), len(seats)
    w, information, places = np.zeros((n, size, 3)), np.zeros((n, size)), np.zeros((size, 3))
    for k, (_, who, seen_at, var, place) in enumerate(frames):
        at = np.searchsorted(seats, who)
        w[k, at], information[k, at], places[at] = seen_at, 1.0 / var, place
    half = np.array([frame[0] - begun >= WINDOW_S for frame in frames], dtype=np.int64)
    return _Spell(half, seats, w, information, places)


def _power(spell: _Spell, around: int) -> Array:
    """How far each flower (n, l) stood from its mean, m^2 along any axis, by ``around`` frames before and after."""
    information = spell.information
    total = information.sum(axis=0)
    mean = (information[..., None] * spell.w).sum(axis=0) / np.where(total > 0.0, total, 1.0)[:, None]
    pull = information[..., None] * (spell.w - mean)
    others, n_others = _others(information, around), _others((information > 0.0).astype(float), around)
    told = n_others > 0.5
    noise = np.where(told, 1.0 / np.where(told, others, 1.0), 0.0)
    square = (_others(pull, around) ** 2).sum(axis=-1) * noise**2
    return np.asarray(np.where(told & (square > SIGNIFICANT * noise), square / 3.0 - noise, 0.0))


def _others(x: Array, around: int) -> Array:
    """Sums over so many rows before and after each row of x (n, ...)."""
    total = np.concatenate([np.zeros_like(x[:1]), np.cumsum(x, axis=0)])
    i = np.arange(len(x))
    return np.asarray(total[np.minimum(i + around + 1, len(x))] - total[np.maximum(i - around, 0)] - x)


def _pair_sums(spell: _Spell, power: Array, f: IntArray, g: IntArray) -> tuple[BoolArray, Array]:
    """Which pairs (p,) were seen often enough, and of these the sums (8, ...)."""
    seen = (spell.information[:, f] > 0.0) & (spell.information[:, g] > 0.0)
    signal = power[:, f] + power[:, g]
    used = seen & (signal > 0.0)
    count = used.sum(axis=0)
    enough: BoolArray = count >= _FEWEST
    f, g, count = f[enough], g[enough], count[enough]
    signal, used, seen = signal[:, enough], used[:, enough], seen[:, enough]
    noise = 1.0 / np.where(seen, spell.information[:, f], 1.0) + 1.0 / np.where(seen, spell.information[:, g], 1.0)
    share = seen / noise
    known = 1.0 / share.sum(axis=0)  # variance of a mean
    share = share * known
    u_f, u_g = (spell.w[:, k] - np.einsum("np,npi->pi", share, spell.w[:, k]) for k in (f, g))
    weight = np.where(used, signal / (signal + noise) / noise, 0.0)
    difference = weight * ((u_f - u_g) ** 2).sum(axis=-1)
    both = weight * ((u_f**2).sum(axis=-1) + (u_g**2).sum(axis=-1))
    expected = weight * (noise - known)
    halves = [(weight * signal)[spell.half == k].sum(axis=0) for k in (0, 1)]
    # A single wrong observation must not part a cluster.
    worst = difference.argmax(axis=0), np.arange(len(f))
    difference[worst] = both[worst] = expected[worst] = 0.0
    floor = 3.0 * expected.sum(axis=0)
    left = _LEFT[np.minimum(count, _MOST)] * floor
    fourth = (expected**2).sum(axis=0)
    motion = halves[0] + halves[1], halves[0] ** 2 + halves[1] ** 2
    sums = difference.sum(axis=0), both.sum(axis=0), floor, left, fourth, *motion, count
    return enough, np.stack([np.asarray(x, np.float64) for x in sums])
