"""What a cluster looks like wherever it stands: descriptors with mean, covariance and degrees of freedom."""

from cluster_slam.descriptors.geometry import GeometryMatch, match_geometry
from cluster_slam.descriptors.members import block_diagonal, checked_points, isotropic
from cluster_slam.descriptors.moments import (
    closed_form_moments,
    descriptor_moments,
    inertia_and_mean_distance,
    inertia_beta,
    unscented_moments,
)

__all__ = [
    "GeometryMatch",
    "block_diagonal",
    "checked_points",
    "closed_form_moments",
    "descriptor_moments",
    "inertia_and_mean_distance",
    "inertia_beta",
    "isotropic",
    "match_geometry",
    "unscented_moments",
]
