"""What is not served on the bus for a real vehicle: its missions, fences and parameters are its autopilot's. Refused with a word."""

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.protocol.service import Microservice, Reply, asker

WHERE = "connect to the autopilot itself, or through plumeward bridge"
PLANS = (
    "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "MISSION_REQUEST", "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ITEM",
    "MISSION_CLEAR_ALL", "MISSION_SET_CURRENT",
)  # fmt: skip
"""Each is answered, as the protocol of missions asks."""
PARAMETERS = ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET")
OTHERS = ("LOG_REQUEST_LIST", "FILE_TRANSFER_PROTOCOL", "SET_HOME_POSITION")
"""These and parameters have no answer that refuses, only a text."""


def not_served() -> tuple[Microservice, ...]:
    """Return the services that refuse; each kind of asker is told once a second at most."""
    plans = [Microservice(kind, _refuse_plan, "MISSION_ACK: unsupported", supported=False) for kind in PLANS]
    parameters = [Microservice(kind, lambda *_: _said("Parameters"), "a STATUSTEXT", supported=False) for kind in PARAMETERS]
    others = [Microservice(kind, lambda *_: _said("Logs and files"), "a STATUSTEXT", supported=False) for kind in OTHERS]
    return (*plans, *parameters, *others)


def _refuse_plan(message: Message, _: float) -> Reply:
    kind = getattr(message, "mission_type", mavlink.MAV_MISSION_TYPE_MISSION)
    return _said("Plans", mavlink.MAVLink_mission_ack_message(*asker(message), mavlink.MAV_MISSION_UNSUPPORTED, kind))


def _said(what: str, *answers: Message) -> Reply:
    return Reply([*answers], f"{what} refused: {WHERE}", what)
