"""What a recording shows of its own errors: how far clusters sway, by how much the stated sigmas are wrong.

Each figure is a ratio of what was observed to what the model would have on average (Foerstner 1979; Helmert), from
frames that are located for sure, with a little of the prior where they are few.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.localisation.evidence import in_view_of
from cluster_slam.localisation.fit import Fit, solve
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.scene import ErrorScale, Look, make_look

_PRIOR_DOF = 10.0  # so many degrees of freedom the prior counts for: a frame or two
_PRIOR_CLUSTERS = 20.0  # so many the prior of the share of touched clusters counts for
_N_ROUNDS = 6
_LEAST_SWAY = 0.02  # of the prior: a plant in still air, or made of tubes
_RANGE = (0.01, 100.0)  # of factors on stated variances


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A frame that is located for sure, with its points as stated."""

    look: Look  # covariances as stated, times the variance factor under which it was matched
    marks: Landmarks
    fit: Fit


def learn_scale(seen: Sequence[Seen], prior: ErrorScale) -> ErrorScale:
    """The scale of errors under which the located frames are as likely as they should be."""
    if not seen:
        return prior
    scale = prior
    fits = [s.fit for s in seen]
    for _ in range(_N_ROUNDS):
        sway = _sway(seen, fits, scale)
        factor = float(np.clip(_flower_variance(seen, fits, scale, prior), *_RANGE))
        change = abs(np.log(factor / scale.flower_variance)) + abs(np.log(sway / scale.sway_m))
        scale = replace(scale, flower_variance=factor, sway_m=max(sway, _LEAST_SWAY * prior.sway_m))
        if change < 0.02:
            break
        fits = [
            solve(
                make_look(s.look.points, s.look.covs / prior.flower_variance, scale),
                s.marks,
                f.T_map_camera,
                f.rows,
                f.flowers,
                scale,
                2,
            )
            for s, f in zip(seen, fits, strict=True)
        ]
    return replace(
        scale,
        detection=_detection(seen, prior),
        unmapped=_unmapped(seen, prior),
        touched_share=_touched(fits, prior),
    )


def _flower_variance(seen: Sequence[Seen], fits: Sequence[Fit], scale: ErrorScale, prior: ErrorScale) -> float:
    """Factor on the points' stated variances: observed squares over the expected ones.

    Where flowers are off by what the map has wrong rather than by how they were measured, their squares say more of the
    map than of the points: such frames count for the prior.
    """
    observed, expected = _PRIOR_DOF * prior.flower_variance, _PRIOR_DOF
    for s, f in zip(seen, fits, strict=True):
        measured = np.trace(s.look.covs[f.rows], axis1=1, axis2=2) * scale.flower_variance / prior.flower_variance
        known = float(np.mean(measured / (measured + np.trace(s.marks.covs[f.flowers], axis1=1, axis2=2))))
        by_map = (1.0 - known) ** 2
        observed += (1.0 - by_map) * float(f.chi2.sum()) * scale.flower_variance
        observed += by_map * f.redundancy * prior.flower_variance
        expected += f.redundancy
    return observed / expected


def _sway(seen: Sequence[Seen], fits: Sequence[Fit], scale: ErrorScale) -> float:
    """Standard deviation of the sway an axis, m: observed squares of displacements over the expected ones."""
    observed = expected = 0.0
    prior = scale.sway_m**2
    for s, f in zip(seen, fits, strict=True):
        total = np.trace(s.marks.shared_covs[f.clusters], axis1=1, axis2=2) / 3.0 + prior
        gained = np.maximum(total - f.offset_vars, 0.0) / total  # share of a displacement that the frame shows
        square = (f.offsets**2).sum(1) / total
        usual = square < 16.0 * np.maximum(gained, 0.05)  # beyond, it was touched
        weight = ((1.0 - f.swinging) * prior / total)[usual]  # what the map itself may be wrong by says nothing of sway
        observed += float((weight * square[usual]).sum())
        expected += float((weight * 3.0 * gained[usual]).sum())
    return float(np.sqrt(prior * (observed + _PRIOR_DOF) / (expected + _PRIOR_DOF)))


def _touched(fits: Sequence[Fit], prior: ErrorScale) -> float:
    """Share of the clusters that swing after a touch."""
    swinging = sum(float(f.swinging.sum()) for f in fits)
    n = sum(len(f.swinging) for f in fits)
    return (swinging + _PRIOR_CLUSTERS * prior.touched_share) / (n + _PRIOR_CLUSTERS)


def _detection(seen: Sequence[Seen], prior: ErrorScale) -> float:
    """Share of the flowers of the clusters in view that were detected."""
    found, missed = 10.0 * prior.detection, 10.0 * (1.0 - prior.detection)
    for s in seen:
        there = in_view_of(s.fit.T_map_camera, s.look, s.marks) & np.isin(s.marks.cluster, s.fit.clusters)
        missed += float(there.sum()) - float(there[s.fit.flowers].sum())
        found += float(len(s.fit.rows))
    return float(np.clip(found / (found + missed), 0.3, 0.98))


def _unmapped(seen: Sequence[Seen], prior: ErrorScale) -> float:
    """Share of the points that the map does not have."""
    alone, all_points = 10.0 * prior.unmapped, 10.0
    for s in seen:
        alone += float(len(s.look) - len(s.fit.rows))
        all_points += float(len(s.look))
    return float(np.clip(alone / all_points, 0.02, 0.6))
