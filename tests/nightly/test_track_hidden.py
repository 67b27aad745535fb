"""Clusters hidden for ten seconds while their neighbours sway come back as themselves."""

from __future__ import annotations

import pytest
from tables import Tables
from tracked import hidden

SEEDS = range(320, 324)  # some 50 trials; range(320, 345) are more than 300


@pytest.mark.nightly
def test_hidden_for_ten_seconds(add_row: Tables) -> None:
    trials = [came_back for seed in SEEDS for came_back in hidden(seed)]
    add_row("track-hidden", trials=len(trials), as_themselves=sum(trials), share=sum(trials) / len(trials))
    assert len(trials) > 30
    assert len(trials) - sum(trials) <= max(1, 0.01 * len(trials))
