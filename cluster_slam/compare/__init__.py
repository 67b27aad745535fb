"""Descriptors held against each other."""

from cluster_slam.compare.run import compare_descriptors

__all__ = ["compare_descriptors"]
