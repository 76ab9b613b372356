"""The service of logs: a vehicle that has none on board. What it does is on the bus, and in the record."""

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.protocol.service import Microservice, Reply

DATA = 90
"""Bytes of one LOG_DATA (120)."""


def entries(_message: Message, _: float) -> Reply:
    """Answer LOG_REQUEST_LIST (117): no logs."""
    return Reply([mavlink.MAVLink_log_entry_message(id=0, num_logs=0, last_log_num=0, time_utc=0, size=0)])


def data(message: Message, _: float) -> Reply:
    """Answer LOG_REQUEST_DATA (119): no bytes, which ends a download."""
    return Reply([mavlink.MAVLink_log_data_message(message.id, message.ofs, 0, [0] * DATA)])


def erase(_message: Message, _: float) -> Reply:
    """Answer LOG_ERASE (121) in words: it has no acknowledgement."""
    return Reply([], "Logs not erased: none on board")


SERVICES = (
    Microservice("LOG_REQUEST_LIST", entries, "LOG_ENTRY with 0 logs", supported=False),
    Microservice("LOG_REQUEST_DATA", data, "LOG_DATA with 0 bytes", supported=False),
    Microservice("LOG_ERASE", erase, "a STATUSTEXT", supported=False),
)
