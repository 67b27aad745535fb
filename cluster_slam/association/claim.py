"""The last word on single observations: wild errors are claimed for their flowers, and what fits nothing is let go.

A detector errs wildly now and then. Such a point lies outside every gate, yet where a flower of a cluster that is in
view was not seen in that frame and nothing else stands near, it is more likely that flower than a false detection. The
error of an observation is taken as a mixture,

    (1 - e) N(0, S) + e N(0, k^2 S),

against false detections at a density of their own. Both the share e of wild errors and that density are read off the
session: from how many free points lie near missed flowers, and how many in the shell around.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.displacement import presence_of
from cluster_slam.association.frames import Frames, chi2_and_log_det, view_volume
from cluster_slam.geometry import Array, rotate_cov, transform
from cluster_slam.records import BoolArray, IntArray

WILD = 5.0  # a wild error's sigma over the usual one
_NEAR = 4.0 * WILD  # sigmas within which wild errors lie ...
_FAR = 2.0 * _NEAR  # ... and within which the shell around them lies
_SURE = 3.0  # log-likelihood ratio of a claim, 95 %: a flower that is missed costs less than a false one
_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, slots=True)
class WildErrors:
    """Share of wild errors among all observations of flowers, and density of false detections, 1 / m^3."""

    share: float
    clutter_density: float

    def log_ratio(self, chi2: Array, log_det: Array) -> Array:
        """Log-likelihood ratio of an observation of a flower over a false detection, for its normalised distance."""
        usual = np.log1p(-self.share) - 0.5 * (chi2 + log_det + 3.0 * _LOG_2PI)
        wild = np.log(max(self.share, 1e-300)) - 0.5 * (chi2 / WILD**2 + log_det + 3.0 * _LOG_2PI) - 3.0 * np.log(WILD)
        ratio: Array = np.logaddexp(usual, wild) - np.log(self.clutter_density)
        return ratio


@dataclass(frozen=True, slots=True, eq=False)
class _Candidates:
    """Free points near flowers that their frame missed: rows of observations, flowers, distances."""

    row: IntArray
    flower: IntArray
    chi2: Array
    log_det: Array

    def only(self, which: BoolArray) -> _Candidates:
        return _Candidates(self.row[which], self.flower[which], self.chi2[which], self.log_det[which])


def claim_wild(
    frames: Frames, T: Array, places: Array, cluster: IntArray, landmark: IntArray, moved: Array, known: BoolArray
) -> tuple[IntArray, WildErrors]:
    """Landmark (m,) of each observation with wild ones claimed, and what was found about wild errors.

    Poses T (n, 4, 4), places (l, 3) with the cluster (l,) of each, landmarks (m,) so far, and where the clusters stood:
    displacements ``moved`` (n, c, 3) in the frames that saw them, ``known`` (n, c).
    """
    n_missed, candidates = _near_missed(frames, T, places, cluster, landmark, moved, known)
    if n_missed == 0 or len(candidates.row) == 0:
        return landmark, WildErrors(0.0, 1.0)
    everywhere = max(int((landmark < 0).sum()), 1) / frames.n_frames / view_volume(frames)
    errors = _wild_errors(candidates, n_missed, int((landmark >= 0).sum()), everywhere)
    if errors.share <= 0.0:
        return landmark, errors
    ratio = errors.log_ratio(candidates.chi2, candidates.log_det)
    out = landmark.copy()
    taken: set[tuple[int, int]] = set()
    for i in np.argsort(-ratio, kind="stable"):
        row, flower = int(candidates.row[i]), int(candidates.flower[i])
        if ratio[i] <= _SURE:
            break
        key = (int(frames.frame[row]), flower)
        if out[row] < 0 and key not in taken:
            out[row] = flower
            taken.add(key)
    return out, errors


def _near_missed(
    frames: Frames, T: Array, places: Array, cluster: IntArray, landmark: IntArray, moved: Array, known: BoolArray
) -> tuple[int, _Candidates]:
    """How many flowers of clusters in view were missed, over all frames, and the free points about them."""
    seen = presence_of(frames.frame, landmark, len(places), frames.n_frames).T.tocsr()
    n_missed, found = 0, []
    for i in range(frames.n_frames):
        here = frames.of(i)
        expected = known[i, cluster]
        expected[seen.indices[seen.indptr[i] : seen.indptr[i + 1]]] = False
        flowers = np.flatnonzero(expected)
        n_missed += len(flowers)
        free = here.start + np.flatnonzero(landmark[here] < 0)
        if len(flowers) == 0 or len(free) == 0:
            continue
        S = rotate_cov(T[i, :3, :3], frames.covs[free])
        offset = transform(T[i], frames.points[free])[:, None] - (places[flowers] + moved[i, cluster[flowers]])[None]
        near_row, near_flower = np.nonzero((offset**2).sum(-1) < _FAR**2 * np.trace(S, axis1=1, axis2=2)[:, None])
        if len(near_row):
            chi2, log_det = chi2_and_log_det(offset[near_row, near_flower], S[near_row])
            found.append(_Candidates(free[near_row], flowers[near_flower], chi2, log_det))
    if not found:
        none = np.empty(0, dtype=np.int64)
        return n_missed, _Candidates(none, none, np.empty(0), np.empty(0))
    row, flower, chi2, log_det = (
        np.concatenate([getattr(f, name) for f in found]) for name in ("row", "flower", "chi2", "log_det")
    )
    return n_missed, _Candidates(row, flower, chi2, log_det)


def _wild_errors(candidates: _Candidates, n_missed: int, n_matched: int, everywhere: float) -> WildErrors:
    """Density of false detections from the shell about missed flowers; what is nearer in excess of it is wild.

    The density ``everywhere``, 1 / m^3, counts as one detection in the shell.
    """
    unit = 4.0 / 3.0 * np.pi * float(np.exp(0.5 * np.median(candidates.log_det)))  # m^3 within one sigma
    nearest = np.full(int(candidates.row.max()) + 1, np.inf)
    np.minimum.at(nearest, candidates.row, candidates.chi2)
    near = int((nearest < _NEAR**2).sum())
    shell = int(((nearest[candidates.row] >= _NEAR**2) & (candidates.chi2 < _FAR**2)).sum())
    density = (shell + 1.0) / (n_missed * unit * (_FAR**3 - _NEAR**3) + 1.0 / everywhere)
    expected = density * n_missed * unit * _NEAR**3
    excess = near - expected
    share = excess / (n_matched + excess) if excess > 3.0 * np.sqrt(expected + 1.0) else 0.0
    return WildErrors(float(min(share, 0.5)), float(density))


def let_go(landmark: IntArray, chi2: Array, frames: Frames, errors: WildErrors, least_share: float) -> IntArray:
    """Landmarks (m,) without the observations that are likelier false detections at their distance ``chi2`` (m,)."""
    _, log_det = chi2_and_log_det(np.zeros((len(frames), 3)), frames.covs)
    errors = WildErrors(max(errors.share, least_share), errors.clutter_density)
    ratio = errors.log_ratio(np.nan_to_num(chi2), log_det)
    return np.where((landmark >= 0) & (ratio < 0.0), -1, landmark)
