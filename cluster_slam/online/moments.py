"""Who is seen together in moments of several frames, where a detector misses flowers one at a time."""

from __future__ import annotations

import numpy as np

from cluster_slam.grouping.flowers import moment_length
from cluster_slam.records import IntArray


class Moments:
    """Counts moments that saw two flowers, by their seats; a moment is as long as the misses so far ask for."""

    def __init__(self, room: int) -> None:
        self.counts = np.zeros((room, room))  # moments that saw both (the diagonal: that saw it)
        self._is_in = np.zeros(room, dtype=bool)  # the moment that goes on
        self._last = np.zeros(room, dtype=bool)  # the last frame
        self._n_frames = 0
        self._seen, self._again = 0.0, 0.0  # flowers of frames, and of these seen in the next

    def grow(self, room: int) -> None:
        """Make room for so many seats."""
        old = len(self._last)
        counts = np.zeros((room, room))
        counts[:old, :old] = self.counts
        self.counts = counts
        self._is_in, self._last = np.resize(self._is_in, room), np.resize(self._last, room)
        self._is_in[old:], self._last[old:] = False, False

    def clear(self, seats: IntArray) -> None:
        """These flowers are no more."""
        self.counts[seats], self.counts[:, seats] = 0.0, 0.0
        self._is_in[seats], self._last[seats] = False, False

    def observe(self, seats: IntArray) -> None:
        """Flowers (q,) were seen in one frame."""
        self._seen += float(self._last.sum())
        self._again += float(self._last[seats].sum())
        self._last[:] = False
        self._last[seats], self._is_in[seats] = True, True
        self._n_frames += 1
        if self._n_frames >= moment_length(self._again / max(self._seen, 1.0)):
            all_in = np.flatnonzero(self._is_in)
            self.counts[all_in[:, None], all_in] += 1.0
            self._is_in[:], self._n_frames = False, 0
