"""What can go wrong with a controller, on demand: ``KIND[:VALUE][@SECONDS]``."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from cluster_slam.errors import ConfigError

KINDS = {
    "drop": (1.0, "the connection is closed and the port shut for VALUE seconds"),
    "reset": (0.0, "the connection is reset (RST); the port stays open"),
    "stall": (1.0, "no data for VALUE seconds, the connection stays open"),
    "silent": (5.0, "for VALUE seconds nothing is answered, not even a handshake"),
    "half": (1.0, "for VALUE seconds packages come in two halves with a pause between them"),
    "cut": (0.0, "half of a package, then the connection is closed"),
    "unknown": (0.0, "from now on the field VALUE is not known"),
    "protective-stop": (1.0, "the arm stands in a protective stop for VALUE seconds"),
    "restart": (1.0, "the controller is off for VALUE seconds; then its clock begins at 0"),
    "skew": (100.0, "the controller's clock runs fast by VALUE parts in a million"),
    "step": (1.0, "the controller's clock jumps by VALUE seconds"),
}  # default value, and what happens


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault, and when it happens."""

    kind: str
    value: float
    name: str = ""  # of the field, for "unknown"
    at_s: float = 0.0  # since the emulator started


def parse_fault(text: str) -> Fault:
    """A fault as the command line has it, e.g. ``stall:2@5`` or ``unknown:actual_q@0``.

    Raises
    ------
    ConfigError
        No such fault, or a value that is no number.
    """
    what, _, when = text.strip().partition("@")
    kind, _, value = what.partition(":")
    if kind not in KINDS:
        near = difflib.get_close_matches(kind, KINDS, 1)
        hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(KINDS)}"
        raise ConfigError(f"unknown fault {kind!r}; {hint}")
    at_s = _number(text, when, "a time in seconds after @") if when else 0.0
    if kind == "unknown":
        if not value:
            raise ConfigError(f"fault {text!r}, expected the name of a field, as in unknown:actual_q")
        return Fault(kind, 0.0, value, at_s)
    amount = _number(text, value, "a number after :") if value else KINDS[kind][0]
    if amount < 0 and kind not in ("skew", "step"):
        raise ConfigError(f"fault {text!r}, expected seconds from 0")
    return Fault(kind, amount, "", at_s)


def _number(text: str, value: str, expected: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = float("nan")
    if not abs(number) < 1e9:
        raise ConfigError(f"fault {text!r}, expected {expected}")
    return number
