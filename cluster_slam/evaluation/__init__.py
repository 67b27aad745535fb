"""A result against the truth."""

from __future__ import annotations

from cluster_slam.evaluation.metrics import Metrics, evaluate

__all__ = ["Metrics", "evaluate"]
