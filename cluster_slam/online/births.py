"""What becomes of points that nobody claims: new flowers, or false detections, by where they appear.

A new point in a part of the plant that has just come into view is likely a flower; one in mid-air, where nothing was a
moment ago, is not. How likely is learned from what became of earlier ones; only who is more likely a flower than not is
called one before it has been confirmed.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_AGO_S = 0.5  # what was in view so long ago, and showed nothing, is not fresh
ALONE, BESIDE, DOUBTFUL = range(3)  # no cluster near; near one; near one that sways or misses flowers: perhaps these
_PRIOR = np.array(  # flowers and false detections that count as known beforehand, by place, seen before or fresh
    [[(1.0, 3.0), (2.0, 1.0)], [(1.0, 1.0), (4.0, 1.0)], [(1.0, 3.0), (1.0, 1.0)]]
)
_MEMORY = 60.0  # births after which old ones fade


class Births:
    """Counts of what became of new points, by kind of place (0 to 5) and by how often they were seen (once, twice)."""

    def __init__(self) -> None:
        self.past: deque[tuple[float, Array]] = deque()  # stamps and poses of the last half second
        flowers, false = _PRIOR.reshape(6, 2).T
        self._flowers, self._false = np.stack([flowers, flowers], axis=1), np.stack([false, 0.5 * false], axis=1)

    def note_view(self, stamp: float, T_world_camera: Array) -> None:
        """The camera was there."""
        self.past.append((stamp, T_world_camera))
        while len(self.past) > 1 and self.past[1][0] <= stamp - _AGO_S:
            self.past.popleft()

    @staticmethod
    def kind(place: IntArray, is_fresh: BoolArray) -> IntArray:
        """Kinds (q,) of ALONE, BESIDE or DOUBTFUL places."""
        return 2 * place + is_fresh

    @staticmethod
    def is_doubtful(kind: IntArray) -> BoolArray:
        """Which kinds (q,) are of doubtful places."""
        doubtful: BoolArray = kind // 2 == DOUBTFUL
        return doubtful

    def is_flower(self, kind: IntArray, n: IntArray) -> BoolArray:
        """Whether new points of these kinds (q,), seen n (q,) times by now, are flowers rather than not."""
        share = self._flowers / (self._flowers + self._false)
        likely: BoolArray = share[kind, np.clip(n, 1, 2) - 1] > 0.5
        return likely

    def became_flowers(self, kind: IntArray) -> None:
        """These have been confirmed."""
        self._flowers += np.bincount(kind, minlength=6)[:, None]
        self._fade()

    def were_false(self, kind: IntArray, n: IntArray) -> None:
        """These were seen n (q,) times and never confirmed, or turned out to be others."""
        self._false[:, 0] += np.bincount(kind, minlength=6)
        self._false[:, 1] += np.bincount(kind[n > 1], minlength=6)
        self._fade()

    def _fade(self) -> None:
        factor = np.minimum(_MEMORY / (self._flowers + self._false), 1.0)
        self._flowers *= factor
        self._false *= factor
