"""Experiments: sweeps over worlds and options, over seeds, in parallel, resumable; one tidy table."""

from cluster_slam.experiment.plan import Experiment, read_experiment
from cluster_slam.experiment.run import run_experiment

__all__ = ["Experiment", "read_experiment", "run_experiment"]
