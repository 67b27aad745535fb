"""A session whose poses drift, or a part of it, with all that its association goes by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.drift_labels import Labelling, State, View
from cluster_slam.association.drift_smoother import Steps
from cluster_slam.association.frames import Frames
from cluster_slam.association.submaps import window
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array

_REPEATS = 2.5  # of a point's variance: what a place has over the number of its points ...
_LASTS = 0.06  # ... and what no number of points averages


@dataclass(frozen=True, slots=True, eq=False)
class DriftSession:
    """Points, odometry (n, 4, 4) with its steps, options, and what draws particles."""

    frames: Frames
    given: Array
    steps: Steps
    config: ParticleConfig
    rng: np.random.Generator
    view: View

    @property
    def labels(self) -> Labelling:
        """What labels its points from poses that are nearly right."""
        return Labelling(self.frames, self.steps, self.config, self.view)

    def between(self, first: int, end: int) -> DriftSession:
        """The frames ``first`` to ``end`` (without it) as a session."""
        steps = self.steps.between(first, end)
        return DriftSession(
            window(self.frames, first, end), self.given[first:end], steps, self.config, self.rng, self.view
        )

    def place_covs(self, state: State) -> Array:
        """How well places are known (l, 3, 3) relative to the latest pose: noise that repeats, and that does not."""
        noise_sq = float(np.median(np.trace(self.frames.covs, axis1=1, axis2=2)))
        count = np.bincount(state.label[state.label >= 0], minlength=len(state.places))
        var = noise_sq * (_LASTS + _REPEATS / np.maximum(count, 1))
        return np.asarray(var[:, None, None] * np.eye(3))
