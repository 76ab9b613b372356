"""The service of missions, fences and rally points: the vehicle holds none and takes none."""

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.protocol.service import Microservice, Reply, asker

REASON = "Mission refused: the vehicle takes no missions, fences or rally points"


def count(message: Message, _: float) -> Reply:
    """Answer MISSION_REQUEST_LIST (43): no items."""
    return Reply([mavlink.MAVLink_mission_count_message(*asker(message), 0, message.mission_type)])


def _acknowledge(message: Message, result: int) -> list[Message]:
    return [mavlink.MAVLink_mission_ack_message(*asker(message), result, getattr(message, "mission_type", 0))]


def cleared(message: Message, _: float) -> Reply:
    """Accept what asks for an empty list: it is empty."""
    return Reply(_acknowledge(message, mavlink.MAV_MISSION_ACCEPTED))


def no_such_item(message: Message, _: float) -> Reply:
    """Refuse a request for an item."""
    return Reply(_acknowledge(message, mavlink.MAV_MISSION_INVALID_SEQUENCE))


def refuse(message: Message, _: float) -> Reply:
    """Refuse items."""
    return Reply(_acknowledge(message, mavlink.MAV_MISSION_UNSUPPORTED), REASON)


def upload(message: Message, t_s: float) -> Reply:
    """Refuse an upload, unless it is empty."""
    return refuse(message, t_s) if message.count else cleared(message, t_s)


SERVICES = (
    Microservice("MISSION_REQUEST_LIST", count, "MISSION_COUNT with 0 items", supported=False),
    Microservice("MISSION_REQUEST_INT", no_such_item, "MISSION_ACK: invalid sequence", supported=False),
    Microservice("MISSION_REQUEST", no_such_item, "MISSION_ACK: invalid sequence", supported=False),
    Microservice("MISSION_COUNT", upload, "MISSION_ACK: unsupported; with 0 items: accepted", supported=False),
    Microservice("MISSION_CLEAR_ALL", cleared, "MISSION_ACK: accepted, there are no items", supported=False),
    Microservice("MISSION_SET_CURRENT", no_such_item, "MISSION_ACK: invalid sequence", supported=False),
    *(
        Microservice(kind, refuse, "MISSION_ACK: unsupported", supported=False)
        for kind in ("MISSION_ITEM_INT", "MISSION_ITEM", "MISSION_WRITE_PARTIAL_LIST", "MISSION_REQUEST_PARTIAL_LIST")
    ),
)
