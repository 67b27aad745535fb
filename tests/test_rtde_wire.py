"""RTDE on the wire, fields, faults and motions: by hand."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_slam.errors import ConfigError, InputError
from cluster_slam.geometry import so3_exp
from cluster_slam.sensors.rtde.faults import KINDS, Fault, parse_fault
from cluster_slam.sensors.rtde.fields import default_of, type_of
from cluster_slam.sensors.rtde.motion import Motion, motion_of_poses
from cluster_slam.sensors.rtde.wire import FORMATS, N_VALUES, Package, PackageReader, Recipe, pack


def test_a_package_by_hand() -> None:
    assert pack(Package.REQUEST_PROTOCOL_VERSION, b"\x00\x02") == b"\x00\x05V\x00\x02"
    assert pack(Package.START) == b"\x00\x03S"


def test_a_data_package_by_hand() -> None:
    recipe = Recipe(7, ["timestamp", "robot_mode", "payload_cog"], ["DOUBLE", "INT32", "VECTOR3D"])
    package = recipe.data([1.5, -2, [1.0, 2.0, 4.0]])
    assert package == b"\x00\x28U\x07" + struct.pack(">d", 1.5) + b"\xff\xff\xff\xfe" + struct.pack(">3d", 1, 2, 4)
    assert recipe.values(package[3:]) == {"timestamp": 1.5, "robot_mode": -2, "payload_cog": (1.0, 2.0, 4.0)}


@given(
    st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=40)), max_size=8),
    st.lists(st.integers(0, 300), max_size=10),
)
def test_packages_survive_any_cut(packages: list[tuple[int, bytes]], cuts: list[int]) -> None:
    stream = b"".join(pack(kind, payload) for kind, payload in packages)
    places = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    reader = PackageReader()
    found = [one for a, b in pairwise(places) for one in reader.feed(stream[a:b])]
    assert found == packages


def test_a_header_that_lies_is_refused() -> None:
    with pytest.raises(InputError, match="2 bytes"):
        PackageReader().feed(b"\x00\x02S")


def test_fields_have_the_types_of_the_guide() -> None:
    kinds = {
        "timestamp": "DOUBLE",
        "actual_TCP_pose": "VECTOR6D",
        "joint_mode": "VECTOR6INT32",
        "actual_digital_input_bits": "UINT64",
        "safety_status_bits": "UINT32",
        "output_int_register_47": "INT32",
        "output_double_register_0": "DOUBLE",
        "output_bit_register_127": "BOOL",
        "tool_output_mode": "UINT8",
    }
    assert {name: type_of(name) for name in kinds} == kinds
    for name in ("output_int_register_48", "output_bit_register_63", "actual_tcp_pose", ""):
        assert type_of(name) is None


@pytest.mark.parametrize("name", ["timestamp", "actual_q", "joint_mode", "robot_mode", "payload_cog"])
def test_defaults_fit_their_types(name: str) -> None:
    kind = type_of(name)
    assert kind is not None
    Recipe(1, [name], [kind]).data([default_of(name)])
    assert set(N_VALUES) < set(FORMATS)


def test_faults_are_read() -> None:
    assert parse_fault("stall:2.5@10") == Fault("stall", 2.5, "", 10.0)
    assert parse_fault("reset") == Fault("reset", 0.0, "", 0.0)
    assert parse_fault("unknown:actual_q@3") == Fault("unknown", 0.0, "actual_q", 3.0)
    assert parse_fault("skew:-80") == Fault("skew", -80.0)
    assert all(parse_fault(f"{kind}:1").kind == kind for kind in KINDS)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("stal:1", "did you mean stall"),
        ("xyz", "known: drop"),
        ("stall:abc", "a number"),
        ("drop:-1", "seconds from 0"),
        ("drop@never", "a time in seconds"),
        ("unknown", "name of a field"),
        ("stall:nan", "a number"),
    ],
)
def test_wrong_faults_are_refused(text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        parse_fault(text)


def test_a_motion_between_its_poses() -> None:
    """Half way of a turn by 3 rad about z and 0.2 m along x; a whole number keeps its last value."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = so3_exp(np.array([0.0, 0.0, 3.0]))
    poses[1, 0, 3] = 0.2
    motion = motion_of_poses(np.array([5.0, 7.0]), poses)
    assert motion.value("actual_TCP_pose", 1.0) == pytest.approx([0.1, 0, 0, 0, 0, 1.5])
    assert motion.value("actual_TCP_pose", 99.0) == pytest.approx([0.2, 0, 0, 0, 0, 3.0])
    assert motion.value("actual_q", 0.0) is None
    modes = Motion(np.array([0.0, 1.0]), {"robot_mode": np.array([[7.0], [5.0]])})
    assert [modes.value("robot_mode", t) for t in (0.0, 0.9, 1.0)] == [7, 7, 5]


def test_a_motion_goes_back() -> None:
    motion = Motion(np.array([0.0, 2.0]), {"payload": np.array([[0.0], [4.0]])}, goes_back=True)
    assert [motion.value("payload", t) for t in (1.0, 2.0, 3.0, 4.0, 5.5)] == [2.0, 4.0, 2.0, 0.0, 3.0]


def test_a_turn_through_pi_has_no_jump() -> None:
    """Rotation vectors change sign at half a turn; the rotation between them must not."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, :3, :3] = so3_exp(np.array([0.0, 0.0, np.pi - 0.1]))
    poses[1, :3, :3] = so3_exp(np.array([0.0, 0.0, -np.pi + 0.1]))
    value = motion_of_poses(np.array([0.0, 1.0]), poses).value("actual_TCP_pose", 0.5)
    assert isinstance(value, list)
    assert abs(value[5]) == pytest.approx(np.pi)


def test_nothing_here_commands_an_arm() -> None:
    """No module imports the client's writing interfaces."""
    root = Path(__file__).parents[1]
    for path in [*(root / "cluster_slam").rglob("*.py"), *(root / "tracking").rglob("*.py")]:
        text = path.read_text()
        for name in ("rtde_control", "rtde_io", "dashboard_client", "script_client"):
            assert name not in text, path
