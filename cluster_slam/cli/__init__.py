"""The command line: ``cluster-slam``. Nothing heavy is imported before a command runs."""

from __future__ import annotations

from cluster_slam.cli.app import app, main

__all__ = ["app", "main"]
