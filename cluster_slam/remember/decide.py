"""Which plant a session shows, if any: all plants are tried, and what fits two ways is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.growth import at
from cluster_slam.constellation.match import Match, match
from cluster_slam.constellation.search import glance
from cluster_slam.geometry import Array
from cluster_slam.records import Constellation, PlantMap

FAMILIAR = 2.0  # log odds of a plant that the map has, before looking: most sessions show one
REPEATED = 0.5  # a rival that explains more than this share of the best evidence is a clone, or a repeated structure
HALF = 0.5  # of the session's flowers: where fewer found a partner, its mirror image is tried
OTHER_UNIT = 4.0  # a plant that is so many times as large, or small, as the map's is given in another unit
N_CLOSE = 6  # plants that are matched in full where the map has many ...
TWICE = " (one plant twice, or do they overlap? --plant says which)"
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
    fits: tuple[str, ...]  # plants that fit well enough, best first: more than one where plants overlap

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
    if matches and _is_doubtful(session, matches[0], alone=len(plants) == 1):
        plant = next(p for p in moved if p.name == matches[0].name)
        refusal, reason = _other_hand(session, plant, matches[0], config, similarity) or (refusal, reason)
    accepted = matches[0] if refusal is Refusal.NONE and matches else None
    fits = tuple(m.name for m in matches if m.evidence >= _wanted(config, len(matches)))
    return Decision(matches, probabilities, accepted, refusal, reason, fits)


def _is_doubtful(session: Constellation, best: Match, *, alone: bool) -> bool:
    """Whether most of a session found no partner on the best plant (or on the only one)."""
    if best.found is None or best.found.space.d < 3:
        return alone and best.found is None and len(session.flowers) > 3
    return len(best.found.pairs.a) < HALF * len(session.flowers)


def _other_hand(
    session: Constellation, plant: PlantMap, best: Match, config: MapConfig, similarity: bool
) -> tuple[Refusal, str] | None:
    """A refusal where a session fits a plant clearly better as its mirror image: its frame is left-handed.

    Three flowers are as good as their image: parts of a mirrored plant fit the plant itself.
    """
    mirrored = replace(session, flowers=session.flowers * [1.0, 1.0, -1.0])
    quickly = replace(config.match, evidence=-np.inf)  # no deeper search
    image = match(mirrored, plant, quickly, config.growth, similarity=similarity)
    if image.found is None or image.found.space.d < 3:
        return None
    if image.evidence < max(best.evidence, config.match.evidence) + config.match.margin:
        return None
    text = f"no match: {plant.name} fits the mirror image with a log Bayes factor of {image.evidence:.1f}"
    return Refusal.NO_MATCH, f"{text}, the session itself with {best.evidence:.1f}: is its frame left-handed?"


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


def _wanted(config: MapConfig, n: int) -> float:
    """Log of the Bayes factor at which one of n plants is believed."""
    return config.match.evidence + float(np.log(n))


def _refusal(
    session: Constellation, plants: Sequence[PlantMap], matches: list[Match], config: MapConfig
) -> tuple[Refusal, str]:
    if not matches:
        return Refusal.NO_MATCH, "the map has no plant to align with"
    best, options = matches[0], config.match
    wanted = _wanted(config, len(matches))
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
        is_other = score >= wanted and rival in {m.name for m in matches[1:]}
        return Refusal.AMBIGUOUS, text + (TWICE if is_other else "")
    if best.is_repeated:
        text = f"ambiguous: the clusters' layout fits {best.name} in several ways, and their flowers none well"
        return Refusal.AMBIGUOUS, f"{text} ({best.evidence:.1f}, wanted {wanted:.1f})"
    text = "nothing fits" if not np.isfinite(best.evidence) else f"the best, {fits}"
    few = f"; too few clusters in common, or another plant{_unit(session, plants)}"
    return Refusal.NO_MATCH, f"no match: {text}, wanted {wanted:.1f}{few}"


def _unit(session: Constellation, plants: Sequence[PlantMap]) -> str:
    """What sizes say about the unit of length; nothing where they are alike."""
    size, sizes = _spread(session.flowers), [_spread(p.flowers) for p in plants]
    ratio = size / max(min(sizes, key=lambda s: abs(np.log(max(s, 1e-9) / max(size, 1e-9)))), 1e-9)
    if 1.0 / OTHER_UNIT < ratio < OTHER_UNIT:
        return ""
    return f" (its flowers spread over {ratio:.3g} times what the map has: is it in metres?)"


def _spread(points: Array) -> float:
    """RMS distance from the middle, m."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
