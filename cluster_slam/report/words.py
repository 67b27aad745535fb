"""Figures as people read them: lengths, angles, shares, counts, and plain words for the reasons of a rejection."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cluster_slam.records import RejectReason

_STEPS = ((1e-5, 1e6, "µm"), (0.1, 1e3, "mm"), (1.0, 1e2, "cm"))


@dataclass(frozen=True, slots=True)
class ReasonWords:
    """A reason in a few words, and in a sentence."""

    short: str
    sentence: str


REASON_WORDS = {
    RejectReason.ACCEPTED: ReasonWords("accepted", "Matched to a flower of the map."),
    RejectReason.POSITION_GATE: ReasonWords(
        "nothing there", "No flower of the map was near enough to have caused this detection."
    ),
    RejectReason.DESCRIPTOR_GATE: ReasonWords(
        "wrong shape", "The size and spread of the group did not fit the cluster at this place."
    ),
    RejectReason.GEOMETRY_GATE: ReasonWords(
        "wrong layout", "The flowers of the group did not lie to each other as those of the cluster do."
    ),
    RejectReason.TAKEN: ReasonWords("taken", "Another detection of the same picture fits that flower better."),
    RejectReason.UNCONFIRMED: ReasonWords(
        "seen too rarely", "It was seen too few times to be believed to be a flower."
    ),
    RejectReason.OUTLIER: ReasonWords(
        "outlier", "It was matched to a flower at first, but did not fit once everything was solved together."
    ),
}


def length(metres: float) -> str:
    """A length with two digits in a fitting unit: ``0.34 mm``, ``13 cm``, ``2.3 m``."""
    if not math.isfinite(metres):
        return "unknown"
    if abs(metres) < 1e-9:
        return "0 mm"
    factor, unit = next(((f, u) for below, f, u in _STEPS if abs(metres) < below), (1.0, "m"))
    return f"{digits(metres * factor)} {unit}"


def angle(radians: float) -> str:
    """An angle in degrees with two digits."""
    return f"{digits(math.degrees(radians))}°"


def digits(value: float) -> str:
    """A number with at least two significant digits and no exponent."""
    size = abs(value)
    if not math.isfinite(value):
        return "unknown"
    if size < 1e-9:
        return "0"
    decimals = max(0, 1 - math.floor(math.log10(float(f"{size:.1e}"))))
    return f"{value:,.{min(decimals, 6)}f}"


def share(part: int, whole: int) -> str:
    """A share in per cent: ``6.8 %``; ``0 %`` of nothing."""
    percent = 100.0 * part / whole if whole else 0.0
    return f"{digits(percent)} %" if percent < 99.95 or part == whole else "99.9 %"


def count(n: int, noun: str, plural: str | None = None) -> str:
    """A number with its noun: ``1 flower``, ``1,240 flowers``."""
    return f"{n:,} {noun if n == 1 else plural or noun + 's'}"


def duration(seconds: float) -> str:
    """A span of time: ``12.3 s``, ``4 min 10 s``, ``2 h 5 min``."""
    if seconds < 90:
        return f"{digits(seconds)} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 90:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"
