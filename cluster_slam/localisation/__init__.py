"""Where am I: poses in a frozen map of clusters, with no prior at all, and how sure they are."""

from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.localiser import Localisation, Localiser

__all__ = ["Landmarks", "Localisation", "Localiser"]
