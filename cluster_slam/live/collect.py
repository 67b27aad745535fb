"""Live frames, kept as they come, become a session in memory: what a result of live tracking is a result of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam.records import Frame, Observations, Session


class Collector:
    """Frames that a tracker took, in their order."""

    def __init__(self, header: Session) -> None:
        self._header = header
        self._frames: list[Frame] = []

    def add(self, frame: Frame) -> bool:
        """Keep a frame; False where a session cannot hold it: no pose, or not later than the one before."""
        is_later = not self._frames or frame.stamp > self._frames[-1].stamp
        if not (is_later and np.isfinite(frame.stamp) and np.isfinite(frame.pose).all()):
            return False
        self._frames.append(frame)
        return True

    def session(self) -> Session:
        """All that was kept; rows of the observations as they came, those that are no points too."""
        frames = self._frames
        counts = [len(frame) for frame in frames]
        scores = [np.full(len(f), np.nan) if f.scores is None else f.scores for f in frames]
        observations = Observations(
            np.repeat(np.arange(len(frames)), counts).astype(np.int64),
            np.concatenate([np.zeros((0, 3)), *(frame.points for frame in frames)]),
            np.concatenate([np.zeros((0, 3, 3)), *(frame.covs for frame in frames)]),
            np.concatenate([np.zeros(0), *scores]),
        )
        poses = np.stack([frame.pose for frame in frames]) if frames else np.zeros((0, 4, 4))
        stamps = np.array([frame.stamp for frame in frames])
        return replace(self._header, stamps=stamps, poses=poses, observations=observations)
