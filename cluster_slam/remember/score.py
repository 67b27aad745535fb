"""How good re-identification was, where truth is known: the full confusion, no wrong match left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class Confusion:
    """What became of a session's clusters (or flowers) when they were looked up in a map."""

    right: int = 0  # matched to the same one
    wrong: int = 0  # matched to another one, though the map had it
    missed: int = 0  # the map had it, and it was called new
    joined: int = 0  # the map did not have it, and it was matched all the same
    new: int = 0  # the map did not have it, and it was called new

    def __add__(self, other: Confusion) -> Confusion:
        return Confusion(
            self.right + other.right,
            self.wrong + other.wrong,
            self.missed + other.missed,
            self.joined + other.joined,
            self.new + other.new,
        )

    @property
    def f1(self) -> float:
        """2 right / (claimed + possible): claimed = right + wrong + joined, possible = right + wrong + missed."""
        total = 2 * self.right + 2 * self.wrong + self.joined + self.missed
        return 2 * self.right / total if total else 1.0

    @property
    def wrong_share(self) -> float:
        """Matches that are wrong or falsely joined, of all decisions."""
        total = self.right + self.wrong + self.missed + self.joined + self.new
        return (self.wrong + self.joined) / total if total else 0.0


def confusion(true_ids: IntArray, map_ids: IntArray, is_new: IntArray | BoolArray, known: dict[int, int]) -> Confusion:
    """Score one session, and remember what its new ones are.

    Parameters
    ----------
    true_ids
        (n,) of the session's landmarks; below 0: a ghost, which counts where it was matched and nowhere else.
    map_ids
        (n,) what the map calls them, new ones too.
    is_new
        (n,) whether they were called new.
    known
        True id of each id of the map so far; it is completed with the new ones.
    """
    counts = {"right": 0, "wrong": 0, "missed": 0, "joined": 0, "new": 0}
    there = set(known.values())
    for true, name, new in zip(true_ids.tolist(), map_ids.tolist(), np.asarray(is_new, bool).tolist(), strict=True):
        had = true >= 0 and true in there
        if new:
            counts["missed" if had else "new"] += 1
        elif had:
            counts["right" if known.get(name) == true else "wrong"] += 1
        elif true >= 0 or known.get(name, -1) >= 0:
            counts["joined"] += 1
    for true, name, new in zip(true_ids.tolist(), map_ids.tolist(), np.asarray(is_new, bool).tolist(), strict=True):
        if new:
            known[name] = true
    return Confusion(**counts)
