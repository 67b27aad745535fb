"""What a benchmark gives: a number with its unit, and the most that it should be."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number; smaller is better."""

    name: str
    value: float
    unit: str
    goal: float | None = None  # at most; None where it is only shown

    @property
    def is_met(self) -> bool:
        """Whether the goal is reached, or there is none."""
        return self.goal is None or self.value <= self.goal
