"""Which flowers are one cluster: by spacing and by common motion."""

from cluster_slam.grouping.comotion import Motion
from cluster_slam.grouping.flowers import group_flowers

__all__ = ["Motion", "group_flowers"]
