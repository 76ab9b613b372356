"""CDR: messages of ROS 2 to bytes and back, and the hashes of their types, by the typestores of rosbags."""

from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

NO_HASH = "TypeHashNotSupported"  # in the keys of Humble, which has no hashes
MOST_BYTES = 4096  # longest message that is decoded: a goal has some 100 bytes


class BadMessage(ValueError):
    """A message that is not valid CDR of its type; the text gives the reason."""


class Wire:
    """Encodes and decodes the messages of one distribution."""

    def __init__(self, distribution: str) -> None:
        """Load its types. distribution: one of DISTRIBUTIONS."""
        self._types = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        self._has_hashes = distribution != "humble"

    def hash_of(self, kind: str) -> str:
        """Return the hash of a type as keys have it, `RIHS01_...`."""
        return self._types.hash_rihs01(kind) if self._has_hashes else NO_HASH

    def make(self, kind: str, *fields: Any) -> Any:
        """Return a message of a type with these fields, in their order."""
        return self._types.types[kind](*fields)

    def encode(self, kind: str, message: Any) -> bytes:
        """Return a message as CDR, little-endian, with its header of four bytes."""
        return bytes(self._types.serialize_cdr(message, kind))

    def decode(self, kind: str, data: bytes) -> Any:
        """Return a message of a type; raises BadMessage."""
        if len(data) > MOST_BYTES:
            raise BadMessage(f"it has {len(data)} bytes; wanted at most {MOST_BYTES}")
        try:
            return self._types.deserialize_cdr(data, kind)
        except SerdeError as error:
            raise BadMessage(str(error)) from None
