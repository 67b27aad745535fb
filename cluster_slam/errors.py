"""The errors of the application. Each says what the caller can do about it."""

from __future__ import annotations


class ClusterSlamError(Exception):
    """Base of all errors that this package raises on purpose; the message is one line for a person."""


class InputError(ClusterSlamError):
    """Something that came in is wrong: the message names file, row, value and what was expected."""


class ConfigError(ClusterSlamError):
    """An option is unknown or out of its range: the message names the nearest known one or the range."""


class OutputError(ClusterSlamError):
    """The result cannot be written where it was asked for; nothing on disk has been changed."""


class EstimationError(ClusterSlamError):
    """The data do not determine what was asked for; the message says what is missing."""
