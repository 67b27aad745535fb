"""What a cluster looks like wherever it stands: descriptors with mean, covariance and degrees of freedom."""

from cluster_slam.descriptors.background import Background
from cluster_slam.descriptors.calibration import calibrated_threshold
from cluster_slam.descriptors.geometries import GeometryMatches, match_geometries
from cluster_slam.descriptors.geometry import GeometryMatch, match_geometry
from cluster_slam.descriptors.invariants import (
    InertiaDistance,
    UnscentedDescriptor,
    distance_and_axes,
    distance_axes_descriptor,
    paper_descriptor,
)
from cluster_slam.descriptors.members import block_diagonal, checked_points, isotropic
from cluster_slam.descriptors.moments import (
    carry,
    closed_form_moments,
    descriptor_moments,
    inertia_and_mean_distance,
    inertia_beta,
    unscented_moments,
)
from cluster_slam.descriptors.protocol import (
    Comparison,
    Description,
    Descriptor,
    compare_vectors,
    compare_with_missing,
    subsets,
)
from cluster_slam.descriptors.shape import FullGeometry

DEFAULT_DESCRIPTOR = FullGeometry()  # the one that wins in docs/descriptors.md

__all__ = [
    "DEFAULT_DESCRIPTOR",
    "Background",
    "Comparison",
    "Description",
    "Descriptor",
    "FullGeometry",
    "GeometryMatch",
    "GeometryMatches",
    "InertiaDistance",
    "UnscentedDescriptor",
    "block_diagonal",
    "calibrated_threshold",
    "carry",
    "checked_points",
    "closed_form_moments",
    "compare_vectors",
    "compare_with_missing",
    "descriptor_moments",
    "distance_and_axes",
    "distance_axes_descriptor",
    "inertia_and_mean_distance",
    "inertia_beta",
    "isotropic",
    "match_geometries",
    "match_geometry",
    "paper_descriptor",
    "subsets",
    "unscented_moments",
]
