"""``python -m cluster_slam.cli``."""

from cluster_slam.cli.app import main

main()
