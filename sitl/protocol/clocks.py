"""The services of time: TIMESYNC and PING, answered with the simulation's time."""

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.protocol.service import Microservice, Reply, asker


def timesync(message: Message, t_s: float) -> Reply:
    """Answer a request (tc1 = 0) with our own time in ns; anything else is someone's answer."""
    return Reply([] if message.tc1 else [mavlink.MAVLink_timesync_message(round(t_s * 1e9), message.ts1)])


def ping(message: Message, _: float) -> Reply:
    """Send a ping to all (target 0/0) back to its sender; anything else is someone's answer."""
    if message.target_system or message.target_component:
        return Reply([])
    return Reply([mavlink.MAVLink_ping_message(message.time_usec, message.seq, *asker(message))])


SERVICES = (
    Microservice("TIMESYNC", timesync, "TIMESYNC with the time of the simulation, which all telemetry uses"),
    Microservice("PING", ping, "PING, addressed to the asker"),
)
