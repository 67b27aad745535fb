"""All options of the methods on one page: default, unit and reason. TOML overrides them; unknown keys are errors."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal, TypeVar

from cluster_slam.errors import ConfigError

GroupingMethod = Literal["spacing", "kmeans", "branch", "none"]


@dataclass(frozen=True, slots=True)
class GroupingConfig:
    """How flowers become clusters."""

    method: GroupingMethod = "spacing"  # average linkage on distance and common motion
    n_clusters: int | None = None  # for "kmeans"
    linkage_m: float | None = None  # where the linkage tree is cut; None: the likeliest cut


@dataclass(frozen=True, slots=True)
class TrackletConfig:
    """Options of the pieces."""

    gate_chi2: float = 16.0  # 3 degrees of freedom: 99.9 % of true matches, the pieces are short
    walk_m_per_sqrt_s: float = 0.002  # random walk of a calm flower; None-zero keeps the filter awake
    max_gap_s: float = 0.3  # a piece survives so long unseen ...
    max_gap_frames: int = 3  # ... or so many frames, whichever is longer
    min_age: int = 3  # observations before a piece helps to find the frame's pose


@dataclass(frozen=True, slots=True)
class TemplateConfig:
    """Options of the clusters' following."""

    gate_chi2: float = 16.0  # 3 degrees of freedom
    landmark_sigma_m: float = 0.0004  # how well a place at rest is known
    rest_accel: float = 0.15  # m/s^2, unmodelled acceleration of a cluster at rest
    sway_hz: float = 1.35  # natural frequency of the spring; wrong by a factor of two is covered by the noise
    sway_spread: float = 0.7  # share of the spring's acceleration that is unknown
    reach_m: float = 0.06  # how far a search looks from rest ...
    reach_unseen_m: float = 0.12  # ... when the cluster was not seen for some frames
    jump_sigma_m: float = 0.025  # a shake's first step
    jump_speed: float = 0.25  # m/s, one sigma of the velocity after a jump
    match_gain: float = 7.0  # log-likelihood of a match over that of clutter, at distance zero
    min_score: float = 6.0  # of an accepted hypothesis
    forget_s: float = 1.3  # unseen for so long: back to rest
    lost_s: float = 0.17  # unseen for so long: it may have jumped
    sway_share: float = 0.02  # of the time in which a cluster is off its rest when it comes into view, before the data


@dataclass(frozen=True, slots=True)
class ParticleConfig:
    """Options of the association where poses drift."""

    calibrate: bool = True  # clocks that differ and depths taken for ranges are found and corrected first
    gap_steps: float = 25.0  # usual steps without a point after which a map of its own begins ...
    fewest_points: int = 30  # ... if so many points are seen before the next one
    n_motions: int = 80  # in a gap that are tried as the beginning of a joint match, beside what odometry says
    n_maps: int = 3  # of what lies between two gaps, drawn independently until two agree, at most
    n_ways: int = 16  # of joining two maps that are smoothed before they are compared
    n_wholes: int = 4  # joined maps that are carried along until later points decide ...
    lead: float = 100.0  # ... if they cost at most so much more than the best, in chi-square
    submap_slack: float = 2.0  # sigmas of places are taken times this when maps are compared: they are bent, too
    n_particles: int = 60  # for a stretch; twice as many after a gap
    n_tries: int = 3  # of a stretch after a gap; the best is kept
    stretch_points: int = 100  # points that are associated before all is smoothed again
    n_redo: int = 3  # passes in which every stretch is associated again, at most
    ahead_points: int = 40  # that are looked at beyond, before a stretch is believed
    odometry_scale: float = 1.5  # stated sigmas of odometry are taken times this ...
    odometry_dof: float = 2.0  # ... and errors of a usual step from Student's t: wheels slip, clocks are late
    point_dof: float = 3.0  # Student's t of points
    wide: float = 4.0  # a point may also fit so many times worse than stated ...
    wide_share: float = 0.1  # ... as this share of them does
    new_share: float = 1e-4  # of points that found a landmark, before the data
    clutter_share: float = 1e-5  # of points that are false
    clutter_cost: float = 20.0  # chi-square at which a point is no landmark's
    growing_cost: float = 20.0  # chi-square that a new landmark must save while the map grows ...
    landmark_cost: float = 40.0  # ... and in the end: errors repeat, so a place that few points like better is none
    merge_reach_m: float = 0.8  # landmarks so close are tried as one


