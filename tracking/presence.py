"""Is it still there? Presence of members of a group, fed by looks that may have been in vain.

Each member is lost at a constant rate (persistence filter, Rosen, Mason, Leonard, "Towards lifelong feature-based
mapping in semi-static environments", 2016); members of a group are hidden together. What was not looked at does not
change.
"""

from __future__ import annotations

import numpy as np

from tracking.gaussian import Array

FLOOR = 1e-6


def persisted(presence: Array, loss_rate: float, dt: Array | float) -> Array:
    """Presence after a time dt without a look; ``loss_rate`` is the share that is lost in one unit of it."""
    out: Array = presence * np.exp(np.log1p(-loss_rate) * np.maximum(dt, 0.0))
    return out


def after_miss(presence: Array, detection: Array | float) -> Array:
    """Presence of members that were looked at and not seen, each for itself.

    Bayes: p (1 - d) / (1 - p d) with the probability d that it is seen if it is there.
    """
    out: Array = np.maximum(presence * (1.0 - detection) / (1.0 - presence * detection), FLOOR)
    return out


def after_group_miss(presence: Array, detection: Array | float, hidden: float) -> Array:
    """Presence of a group's members (n,) of which none was seen: hidden all together, or missed one by one.

    With h the probability that the whole group is hidden, and m = prod(1 - p d) that a group in sight is missed:
    w = h / (h + (1 - h) m), and p becomes w p + (1 - w) p (1 - d) / (1 - p d).
    """
    missed = float(np.prod(1.0 - presence * detection))
    whole = hidden / (hidden + (1.0 - hidden) * missed)
    out: Array = whole * presence + (1.0 - whole) * after_miss(presence, detection)
    return out


def any_present(presence: Array) -> float:
    """Probability that at least one of a group's members (n,) is there."""
    return float(1.0 - np.prod(1.0 - presence))
