"""How one clock runs against another, from stamps and the times at which they arrived.

A stamp arrives late, by a delay that is never negative and now and then small. So the line below all pairs of
(stamp, arrival - stamp), as close to them as can be, is the clock's offset and drift: Moon, Skelly, Towsley,
"Estimation and removal of clock skew from network delay measurements" (INFOCOM 1999). That line is the edge of the
lower convex hull below the mean stamp. The smallest delay itself cannot be seen and stays in the offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array

MAX_DRIFT = 5e-4  # of a quartz, with room to spare; a line that is steeper is an accident
_BIN_S = 1.0  # of each second the smallest delay is kept ...
_N_BINS = 120  # ... for so many seconds
_MIN_SPAN_S = 10.0  # shorter, and no drift is estimated
_EARLY_S = 0.02  # an arrival so long before what the line allows: a clock was set back or forward
_LATE_S = 0.25  # arrivals all so late ...
_LATE_FOR_S = 2.0  # ... for so long: the same


@dataclass(frozen=True, slots=True)
class Clock:
    """``arrival = stamp + offset_s + drift * (stamp - reference_s)``."""

    reference_s: float  # a stamp
    offset_s: float  # there
    drift: float  # seconds a second; 0 where too little was seen
    jitter_s: float  # median of the smallest delays of a second, above the smallest of all
    span_s: float  # of the stamps behind the estimate

    def arrival(self, stamps: Array) -> Array:
        """Times on the receiver's clock (n,) of stamps (n,)."""
        return stamps + self.offset_s + self.drift * (stamps - self.reference_s)

    def stamp(self, arrivals: Array) -> Array:
        """Stamps (n,) of times on the receiver's clock (n,)."""
        return self.reference_s + (arrivals - self.offset_s - self.reference_s) / (1.0 + self.drift)


def fit_clock(stamps: Array, arrivals: Array) -> Clock:
    """The clock of stamps (n,) and the times (n,) at which they arrived, n > 0."""
    span = float(np.ptp(stamps))
    stamps, arrivals = _earliest(stamps, arrivals)
    reference = float(stamps.mean())
    x, y = stamps - reference, arrivals - stamps
    drift = _hull_slope(x, y) if span >= _MIN_SPAN_S else 0.0
    drift = min(max(drift, -MAX_DRIFT), MAX_DRIFT)
    late = y - drift * x
    offset = float(late.min())
    return Clock(reference, offset, drift, float(np.median(late)) - offset, span)


def _earliest(stamps: Array, arrivals: Array) -> tuple[Array, Array]:
    """Of each second the pair with the smallest delay: only these can matter."""
    order = np.lexsort((arrivals - stamps, stamps // _BIN_S))
    _, first = np.unique(stamps[order] // _BIN_S, return_index=True)
    kept = order[first]
    return stamps[kept], arrivals[kept]


def _hull_slope(x: Array, y: Array) -> float:
    """Slope of the lower convex hull's edge below x = 0, the mean (Andrew's monotone chain)."""
    hull: list[int] = []
    for i in np.lexsort((y, x)).tolist():
        while len(hull) > 1 and _turns_down(x, y, hull[-2], hull[-1], i):
            hull.pop()
        if not hull or x[i] > x[hull[-1]]:
            hull.append(i)
    right = int(np.searchsorted(x[hull], 0.0))
    right = min(max(right, 1), len(hull) - 1)
    a, b = hull[right - 1], hull[right]
    return float((y[b] - y[a]) / (x[b] - x[a]))


def _turns_down(x: Array, y: Array, a: int, b: int, c: int) -> bool:
    return bool((y[b] - y[a]) * (x[c] - x[b]) >= (y[c] - y[b]) * (x[b] - x[a]))


class ClockEstimator:
    """The same, as stamps come in: the last two minutes, from anew when a clock was set."""

    def __init__(self) -> None:
        self._bins: list[tuple[float, float]] = []  # stamp and arrival of the earliest arrival of each second
        self._clock: Clock | None = None
        self._last = -np.inf
        self._late_since: float | None = None
        self.n_jumps = 0  # how often a clock was set

    @property
    def clock(self) -> Clock | None:
        """The estimate; None before the first stamp."""
        return self._clock

    def add(self, stamp: float, arrival: float) -> bool:
        """Take in a stamp; True where it shows that a clock was set since the one before."""
        is_jump = self._clock is not None and self._has_jumped(self._clock, stamp, arrival)
        if is_jump:
            self._bins, self._late_since = [], None
            self.n_jumps += 1
        self._last = stamp
        if self._bins and stamp - self._bins[-1][0] < _BIN_S and self._same_bin(stamp):
            if arrival - stamp < self._bins[-1][1] - self._bins[-1][0]:
                self._bins[-1] = (stamp, arrival)
                self._fit()
        else:
            self._bins = [*self._bins[-_N_BINS + 1 :], (stamp, arrival)]
            self._fit()
        return is_jump

    def _same_bin(self, stamp: float) -> bool:
        return stamp // _BIN_S == self._bins[-1][0] // _BIN_S

    def _fit(self) -> None:
        pairs = np.array(self._bins)
        self._clock = fit_clock(pairs[:, 0], pairs[:, 1])

    def _has_jumped(self, clock: Clock, stamp: float, arrival: float) -> bool:
        late = arrival - float(clock.arrival(np.array([stamp]))[0])
        if stamp < self._last or late < -_EARLY_S:
            return True
        if late < _LATE_S:
            self._late_since = None
            return False
        if self._late_since is None:
            self._late_since = arrival
        return arrival - self._late_since > _LATE_FOR_S