@dataclass(frozen=True, slots=True)
class SmoothConfig:
    """Options of ``smooth``."""

    max_rounds: int = 3  # associate, smooth, associate again: at most so often
    outlier_probability: float = 0.999  # a true match is kept in the smoothing with this probability
    min_observations: int = 8  # of a confirmed flower; fewer where the session has few frames
    tracklets: TrackletConfig = field(default_factory=TrackletConfig)
    follow: TemplateConfig = field(default_factory=TemplateConfig)
    particles: ParticleConfig = field(default_factory=ParticleConfig)
    grouping: GroupingConfig = field(default_factory=GroupingConfig)


@dataclass(frozen=True, slots=True)
class OnlineConfig:
    """Options of ``track``."""

    gate_chi2: float = 16.0  # 3 degrees of freedom
    slack_m: float = 0.0004  # what no covariance of a place tells: petals, rounding, a detector's habits
    confirm_hits: int = 3  # of ...
    confirm_of: int = 5  # ... the last so many looks: then a flower is a landmark
    forget_looks: int = 8  # looks in vain after which a tentative flower is forgotten
    lost_s: float = 2.0  # a cluster unseen for so long is lost (and comes back as itself)
    keyframe_s: float = 0.2  # the map is solved this often
    regroup_s: float = 1.0  # flowers are grouped this often, sooner where new ones were confirmed
    calibrate_s: float = 10.0  # the hand-eye transform is estimated for so long ...
    calibrated_m: float = 0.0005  # ... and until it is known this well (one sigma, all axes together) ...
    calibrated_rad: float = 0.001  # ... and so is its rotation ...
    calibrate_most_s: float = 60.0  # ... or for so long at most; then it is frozen
    undo_s: float = 3.0  # associations can be undone for so long
    follow: TemplateConfig = field(default_factory=TemplateConfig)
    grouping: GroupingConfig = field(default_factory=GroupingConfig)


@dataclass(frozen=True, slots=True)
class GrowthConfig:
    """How plants change over days. Priors: what sessions show corrects them."""

    drift_m_per_day: float = 0.003  # RMS norm of a cluster's drift; wrong by a factor of two is covered
    memory_days: float = 60.0  # after so long a cluster drifts in a direction that has nothing to do with today's
    walk_m_per_sqrt_day: float = 0.0007  # random walk of a cluster, one sigma an axis
    flower_walk_m_per_sqrt_day: float = 0.0005  # of a flower within its cluster
    setting_m: float = 0.0005  # one sigma an axis: how a cluster hangs another time, even on the same day
    flower_setting_m: float = 0.0005  # the same of a flower within its cluster
    size_per_day: float = 0.01  # relative growth of all lengths within a cluster
    size_sigma_per_day: float = 0.01  # of that rate, one sigma, in common to all clusters until it has been learned ...
    size_spread: float = 0.3  # ... and this share of it from cluster to cluster
    lost_per_day: float = 0.02  # share of the flowers
    new_per_day: float = 0.03  # share of the flowers


@dataclass(frozen=True, slots=True)
class MatchConfig:
    """How a session's constellation is matched with a plant's."""

    n_seeds: int = 120  # triples of the session from which poses are guessed
    max_poses: int = 6000  # guesses that are scored
    n_kept: int = 40  # guesses that are looked at closely
    wide: float = 2.5  # drift may also be so many times larger ...
    wide_share: float = 0.25  # ... for this share of the clusters
    seen_share: float = 0.85  # of the flowers that are there, in a session that looked at them
    ghosts: float = 0.15  # false or new flowers beside each cluster, mean
    evidence: float = 1.0  # log of the Bayes factor at which a pose is believed; log of the plants tried on top of it
    margin: float = 6.0  # log of the Bayes factor to the next pose or plant, else it is ambiguous
    scale_min: float = 0.9  # with a similarity: the session's unit of length against the map's
    scale_max: float = 1.1


@dataclass(frozen=True, slots=True)
class PresenceConfig:
    """Whether something is still there when it was not seen."""

    hidden_share: float = 0.1  # of the flowers: not seen in a whole session although it looked there
    cluster_hidden_share: float = 0.15  # of the clusters: hidden as a whole
    min_views: int = 3  # frames that must have had it in view; fewer where the session has few
    present_above: float = 0.5  # presence above this is "present" ...
    gone_below: float = 0.1  # ... and below this "gone"; else "unknown"


