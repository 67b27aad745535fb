"""From pixels and depths to flowers: 3-D points in the camera frame with their covariance."""

from cluster_slam.lift.boxes import LiftedBoxes, lift_boxes
from cluster_slam.lift.points import Convention, lift, lift_unscented

__all__ = ["Convention", "LiftedBoxes", "lift", "lift_boxes", "lift_unscented"]
