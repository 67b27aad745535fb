"""The frames of a session, ready to be looked for in a map, and what they tell of the errors in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from cluster_slam.association.depth_noise import powers_of_depth
from cluster_slam.association.frames import sort_by_frame
from cluster_slam.geometry import Array
from cluster_slam.localisation import Localisation, Localiser, sway
from cluster_slam.localisation.following import Follower, Place
from cluster_slam.localisation.learning import Seen, learn_scale
from cluster_slam.localisation.merging import merged_points
from cluster_slam.localisation.motion import Motion
from cluster_slam.localisation.scene import ErrorScale, Look, make_look
from cluster_slam.records import IntArray, Session

_N_LEARNING = 40  # frames from which the errors' scale is learnt, spread over the session
_N_TOGETHER = 10  # frames that tell which plant of many is in view
_N_POSE_LEARNING = 150  # frames in a row from which the given poses' errors are learnt


class Frames:
    """The frames of a session, ready to be looked at; what one frame alone says is found out once."""

    def __init__(self, session: Session, localiser: Localiser) -> None:
        self.session, self.localiser = session, localiser
        self.rows = _rows_of_frames(session)
        ordered = sort_by_frame(session.observations, session.stamps)
        self.scale = replace(localiser.errors, depth_powers=powers_of_depth(ordered))
        self.motion: Motion | None = None  # where frames may be taken together
        self._found: dict[int, Localisation] = {}
        self._plant: int | None = None  # that was seen last

    def look(self, i: int, scale: ErrorScale | None = None) -> Look:
        o, rows = self.session.observations, self.rows[i]
        return make_look(o.points[rows], o.covs[rows], scale or self.scale)

    def search(self, i: int) -> Localisation:
        """The frame by itself, with no prior."""
        if i not in self._found:
            o, rows = self.session.observations, self.rows[i]
            for among in self._plants(i):
                found = self.localiser.locate_points(o.points[rows], o.covs[rows], scale=self.scale, among=among)
                self._found[i] = found
                if found.is_located:
                    self._plant = found.hypotheses[0].plant
                    break
        return self._found[i]

    def _plants(self, i: int) -> Iterator[Sequence[int] | None]:
        """Plants among which a frame is looked for: all of a few; of many the last one, then those that it may show."""
        if self.localiser.atlas is None:
            yield None
            return
        if self._plant is not None:
            yield [self._plant]
        yield self.localiser.likely_plants(self._together(i))

    def _together(self, i: int) -> Array:
        """Points (n, 3) in the camera of frame i: its own, with those of the frames before where motion is known."""
        if self.motion is None:
            return self.look(i).points
        motion, first = self.motion, max(0, i - _N_TOGETHER + 1)
        steps = np.stack([motion.camera_step(i, k, motion.X0) for k in range(first, i + 1)])
        return merged_points([self.look(k) for k in range(first, i + 1)], steps, self.scale.sway_m)

    def learn(self) -> None:
        """How large the errors are, from frames that are located for sure; twice, as gates follow from it."""
        n = self.session.n_frames
        chosen = np.unique(np.linspace(0, n - 1, min(n, _N_LEARNING)).round().astype(np.int64)).tolist()
        for _ in range(2):
            found = [(i, self.search(i)) for i in chosen]
            sure = [(i, f) for i, f in found if f.is_located]
            self._found = {}
            if not sure:
                return
            seen = [
                Seen(self.look(i), self.localiser.plants[f.hypotheses[0].plant], f.hypotheses[0].fit) for i, f in sure
            ]
            before = self.scale
            self.scale = learn_scale(seen, self.scale)
            chosen = [i for i, _ in sure]
            if abs(np.log(self.scale.flower_variance / before.flower_variance)) < 0.3:
                return

    def learn_poses(self, motion: Motion) -> None:
        """How large the errors of the given poses are, from a track through the first frames."""
        n = min(self.session.n_frames, _N_POSE_LEARNING)
        for _ in range(2):
            follower = Follower(self.localiser, motion, self.scale, self.search, self.localiser.config.sway_time_s)
            steps = [
                place.step for i in range(n) if (place := follower.step(i, self.look(i))).reason == "" and place.step
            ]
            observed = sum(s.pose_error_sq for s in steps)
            expected = sum(s.pose_error_sq_expected for s in steps)
            ratio = float(np.clip((observed + 30.0) / (expected + 30.0), 0.1, 10.0))
            self.scale = replace(self.scale, pose_variance=self.scale.pose_variance * ratio)
            if abs(np.log(ratio)) < 0.2:
                return

    def alone(self, i: int) -> Place:
        """Where one frame is, from itself alone."""
        found = self.search(i)
        best = found.hypotheses[0].fit if found.hypotheses else None
        by_touch = np.diag(np.repeat([0.0, sway.unseen_variance(self.scale)], 3))
        return Place(
            found.reason,
            found.plant,
            found.probability,
            None if best is None else best.T_map_camera,
            None if best is None else found.cov + by_touch,
            found.flower_ids,
            found.cluster_ids,
            tuple((h.probability, h.fit.T_map_camera) for h in found.hypotheses),
        )


def _rows_of_frames(session: Session) -> list[IntArray]:
    """Rows of the observations of each frame, in their order."""
    frame = session.observations.frame
    order = np.argsort(frame, kind="stable")
    ends = np.searchsorted(frame[order], np.arange(session.n_frames + 1))
    return [order[a:b] for a, b in pairwise(ends.tolist())]
