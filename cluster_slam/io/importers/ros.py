"""A bag as a session: colour, depth, intrinsics, poses and points, each from the topic that fits or was chosen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.importers import ros_images, ros_realsense
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.importers.recording import Imported, ImportOptions, Picture, Stream, choose
from cluster_slam.io.importers.ros_bag import CAMERA_INFO, IMAGES, POINTS, POSES, TF, Bag, seconds
from cluster_slam.io.importers.ros_points import flower_rows
from cluster_slam.io.importers.ros_tf import FLANGES, ODOMETRY, Tree, row_of
from cluster_slam.io.importers.session_files import SessionHead
from cluster_slam.records import PoseError, PoseFrame
from cluster_slam.sensors.camera import Camera
from cluster_slam.sensors.clock import fit_clock

_OTHER_CLOCK_S = 1.0  # stamps so far from their arrival, at the median, are of another clock
_SAME = np.array([0.0, 1.0])


def read_bag(path: Path, options: ImportOptions) -> Imported:
    """What a bag holds, ready to be written.

    Raises
    ------
    InputError
        It cannot be read, a topic is missing, or poses and images do not fit together.
    """
    with Bag(path) as bag:
        chosen = _choose(bag, options)
        warnings: list[str] = []
        frame, frame_stamps, colour_offset, colour_clock = _colour(bag, chosen, warnings)
        if not frame and "flowers" in chosen:
            cloud_stamps, _, frame = bag.stamps(chosen["flowers"])
            frame_stamps = np.unique(cloud_stamps)
        camera = _camera(bag, chosen, options)
        head, stamps, rows, words = _poses(bag, chosen, options, frame, frame_stamps, warnings)
        flowers = flower_rows(bag, chosen["flowers"]) if "flowers" in chosen else None
        scale = options.depth_scale or ros_realsense.depth_scale(bag) or _scale_of(bag, chosen.get("depth"))
        register = None
        if camera is not None and "depth" in chosen and "colour" in chosen:
            register = ros_realsense.registration(bag, chosen["colour"], chosen["depth"], camera, scale)
        depth_offset, depth_clock = _clock_of(bag, chosen["depth"], []) if "depth" in chosen else (_SAME, None)
        streams = tuple(replace(s, role=_role(chosen, s.name) or _tf_role(s, words)) for s in bag.streams())
    return Imported(
        "ROS 1 bag" if path.suffix == ".bag" else "ROS 2 bag",
        streams,
        replace(head, depth_scale=scale if "depth" in chosen else None),
        stamps,
        rows,
        frame_stamps,
        camera,
        _pictures(path, chosen.get("colour"), colour_clock, colour_offset),
        _pictures(path, chosen.get("depth"), depth_clock, depth_offset),
        flowers,
        register,
        tuple(warnings),
    )


def bag_streams(path: Path, options: ImportOptions) -> list[Stream]:
    """The topics of a bag and the roles that they would have."""
    with Bag(path) as bag:
        chosen = _choose(bag, options)
        return [replace(s, role=_role(chosen, s.name)) for s in bag.streams()]


def _tf_role(stream: Stream, words: str) -> str:
    return words if stream.kind == TF and "static" not in stream.name else ""


def _role(chosen: dict[str, str], topic: str) -> str:
    return next((role for role, name in chosen.items() if name == topic), "")


def _choose(bag: Bag, options: ImportOptions) -> dict[str, str]:
    """The topic for each role that has one."""
    images = bag.topics(IMAGES)
    depths = sorted((t for t in images if "depth" in t.lower()), key=_depth_rank)
    colours = sorted((t for t in images if "depth" not in t.lower()), key=_colour_rank)
    usable = [t for t in colours if "infra" not in t.lower()]
    chosen = {
        "colour": choose(bag.path, "colour", options.colour, images, usable),
        "depth": choose(bag.path, "depth", options.depth, images, depths),
    }
    infos = bag.topics([CAMERA_INFO])
    beside = sorted(infos, key=lambda t: -_common(t, chosen["colour"] or chosen["depth"] or ""))
    chosen["camera"] = choose(bag.path, "camera info", options.camera_info, infos, beside)
    poses = sorted(bag.topics(POSES), key=_pose_rank)
    is_tf = options.pose is not None and ">" in options.pose
    chosen["pose"] = None if is_tf else choose(bag.path, "pose", options.pose, poses, poses)
    points = [t for t in bag.topics([POINTS]) if "flower" in t.lower()]
    chosen["flowers"] = choose(bag.path, "points", options.flowers, bag.topics([POINTS]), points)
    return {role: topic for role, topic in chosen.items() if topic is not None}


def _depth_rank(topic: str) -> tuple[bool, bool, str]:
    return "aligned" not in topic, "compressed" in topic and "device_" not in topic, topic


def _colour_rank(topic: str) -> tuple[bool, bool, str]:
    lower = topic.lower()
    return not ("color" in lower or "colour" in lower or "rgb" in lower), "compressed" in lower, topic


def _pose_rank(topic: str) -> tuple[int, str]:
    lower = topic.lower()
    words = ("camera", "tcp", "pose", "odom")
    return next((i for i, word in enumerate(words) if word in lower), len(words)), topic


def _common(a: str, b: str) -> int:
    """How many parts of two topics' names agree from the left."""
    pairs = zip(a.split("/"), b.split("/"), strict=False)
    return next((i for i, (x, y) in enumerate(pairs) if x != y), min(a.count("/"), b.count("/")) + 1)


