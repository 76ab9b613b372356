"""Message types of PX4 and ArduPilot that pymavlink's common dialect lacks in whole or in part."""

import itertools
import struct
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

# C types of fields, and their codes in `struct`.
CODES = {
    "char": "s",
    "int8_t": "b",
    "uint8_t": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
}


class Field(NamedTuple):
    """A field of a message: C type, name, and the length of an array or text."""

    kind: str
    name: str
    length: int = 0
    extension: bool = False  # true for a field that was added to the message later: checksums leave it out


def _message_type(number: int, name: str, *fields: Field) -> Any:
    """Return the class of a message like those that pymavlink generates.

    Fields come in wire order: the widest first, then extensions.
    """

    def init(self: Any, **values: Any) -> None:
        mavlink.MAVLink_message.__init__(self, number, name)
        self._fieldnames = [field.name for field in fields]
        vars(self).update(values)

    def pack(self: Any, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        values = (getattr(self, field.name) for field in fields)
        flat = itertools.chain.from_iterable(each if isinstance(each, list) else [each] for each in values)
        payload = self.unpacker.pack(*flat)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))

    names = [field.name for field in fields]
    attributes = {
        "id": number,
        "msgname": name,
        "fieldnames": names,
        "ordered_fieldnames": names,
        "fieldtypes": [field.kind for field in fields],
        "array_lengths": [field.length for field in fields],
        "crc_extra": _crc_extra(name, fields),
        "unpacker": struct.Struct(
            "<" + "".join(f"{field.length or ''}{CODES[field.kind]}" for field in fields)
        ),
        "__init__": init,
        "pack": pack,
    }
    return type(f"MAVLink_{name.lower()}_message", (mavlink.MAVLink_message,), attributes)


def _crc_extra(name: str, fields: tuple[Field, ...]) -> int:
    """Return the byte that stands for a message's layout in its checksum (MAVLink guide, "CRC_EXTRA")."""
    described = [
        f"{field.kind} {field.name} ".encode() + bytes([field.length] if field.length else [])
        for field in fields
        if not field.extension
    ]
    crc = mavlink.x25crc(b"".join([f"{name} ".encode(), *described])).crc
    return int(crc & 0xFF ^ crc >> 8)


ProtocolVersion = _message_type(
    300,
    "PROTOCOL_VERSION",
    Field("uint16_t", "version"),
    Field("uint16_t", "min_version"),
    Field("uint16_t", "max_version"),
    Field("uint8_t", "spec_version_hash", 8),
    Field("uint8_t", "library_version_hash", 8),
)
AvailableModes = _message_type(
    435,
    "AVAILABLE_MODES",
    Field("uint32_t", "custom_mode"),
    Field("uint32_t", "properties"),
    Field("uint8_t", "number_modes"),
    Field("uint8_t", "mode_index"),
    Field("uint8_t", "standard_mode"),
    Field("char", "mode_name", 35),
)
CurrentMode = _message_type(
    436,
    "CURRENT_MODE",
    Field("uint32_t", "custom_mode"),
    Field("uint32_t", "intended_custom_mode"),
    Field("uint8_t", "standard_mode"),
)
AvailableModesMonitor = _message_type(437, "AVAILABLE_MODES_MONITOR", Field("uint8_t", "seq"))
MissionCurrent = _message_type(
    42,
    "MISSION_CURRENT",
    Field("uint16_t", "seq"),
    Field("uint16_t", "total", extension=True),
    Field("uint8_t", "mission_state", extension=True),
    Field("uint8_t", "mission_mode", extension=True),
    Field("uint32_t", "mission_id", extension=True),
    Field("uint32_t", "fence_id", extension=True),
    Field("uint32_t", "rally_points_id", extension=True),
)

Wind = _message_type(
    168, "WIND", Field("float", "direction"), Field("float", "speed"), Field("float", "speed_z")
)
EkfStatusReport = _message_type(
    193,
    "EKF_STATUS_REPORT",
    Field("float", "velocity_variance"),
    Field("float", "pos_horiz_variance"),
    Field("float", "pos_vert_variance"),
    Field("float", "compass_variance"),
    Field("float", "terrain_alt_variance"),
    Field("uint16_t", "flags"),
    Field("float", "airspeed_variance", extension=True),
)

ADDED = {
    kind.id: kind
    for kind in (
        ProtocolVersion,
        AvailableModes,
        CurrentMode,
        AvailableModesMonitor,
        MissionCurrent,
        Wind,
        EkfStatusReport,
    )
}
