"""What a session shows of its instruments before anything is associated: a clock that is late, depth taken for range.

Points of successive frames that lie close together, odometry taken out, are pieces of one landmark's history. Within
a piece the landmark stands still, so whatever makes it move depends on the instruments. Two such errors are common,
grow with no landmark's help into metres, and are told apart by their direction:

- odometry is ahead of the camera, or behind, by a constant time: points move across the ray as the vehicle turns;
- a depth was taken for a range (or the reverse): points move along the ray as they wander from the axis, by
  a power of the cosine of the angle between them.

Each is estimated by its own absolute errors (least absolute deviations, as pieces are not pure), and believed only
where the data insist on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize_scalar

from cluster_slam.association.frames import Frames
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, transform
from cluster_slam.records import IntArray

_GATE = 9.0  # chi-square of a step from point to point, three degrees of freedom
_PATIENCE = 5.0  # usual steps for which a piece waits for its next point
_SPAN = 20.0  # usual steps between the points that are compared
_LAG_STEPS = 3.0  # usual steps by which clocks may differ
_MAX_POWER = 2.0  # of the cosine
_LEAST_GAIN = 10.0  # log-likelihood that a correction must bring ...
_N_BLOCKS, _CONTRADICTION = 10, 0.25  # ... and parts of the session may lose so much of what the others gain
_FEWEST_PAIRS, _MOST_PAIRS = 100, 20_000
_SLOW = 2.0  # errors that repeat within a piece are so much larger than those that do not
_N_ROUNDS = 3
_N_RANGES = 6  # parts of equally many pairs, by range


@dataclass(frozen=True, slots=True)
class Calibration:
    """Errors of the instruments: ``lag_s`` by which odometry is ahead, ``power`` of the cosine in ranges.

    A point at distance r and angle a off the axis was given at r cos(a)**power. ``along`` is the factor on the stated
    sigma along the ray that the corrected points ask for at the range ``middle_m``; it grows with the power ``growth``
    of the range, up to one. ``scale_sigma``: pieces tell how ranges depend
    on the angle, not where on the picture they are right, so all lengths may be wrong by the mean correction.
    """

    lag_s: float = 0.0
    power: float = 0.0
    along: float = 1.0
    growth: float = 0.0
    middle_m: float = 1.0
    scale_sigma: float = 0.0

    def in_words(self) -> tuple[str, ...]:
        """What was found to be wrong, for people."""
        when = "later" if self.lag_s > 0 else "earlier"
        late = f"points are stamped {abs(self.lag_s):.2f} s {when} than poses of the same moment"
        taken = f"points lie at their range times the cosine of the angle off the axis to the power {self.power:.2f}"
        found = ((late, self.lag_s), (f"{taken}, as where a depth was taken for a range", self.power))
        return tuple(f"{words}; corrected" for words, size in found if size)

    def correct(self, frames: Frames) -> Frames:
        """The points where they are, with the noise that is left."""
        r = np.linalg.norm(frames.points, axis=1)
        u = frames.points / r[:, None]
        along = np.minimum(self.along * (r / self.middle_m) ** self.growth, 1.0)
        squeeze = np.eye(3) + (along - 1.0)[:, None, None] * u[:, :, None] * u[:, None]
        return replace(
            frames, points=frames.points * self._stretch(frames)[:, None], covs=squeeze @ frames.covs @ squeeze
        )

    def without_growth(self) -> Calibration:
        """The same with the usual noise at all ranges: too wide close by, where sharp points lead a search astray."""
        return replace(self, growth=0.0)

    def _stretch(self, frames: Frames) -> Array:
        cosine = frames.points[:, 2] / np.linalg.norm(frames.points, axis=1)
        stretch: Array = np.clip(cosine, 0.2, 1.0) ** -self.power
        return stretch


def delayed(T: Array, stamps: Array, lag_s: float) -> Array:
    """Poses (n, 4, 4) as they were ``lag_s`` earlier, interpolated."""
    if lag_s == 0.0 or len(T) < 2:
        return T
    t = np.clip(stamps - lag_s, stamps[0], stamps[-1])
    i = np.clip(np.searchsorted(stamps, t, side="right") - 1, 0, len(stamps) - 2)
    share = (t - stamps[i]) / (stamps[i + 1] - stamps[i])
    return np.asarray(T[i] @ se3_exp(share[:, None] * se3_log(inverse(T[i]) @ T[i + 1])))


def calibrate(frames: Frames, given: Array, config: ParticleConfig) -> Calibration:
    """Estimate the errors of the instruments from a session with odometry ``given`` (n, 4, 4)."""
    found = Calibration()
    if not config.calibrate:
        return found
    usual = float(np.median(np.diff(frames.stamps)))
    for _ in range(_N_ROUNDS):
        now = Calibration(found.lag_s, found.power)
        piece = follow_points(now.correct(frames), delayed(given, frames.stamps, found.lag_s), _PATIENCE * usual)
        a, b = pairs_of(frames, piece, _SPAN * usual)
        if len(a) < _FEWEST_PAIRS:
            return Calibration()
        blocks = np.array_split(np.argsort(a, kind="stable"), _N_BLOCKS)
        n = len(np.unique(np.concatenate([a, b])))

        def along(power: float, now: Calibration = now, a: IntArray = a, b: IntArray = b) -> Array:
            return np.abs(_errors(frames, given, replace(now, power=power), a, b)[0])

        power = _believed(along, _MAX_POWER, n, blocks)
        now = replace(now, power=power)

        def across(lag: float, now: Calibration = now, a: IntArray = a, b: IntArray = b) -> Array:
            return _errors(frames, given, replace(now, lag_s=lag), a, b)[1]

        now = replace(now, lag_s=_believed(across, _LAG_STEPS * usual, n, blocks, mirrored=True))
        found = _with_noise_left(frames, given, now, a, b) if power else now
    return replace(found, scale_sigma=abs(float(np.log(found._stretch(frames)).mean())))


def _believed(
    errors: Callable[[float], Array], limit: float, n: int, blocks: list[IntArray], *, mirrored: bool = False
) -> float:
    """Where the mean of absolute errors (k,) is least, if the session insists on it; else zero.

    It must be likelier than nothing by ``_LEAST_GAIN`` (n Laplace errors), and so in all parts of the session: what
    an instrument does wrong it does all the time, while flowers that sway, or impure pieces, look like anything.
    ``mirrored``: nothing is what the opposite correction gives, as it smooths noise just as much (poses between two
    poses are less noisy than both).
    """

    def mean(x: float) -> float:
        return float(errors(x).mean())

    grid = np.linspace(-limit, limit, 25)
    k = int(np.argmin([mean(float(x)) for x in grid]))
    step = grid[1] - grid[0]
    if k in (0, len(grid) - 1):
        return 0.0  # no error of this kind: something else that it would hide
    best = minimize_scalar(mean, bounds=(grid[k] - step, grid[k] + step), method="bounded", options={"xatol": 1e-3})
    nothing = errors(-float(best.x) if mirrored else 0.0)
    gain = 0.5 if mirrored else 1.0
    gain *= n * float(np.log(max(nothing.mean(), 1e-300) / max(float(best.fun), 1e-300)))
    saved = nothing - errors(float(best.x))
    parts = np.array([saved[block].sum() for block in blocks])
    contradicted = -parts[parts < 0].sum() > _CONTRADICTION * parts[parts > 0].sum()
    return float(best.x) if gain > _LEAST_GAIN and not contradicted else 0.0


def _with_noise_left(frames: Frames, given: Array, now: Calibration, a: IntArray, b: IntArray) -> Calibration:
    """The same with the noise along the ray that the spread of corrected points in pieces shows, by range."""
    error = _errors(frames, given, now, a, b)[0]
    r = np.linalg.norm(frames.points[b], axis=1)
    u = frames.points[b] / r[:, None]
    stated = np.sqrt(np.einsum("ni,nij,nj->n", u, frames.covs[b], u))
    parts = np.array_split(np.argsort(r), _N_RANGES)
    middle = np.array([np.median(r[p]) for p in parts])
    factor = 1.4826 / np.sqrt(2.0) * np.array([np.median(np.abs(error[p] / stated[p])) for p in parts])
    growth = float(np.clip(np.polyfit(np.log(middle), np.log(np.maximum(factor, 1e-6)), 1)[0], 0.0, 2.0))
    at = float(np.exp(np.log(middle).mean()))
    along = _SLOW * float(np.exp(np.log(np.maximum(factor, 1e-6)).mean()))
    return replace(now, along=along, growth=growth, middle_m=at)


def _errors(frames: Frames, given: Array, now: Calibration, a: IntArray, b: IntArray) -> tuple[Array, Array]:
    """How far points b are from where points a let them expect, along the ray (signed) and across it, (k,) each."""
    T = delayed(given, frames.stamps, now.lag_s)
    points = now.correct(frames).points
    expected = transform(inverse(T[frames.frame[b]]) @ T[frames.frame[a]], points[a])
    error = points[b] - expected
    u = points[b] / np.linalg.norm(points[b], axis=1)[:, None]
    along = (error * u).sum(axis=1)
    return along, np.linalg.norm(error - along[:, None] * u, axis=1)


def follow_points(frames: Frames, T: Array, patience_s: float) -> IntArray:
    """Piece (m,) of each point: one to one from frame to frame by poses T (n, 4, 4), within a gate."""
    piece = np.full(len(frames), -1)
    ends: list[int] = []
    n_pieces = 0
    for i in range(frames.n_frames):
        ends = [a for a in ends if frames.stamps[i] - frames.stamps[frames.frame[a]] < patience_s]
        here = np.arange(frames.starts[i], frames.starts[i + 1])
        if ends and len(here):
            for row, k in _next_points(frames, T, i, np.array(ends), here):
                piece[here[k]] = piece[ends[row]]
                ends[row] = int(here[k])
        for k in here[piece[here] < 0].tolist():
            piece[k] = n_pieces
            n_pieces += 1
            ends.append(k)
    return piece


def _next_points(frames: Frames, T: Array, i: int, ends: IntArray, here: IntArray) -> list[tuple[int, int]]:
    """Which of the pieces that end in ``ends`` go on in which point of frame i: pairs of rows."""
    expected = transform(inverse(T[i]) @ T[frames.frame[ends]], frames.points[ends])
    error = frames.points[here][None] - expected[:, None]
    white = np.linalg.solve(np.linalg.cholesky(frames.covs[here])[None], error[..., None])[..., 0]
    chi2 = (white * white).sum(axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(chi2, 4.0 * _GATE))
    return [(int(r), int(k)) for r, k in zip(rows, columns, strict=True) if chi2[r, k] < _GATE]


def pairs_of(frames: Frames, piece: IntArray, span_s: float) -> tuple[IntArray, IntArray]:
    """Earlier and later points (k,), (k,) of the same piece, at most ``span_s`` apart."""
    order = np.lexsort((frames.frame, piece))
    p, t = piece[order], frames.stamps[frames.frame[order]]
    early, late = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for k in range(1, len(order)):
        same = (p[k:] == p[:-k]) & (t[k:] - t[:-k] <= span_s)
        if not same.any():
            break
        early.append(order[:-k][same])
        late.append(order[k:][same])
    a, b = np.concatenate(early), np.concatenate(late)
    stride = len(a) // _MOST_PAIRS + 1
    return a[::stride], b[::stride]