@dataclass(frozen=True, slots=True)
class MapConfig:
    """Options of ``map``."""

    growth: GrowthConfig = field(default_factory=GrowthConfig)
    match: MatchConfig = field(default_factory=MatchConfig)
    presence: PresenceConfig = field(default_factory=PresenceConfig)


@dataclass(frozen=True, slots=True)
class LocaliseConfig:
    """Options of ``localise``."""

    sure_probability: float = 0.9999  # a frame is located from here on
    map_prior: float = 0.5  # that a frame shows a plant of the map at all
    min_clusters: int = 2  # one cluster never gives a sure pose
    min_flowers: int = 4  # three points fit three flowers somewhere in any map
    n_triples: int = 24  # of a frame's points, from which poses are guessed: at most
    n_triples_sure: int = 6  # after which a pose that explains a sure share of the points ends the search
    sure_share: float = 0.6  # of the points
    n_guesses: int = 40  # of each triple; four times as many where nothing is sure yet
    n_refined: int = 12  # guesses that are refined with all that is known; five times as many where nothing is sure
    sway_m: float = 0.002  # of a cluster from rest, one sigma an axis, before the session has shown its own
    touched_m: float = 0.02  # how far a cluster swings that was touched of late, one sigma an axis
    sway_time_s: float = 0.3  # correlation time of sway; wrong by a factor of three is felt by few
    detection: float = 0.8  # probability that a flower in view is detected
    unmapped: float = 0.2  # share of the points that the map does not have: false ones, new flowers


_SIGNED = ("_per_day", "evidence", "margin")  # ends of names of options that may be negative ...
_AT_MOST_ONE = ("probability", "share", "_prior", "detection", "unmapped")  # ... and of those up to one
_MAY_BE_NONE = ("n_redo", "n_motions")  # counts that may be zero

C = TypeVar("C")


def override(config: C, values: Mapping[str, Any], where: str = "") -> C:
    """A copy of the configuration with the values of a (nested) mapping, as TOML gives it.

    Raises
    ------
    ConfigError
        An unknown key (with the nearest known one) or a value of the wrong type.
    """
    known = {f.name: f for f in fields(config)}  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{where}{key}"
        if key not in known:
            near = difflib.get_close_matches(key, list(known), 1)
            hint = f"; did you mean {where}{near[0]}?" if near else f"; known: {', '.join(sorted(known))}"
            raise ConfigError(f"unknown option {name}{hint}")
        current = getattr(config, key)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(f"option {name} wants a table, not {value!r}")
            changes[key] = override(current, value, f"{name}.")
        else:
            changes[key] = _checked(name, current, value)
            _check_range(name, changes[key], is_method=type(config).__module__ == __name__)
    return replace(config, **changes)  # type: ignore[type-var]


def _checked(name: str, current: Any, value: Any) -> Any:
    if isinstance(current, bool) or isinstance(value, bool):
        if not (isinstance(value, bool) and isinstance(current, bool)):
            raise ConfigError(f"option {name} wants {type(current).__name__}, not {value!r}")
        return value
    if isinstance(current, float) and isinstance(value, int):
        return float(value)
    if current is not None and value is not None and not isinstance(value, type(current)):
        raise ConfigError(f"option {name} wants {type(current).__name__}, not {value!r}")
    return value


def _check_range(name: str, value: Any, *, is_method: bool) -> None:
    """Refuse numbers that mean nothing: infinite or negative ones, shares above one, and counts of none in a method."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    key = name.rpartition(".")[2]
    if not math.isfinite(value):
        raise ConfigError(f"option {name} wants a finite number, not {value!r}")
    if value < 0 and not key.endswith(_SIGNED):
        raise ConfigError(f"option {name} wants a number from 0, not {value!r}")
    if value > 1 and key.endswith(_AT_MOST_ONE):
        raise ConfigError(f"option {name} wants a number from 0 to 1, not {value!r}")
    if value in (0, 1) and key.endswith("probability"):
        raise ConfigError(f"option {name} wants a number between 0 and 1, not {value!r}")
    if value == 0 and is_method and isinstance(value, int) and key not in _MAY_BE_NONE:
        raise ConfigError(f"option {name} wants a number from 1, not {value!r}")
