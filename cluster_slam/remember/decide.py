"""Which plant a session shows, if any: all plants are tried, and what fits two ways is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.growth import at
from cluster_slam.constellation.match import Match, glance, match
from cluster_slam.geometry import Array
from cluster_slam.records import Constellation, PlantMap

FAMILIAR = 2.0  # log odds of a plant that the map has, before looking: most sessions show one
REPEATED = 0.5  # a rival that explains more than this share of the best evidence is a clone, or a repeated structure
N_CLOSE = 6  # plants that are matched in full where the map has many ...
COMES_NEAR = 0.3  # ... the best two at a glance, and those that reach this share of the best one's score


class Refusal(StrEnum):
    """Why a session was not taken for a plant of the map."""

    NONE = ""
    TOO_FEW = "too few clusters in common"
    NO_MATCH = "no match"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What came of matching a session with plants."""

    matches: list[Match]  # best first
    probabilities: Array  # of each match
    accepted: Match | None
    refusal: Refusal
    reason: str  # for a person

    @property
    def probability(self) -> float:
        """Of the accepted match; 0 without one."""
        return float(self.probabilities[0]) if self.accepted is not None else 0.0


def decide(
    session: Constellation,
    plants: Sequence[PlantMap],
    config: MapConfig,
    *,
    similarity: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> Decision:
    """Match a session with plants as the map holds them, and decide."""
    say = progress or (lambda _stage, _fraction: None)
    moved = [at(plant, session.start, config.growth) for plant in plants]
    closely = _worth_a_look(session, moved, config, similarity, say)
    matches = []
    for k, plant in enumerate(moved):
        if k in closely:
            say(f"aligning with {plant.name}", 0.5 + 0.5 * k / len(moved))
            matches.append(match(session, plant, config.match, config.growth, similarity=similarity))
        else:
            matches.append(Match(plant.name, 0.0, -np.inf, -np.inf, False))
    matches.sort(key=lambda m: -m.evidence)
    probabilities = _probabilities(matches)
    refusal, reason = _refusal(session, plants, matches, config)
    accepted = matches[0] if refusal is Refusal.NONE and matches else None
    return Decision(matches, probabilities, accepted, refusal, reason)


def _worth_a_look(
    session: Constellation,
    plants: Sequence[PlantMap],
    config: MapConfig,
    similarity: bool,
    say: Callable[[str, float], None],
) -> set[int]:
    """The plants that are matched in full: all of a few, the best at a glance of many."""
    if len(plants) <= 2 * N_CLOSE:
        return set(range(len(plants)))
    scores = []
    for k, plant in enumerate(plants):
        say(f"glancing at {plant.name}", 0.5 * k / len(plants))
        scores.append(glance(session, plant, config.match, similarity=similarity))
    order = np.argsort(-np.array(scores), kind="stable")[:N_CLOSE].tolist()
    return {k for n, k in enumerate(order) if n < 2 or scores[k] > COMES_NEAR * scores[order[0]]}


def _probabilities(matches: list[Match]) -> Array:
    """Posterior of each match's best pose among all poses of all plants, and none."""
    if not matches:
        return np.zeros(0)
    each = np.array([m.evidence for m in matches]) + FAMILIAR - np.log(len(matches))
    others = np.array([m.runner_up for m in matches]) + FAMILIAR - np.log(len(matches))
    total = np.logaddexp.reduce(np.concatenate([[0.0], each, others]))
    posterior: Array = np.exp(each - total)
    return posterior


def _refusal(
    session: Constellation, plants: Sequence[PlantMap], matches: list[Match], config: MapConfig
) -> tuple[Refusal, str]:
    if not matches:
        return Refusal.NO_MATCH, "the map has no plant to align with"
    best, options = matches[0], config.match
    wanted = options.evidence + np.log(len(matches))
    n = min(len(session.flowers), max(len(p.flowers) for p in plants))
    if n < 3:
        return Refusal.TOO_FEW, f"too few flowers ({n}) to align by, at least 3 are needed"
    rivals = [(f"another pose on {best.name}", best.runner_up), *((m.name, m.evidence) for m in matches[1:])]
    rival, score = max(rivals, key=lambda r: r[1])
    fits = f"{best.name} fits with a log Bayes factor of {best.evidence:.1f}"
    margin = max(options.margin, REPEATED * best.evidence)
    if best.evidence >= wanted and best.evidence - score >= margin:
        return Refusal.NONE, fits
    if best.evidence >= wanted:
        text = f"ambiguous: {fits}, {rival} with {score:.1f}; they must differ by {margin:.1f}"
        return Refusal.AMBIGUOUS, text
    if best.is_repeated:
        text = f"ambiguous: the clusters' layout fits {best.name} in several ways, and their flowers none well"
        return Refusal.AMBIGUOUS, f"{text} ({best.evidence:.1f}, wanted {wanted:.1f})"
    text = "nothing fits" if not np.isfinite(best.evidence) else f"the best, {fits}"
    few = "; too few clusters in common, or another plant"
    return Refusal.NO_MATCH, f"no match: {text}, wanted {wanted:.1f}{few}"
