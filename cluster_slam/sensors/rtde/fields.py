"""Output fields of a controller: the type of each, and its value where nothing says another."""

from __future__ import annotations

import re

from cluster_slam.sensors.rtde.wire import N_VALUES, Value

_NAMES = {
    "DOUBLE": """timestamp actual_execution_time target_execution_time speed_scaling target_speed_fraction
        actual_momentum actual_main_voltage actual_robot_voltage actual_robot_current actual_robot_energy_consumed
        actual_robot_braking_energy_dissipated standard_analog_input0 standard_analog_input1 standard_analog_output0
        standard_analog_output1 io_current euromap67_24V_voltage euromap67_24V_current tool_analog_input0
        tool_analog_input1 tool_output_current tool_temperature tcp_force_scalar joint_position_deviation_ratio
        collision_detection_ratio payload""",
    "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
        actual_current_window actual_current_as_torque joint_control_output actual_TCP_pose actual_TCP_speed
        actual_TCP_force target_TCP_pose target_TCP_speed tcp_offset joint_temperatures actual_joint_voltage
        ft_raw_wrench wrench_calc_from_currents payload_inertia""",
    "VECTOR3D": "actual_tool_accelerometer elbow_position elbow_velocity payload_cog",
    "VECTOR6INT32": "joint_mode",
    "INT32": "robot_mode safety_mode safety_status tool_output_voltage time_scale_source encoder0_raw encoder1_raw",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "UINT32": """runtime_state robot_status_bits safety_status_bits analog_io_types euromap67_input_bits
        euromap67_output_bits tool_mode tool_analog_input_types script_control_line""",
    "UINT8": "tool_output_mode tool_digital_output0_mode tool_digital_output1_mode",
}
_TYPES = {name: kind for kind, names in _NAMES.items() for name in names.split()}
_REGISTERS = (
    (re.compile(r"(in|out)put_bit_registers(0_to_31|32_to_63)"), "UINT32"),
    (re.compile(r"(in|out)put_bit_register_(6[4-9]|[7-9]\d|1[01]\d|12[0-7])"), "BOOL"),
    (re.compile(r"(in|out)put_int_register_([0-9]|[1-3]\d|4[0-7])"), "INT32"),
    (re.compile(r"(in|out)put_double_register_([0-9]|[1-3]\d|4[0-7])"), "DOUBLE"),
)
JOINT_RUNNING = 253
MODE_RUNNING = 7  # robot_mode of an arm that is on and free
SAFETY_NORMAL, SAFETY_PROTECTIVE_STOP = 1, 3  # safety_mode
BIT_NORMAL, BIT_PROTECTIVE_STOP = 1 << 0, 1 << 2  # safety_status_bits
_VALUES: dict[str, Value] = {
    "robot_mode": MODE_RUNNING,
    "safety_mode": SAFETY_NORMAL,
    "safety_status": SAFETY_NORMAL,
    "safety_status_bits": BIT_NORMAL,
    "robot_status_bits": 1,
    "runtime_state": 1,
    "speed_scaling": 1.0,
    "target_speed_fraction": 1.0,
    "joint_mode": [JOINT_RUNNING] * 6,
}


def type_of(name: str) -> str | None:
    """The type of an output field; None where no controller has it."""
    if name in _TYPES:
        return _TYPES[name]
    return next((kind for pattern, kind in _REGISTERS if pattern.fullmatch(name)), None)


def default_of(name: str) -> Value:
    """The value of an output field of a healthy arm that stands still."""
    if name in _VALUES:
        return _VALUES[name]
    kind = type_of(name) or "DOUBLE"
    zero = 0.0 if kind in ("DOUBLE", "VECTOR3D", "VECTOR6D") else 0
    n = N_VALUES.get(kind, 1)
    return zero if n == 1 else [zero] * n
