"""The errors of this package. Each is also a ValueError, and says which number is wrong and what was expected."""

from __future__ import annotations


class TrackingError(Exception):
    """Base of all errors that this package raises on purpose; the message is one line for a person."""


class ParameterError(TrackingError, ValueError):
    """A parameter is out of its range or an array has the wrong shape."""


class CovarianceError(TrackingError, ValueError):
    """A covariance is not finite, not symmetric or not positive definite."""
