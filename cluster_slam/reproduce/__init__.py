"""The paper's evaluation, run again."""

from cluster_slam.reproduce.paper import reproduce_paper

__all__ = ["reproduce_paper"]
