"""How well a statistic tells true pairs from false ones; small values mean a match."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array

RECALL = 0.95


def false_match_rate(genuine: Array, impostor: Array, recall: float = RECALL) -> float:
    """Share of false pairs at or below the value that this share of true pairs stays below."""
    threshold = np.sort(genuine)[max(int(np.ceil(recall * len(genuine))) - 1, 0)]
    return float(np.mean(impostor <= threshold)) if np.isfinite(threshold) else 1.0


def equal_error_rate(genuine: Array, impostor: Array) -> float:
    """Where the share of true pairs refused is the share of false pairs accepted."""
    false_rate, recall = roc(genuine, impostor)
    k = int(np.argmin(np.abs(1.0 - recall - false_rate)))
    return float(0.5 * (1.0 - recall[k] + false_rate[k]))


def roc(genuine: Array, impostor: Array) -> tuple[Array, Array]:
    """False match rate and recall (n,) for every threshold, increasing."""
    thresholds = np.unique(np.concatenate([genuine, impostor]))
    recall = np.searchsorted(np.sort(genuine), thresholds, side="right") / len(genuine)
    false_rate = np.searchsorted(np.sort(impostor), thresholds, side="right") / len(impostor)
    return false_rate, recall


def rank_1(table: Array) -> float:
    """Share of columns whose smallest entry, if it is finite and single, is on the diagonal (n, n)."""
    n = len(table)
    own = table[np.arange(n), np.arange(n)]
    others = table + np.where(np.eye(n, dtype=bool), np.inf, 0.0)
    return float(np.mean(own < others.min(0)))
