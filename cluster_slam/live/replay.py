"""A recorded session as a source of frames."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cluster_slam.live.view import Notice
from cluster_slam.records import Frame, Observations, Session


def header_of(session: Session) -> Session:
    """The session without its frames."""
    none = Observations(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    return replace(session, stamps=np.zeros(0), poses=np.zeros((0, 4, 4)), observations=none)


class Replay:
    """Frames of a session in their order, at once or at the pace at which they were recorded."""

    def __init__(self, session: Session, *, is_realtime: bool = False) -> None:
        self.header = header_of(session)
        self._session, self._is_realtime = session, is_realtime

    def frames(self) -> Iterator[Frame]:
        """All frames, those that saw nothing too."""
        seen = self._session.observations
        order = np.argsort(seen.frame, kind="stable")
        ends = np.searchsorted(seen.frame[order], np.arange(self._session.n_frames + 1))
        begin = time.monotonic()
        for i, stamp in enumerate(self._session.stamps.tolist()):
            if self._is_realtime:
                time.sleep(max(begin + stamp - float(self._session.stamps[0]) - time.monotonic(), 0.0))
            k = order[ends[i] : ends[i + 1]]
            yield Frame(stamp, self._session.poses[i], seen.points[k], seen.covs[k], seen.scores[k])

    def notices(self) -> list[Notice]:
        """Nothing happens to a recording."""
        return []
