"""Which frame a row of a table belongs to."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.io.tables import Table, check_stamps
from cluster_slam.records import IntArray

STAMP_TOLERANCE = 1e-6  # s; a row belongs to the frame whose stamp agrees within this


def tolerance(stamps: Array) -> Array:
    """How far (n,) a stamp may be off, in seconds, with what two decimal stamps lose as float64."""
    return STAMP_TOLERANCE + np.spacing(np.abs(stamps))


def frames_of(table: Table, stamps: Array) -> IntArray:
    """Index of the frame (m,) of each row, by its stamp.

    Raises
    ------
    InputError
        A row belongs to no frame.
    """
    check_stamps(table)
    times = table.columns["timestamp"]
    after = np.clip(np.searchsorted(stamps, times), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(stamps[after] - times) <= np.abs(stamps[before] - times), after, before)
    off = np.abs(stamps[nearest] - times)
    lost = off > tolerance(times)
    if lost.any():
        k = int(lost.argmax())
        text = f"timestamp {times[k]!s} belongs to no frame of poses.txt (nearest {stamps[nearest[k]]!s})"
        raise table.refuse(k, f"{text}, expected one within 1 microsecond")
    return nearest.astype(np.int64)