def _colour(
    bag: Bag, chosen: dict[str, str], warnings: list[str]
) -> tuple[str, Array | None, Array, dict[float, float] | None]:
    """The frame of the colour images, their stamps, and how they come about: offset and clock."""
    if "colour" not in chosen:
        return "", None, _SAME, None
    frame = bag.stamps(chosen["colour"])[2]
    offset, clock = _clock_of(bag, chosen["colour"], warnings)
    stamps = np.array(list(clock.values())) if clock is not None else bag.stamps(chosen["colour"])[0]
    return frame, offset[0] + offset[1] * stamps, offset, clock


def _clock_of(bag: Bag, topic: str, warnings: list[str]) -> tuple[Array, dict[float, float] | None]:
    """Offset and rate (2,) that bring a topic's stamps to the bag's clock; stamps by arrival where not the headers'."""
    known = ros_realsense.metadata_stamps(bag, topic)
    if known is not None:
        return _SAME, known
    stamps, arrivals, _ = bag.stamps(topic)
    late = float(np.median(arrivals - stamps)) if len(stamps) else 0.0
    if abs(late) < _OTHER_CLOCK_S or arrivals[0] < 1e6:  # a bag whose own time begins at 0 knows no better
        return _SAME, None
    clock = fit_clock(stamps, arrivals)
    warnings.append(f"{topic}: its clock is {late:.3f} s from the bag's; drift {1e6 * clock.drift:.1f} ppm taken out")
    zero = float(clock.arrival(np.zeros(1))[0])
    return np.array([zero, 1.0 + clock.drift]), None


def _camera(bag: Bag, chosen: dict[str, str], options: ImportOptions) -> Camera | None:
    if options.camera_file is not None:
        return read_camera(options.camera_file)
    if "camera" in chosen:
        for _, _, info in bag.messages([chosen["camera"]]):
            return ros_images.camera_of_info(f"{bag.path}: {chosen['camera']}", info)
    if "colour" in chosen or "depth" in chosen:
        raise InputError(f"{bag.path}: no intrinsics (no topic of {CAMERA_INFO}), expected --camera FILE.yaml")
    return None


def _scale_of(bag: Bag, topic: str | None) -> float:
    """Metres per unit of a depth topic by ROS's conventions (REP 118): millimetres, or metres as floats."""
    if topic is not None:
        for _, _, message in bag.messages([topic]):
            is_float = getattr(message, "encoding", "") == "32FC1"
            return ros_images.DEPTH_METRES_SCALE if is_float else 0.001
    return 0.001


