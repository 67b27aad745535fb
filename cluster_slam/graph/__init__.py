"""The factor graph: the only place that knows GTSAM."""
