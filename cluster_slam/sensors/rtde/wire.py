"""Packages of the RTDE protocol, version 2: big endian, ``uint16`` size with the header, ``uint8`` type, payload.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum

from cluster_slam.errors import InputError

_HEADER = struct.Struct(">HB")
PROTOCOL_VERSION = 2
Value = float | int | Sequence[float] | Sequence[int]


class Package(IntEnum):
    """Types of packages: the letter of each."""

    REQUEST_PROTOCOL_VERSION = ord("V")
    GET_CONTROLLER_VERSION = ord("v")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")
    TEXT_MESSAGE = ord("M")


def pack(kind: int, payload: bytes = b"") -> bytes:
    """One package with its header."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


class PackageReader:
    """Packages out of a stream of bytes, however it was cut."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Type and payload of each package that is complete now.

        Raises
        ------
        InputError
            The size in a header is smaller than the header.
        """
        self._bytes += data
        found = []
        while len(self._bytes) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._bytes)
            if size < _HEADER.size:
                raise InputError(f"RTDE package of {size} bytes, expected at least {_HEADER.size}")
            if len(self._bytes) < size:
                break
            found.append((kind, bytes(self._bytes[_HEADER.size : size])))
            del self._bytes[:size]
        return found


class Recipe:
    """What a client asked for: names, their types, and how a data package holds their values."""

    def __init__(self, number: int, names: Sequence[str], types: Sequence[str]) -> None:
        self.number, self.names, self.types = number, tuple(names), tuple(types)
        self._struct = struct.Struct(">B" + "".join(FORMATS[name] for name in types))

    def data(self, values: Sequence[Value]) -> bytes:
        """A data package with one value (or vector) a name."""
        flat: list[float | int] = []
        for value in values:
            if isinstance(value, (int, float)):
                flat.append(value)
            else:
                flat.extend(value)
        return pack(Package.DATA, self._struct.pack(self.number, *flat))

    def values(self, payload: bytes) -> dict[str, Value]:
        """Values by name of the payload of a data package."""
        flat = self._struct.unpack(payload)[1:]
        out: dict[str, Value] = {}
        i = 0
        for name, kind in zip(self.names, self.types, strict=True):
            n = N_VALUES.get(kind, 1)
            out[name] = flat[i] if n == 1 else flat[i : i + n]
            i += n
        return out


FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
N_VALUES = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6, "VECTOR6UINT32": 6}