def _poses(
    bag: Bag,
    chosen: dict[str, str],
    options: ImportOptions,
    frame: str,
    frame_stamps: Array | None,
    warnings: list[str],
) -> tuple[SessionHead, Array, Array, str]:
    """What ``session.toml`` says of the poses, their stamps (p,) and rows (p, 7), and what tf is used for, in words."""
    head = SessionHead(options.id or bag.path.stem, options.plant, source=f"imported from {bag.path.name}")
    if options.is_still:
        stamps = np.unique(frame_stamps) if frame_stamps is not None else np.zeros(0)
        return head, stamps, np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(stamps), 1)), ""
    if options.poses_file is not None:
        stamps, rows, pose_frame, more = read_pose_file(options.poses_file, options.time_offset_s)
        warnings += more
        return _with_frame(head, options, pose_frame, None), stamps, rows, ""
    tf = _from_tf(bag, options, frame)
    if tf is not None and (options.pose is None or ">" in options.pose):
        stamps, rows, pose_frame, hand_eye, error, words = tf
        chosen.pop("pose", None)
        return _with_frame(replace(head, pose_error=error), options, pose_frame, hand_eye), stamps, rows, words
    if "pose" not in chosen:
        expected = "expected tf to the camera's frame, a pose topic, --poses FILE or --still"
        raise InputError(f"{bag.path}: no poses in {len(bag.streams())} topics, {expected}")
    topic = chosen["pose"]
    stamps, rows = _from_topic(bag, topic, warnings)
    guess: PoseFrame = "T_world_flange" if "tcp" in topic.lower() else "T_world_camera"
    odometry: PoseError = "odometry" if "Odometry" in bag.kind(topic) else "absolute"
    head = _with_frame(replace(head, pose_error=odometry), options, guess, None)
    return head, stamps + options.time_offset_s, rows, ""


def _with_frame(head: SessionHead, options: ImportOptions, guess: PoseFrame, hand_eye: Array | None) -> SessionHead:
    """The head with what the poses are of; a hand-eye transform that nobody knows has wide sigmas."""
    frame = options.pose_frame or guess
    if frame == "T_world_camera":
        return replace(head, pose_frame=frame)
    known = options.T_flange_camera if options.T_flange_camera is not None else hand_eye
    if known is not None:
        return replace(head, pose_frame=frame, T_flange_camera=known)
    unknown = np.array([0.0, 0, 0, 0, 0, 0, 1])
    return replace(head, pose_frame=frame, T_flange_camera=unknown, hand_eye_sigmas=(1.0, 3.0))


def _from_tf(
    bag: Bag, options: ImportOptions, frame: str
) -> tuple[Array, Array, PoseFrame, Array | None, PoseError, str] | None:
    """Poses of the flange where one is known above the camera, else of the camera; None where tf has neither."""
    topics = bag.topics([TF])
    tree = Tree(bag, topics) if topics else None
    if tree is None:
        return None
    if options.pose is not None and ">" in options.pose:
        root, _, target = options.pose.partition(">")
        path = tree.path(root.strip(), target.strip())
    else:
        known = [name for name in (frame, *FLANGES) if name in tree.edges and tree.moves(name)]
        if not known:
            return None
        above = [name for name in tree.chain(known[0]) if name in FLANGES and tree.static(known[0], name) is not None]
        target = above[0] if above else known[0]
        path = tree.path(tree.chain(target)[-1], target)
    is_flange = path.frame in FLANGES
    hand_eye = tree.static(frame, path.frame) if is_flange and frame in tree.edges else None
    error: PoseError = "odometry" if path.root in ODOMETRY else "absolute"
    pose_frame: PoseFrame = "T_world_flange" if is_flange else "T_world_camera"
    words = f"pose ({path.frame} in {path.root})"
    return path.stamps + options.time_offset_s, path.rows, pose_frame, hand_eye, error, words


def _from_topic(bag: Bag, topic: str, warnings: list[str]) -> tuple[Array, Array]:
    offset, _ = _clock_of(bag, topic, warnings)
    found = []
    for _, _, message in bag.messages([topic]):
        found.append([offset[0] + offset[1] * seconds(message.header.stamp), *_row(message)])
    rows = np.array(found)
    stamps, first = np.unique(rows[:, 0], return_index=True)
    return stamps, rows[first, 1:]


def _row(message: Any) -> list[float]:
    """``tx ty tz qx qy qz qw`` of a message that holds a pose."""
    if hasattr(message, "transform"):
        return row_of(message.transform.translation, message.transform.rotation)
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return row_of(pose.position, pose.orientation)


def _pictures(
    path: Path, topic: str | None, clock: dict[float, float] | None, offset: Array
) -> Callable[[], Iterator[Picture | str]] | None:
    if topic is None:
        return None

    def read() -> Iterator[Picture | str]:
        with Bag(path) as bag:
            yield from ros_images.pictures(bag, topic, clock, offset)

    return read
