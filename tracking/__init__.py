"""Estimation over time: gates, assignment, filters and metrics on points. Knows no camera, no flower, no file."""
