"""The services of MAVLink that need no memory: clocks, and refusals of what the vehicle does not have.

A service takes one type of message. What has no acknowledgement of its own is refused by STATUSTEXT (253).
"""

import struct
from collections.abc import Callable
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.autopilot.telemetry import Telemetry


class Request(NamedTuple):
    """A message to the vehicle, and how it came."""

    message: Message
    t_s: float  # simulation time
    streams: Telemetry | None = None  # the telemetry of the link that it came over

    @property
    def asker(self) -> tuple[int, int]:
        """System and component id of the sender: the target of the answer."""
        return self.message.get_srcSystem(), self.message.get_srcComponent()


class Reply(NamedTuple):
    """The answer to a request: messages for its sender, and if it was refused a reason for a STATUSTEXT."""

    messages: list[Message]
    reason: str = ""


class Microservice(NamedTuple):
    """One type of message and what becomes of it."""

    request: str  # message type
    answer: Callable[[Request], Reply]
    says: str  # what the answer is, for the documentation
    supported: bool = True  # False if the answer is a refusal, or that there is nothing


# ---- time ----


def timesync(request: Request) -> Reply:
    """Answer a request (tc1 = 0) with our own time in ns; anything else is someone's answer."""
    message = request.message
    answer = mavlink.MAVLink_timesync_message(round(request.t_s * 1e9), message.ts1)
    return Reply([] if message.tc1 else [answer])


def ping(request: Request) -> Reply:
    """Send a ping to all (target 0/0) back to its sender; anything else is someone's answer."""
    message = request.message
    if message.target_system or message.target_component:
        return Reply([])
    return Reply([mavlink.MAVLink_ping_message(message.time_usec, message.seq, *request.asker)])


# ---- logs and files: there are none ----

LOG_BYTES = 90  # of one LOG_DATA (120); without any, a download ends


def _log_entries(_: Request) -> Reply:
    return Reply([mavlink.MAVLink_log_entry_message(id=0, num_logs=0, last_log_num=0, time_utc=0, size=0)])


def _log_data(request: Request) -> Reply:
    message = request.message
    return Reply([mavlink.MAVLink_log_data_message(message.id, message.ofs, 0, [0] * LOG_BYTES)])


def _log_erase(_: Request) -> Reply:
    return Reply([], "Logs not erased: none on board")


# Sequence number, session, opcode, size, requested opcode, burst complete, padding, offset.
FTP_HEADER = struct.Struct("<HBBBBBxI")
FTP_PAYLOAD = 251  # bytes, header included
# The error of each opcode: there are no sessions and no files, and nothing can be written.
FTP_ERROR = {
    mavlink.MAV_FTP_OPCODE_TERMINATESESSION: mavlink.MAV_FTP_ERR_INVALIDSESSION,
    mavlink.MAV_FTP_OPCODE_READFILE: mavlink.MAV_FTP_ERR_INVALIDSESSION,
    mavlink.MAV_FTP_OPCODE_WRITEFILE: mavlink.MAV_FTP_ERR_INVALIDSESSION,
    mavlink.MAV_FTP_OPCODE_BURSTREADFILE: mavlink.MAV_FTP_ERR_INVALIDSESSION,
    mavlink.MAV_FTP_OPCODE_LISTDIRECTORY: mavlink.MAV_FTP_ERR_FILENOTFOUND,
    mavlink.MAV_FTP_OPCODE_OPENFILERO: mavlink.MAV_FTP_ERR_FILENOTFOUND,
    mavlink.MAV_FTP_OPCODE_CALCFILECRC: mavlink.MAV_FTP_ERR_FILENOTFOUND,
    mavlink.MAV_FTP_OPCODE_REMOVEFILE: mavlink.MAV_FTP_ERR_FILENOTFOUND,
    mavlink.MAV_FTP_OPCODE_REMOVEDIRECTORY: mavlink.MAV_FTP_ERR_FILENOTFOUND,
    mavlink.MAV_FTP_OPCODE_RENAME: mavlink.MAV_FTP_ERR_FILENOTFOUND,
    mavlink.MAV_FTP_OPCODE_TRUNCATEFILE: mavlink.MAV_FTP_ERR_FILENOTFOUND,
    mavlink.MAV_FTP_OPCODE_CREATEFILE: mavlink.MAV_FTP_ERR_FILEPROTECTED,
    mavlink.MAV_FTP_OPCODE_OPENFILEWO: mavlink.MAV_FTP_ERR_FILEPROTECTED,
    mavlink.MAV_FTP_OPCODE_CREATEDIRECTORY: mavlink.MAV_FTP_ERR_FILEPROTECTED,
}
# Opcodes that ask for nothing, or for what is so already: acknowledged.
FTP_HARMLESS = {mavlink.MAV_FTP_OPCODE_NONE, mavlink.MAV_FTP_OPCODE_RESETSESSION}
FTP_ANSWERS = {mavlink.MAV_FTP_OPCODE_ACK, mavlink.MAV_FTP_OPCODE_NAK}


def ftp(request: Request) -> Reply:
    """Answer FILE_TRANSFER_PROTOCOL (110): the sequence number is the request's plus one."""
    number, session, opcode, _, _, _, offset = FTP_HEADER.unpack_from(bytes(request.message.payload))
    if opcode in FTP_ANSWERS:
        return Reply([])
    said, error = mavlink.MAV_FTP_OPCODE_ACK, b""
    if opcode not in FTP_HARMLESS:
        said = mavlink.MAV_FTP_OPCODE_NAK
        error = bytes([FTP_ERROR.get(opcode, mavlink.MAV_FTP_ERR_UNKNOWNCOMMAND)])
    header = FTP_HEADER.pack((number + 1) & 0xFFFF, session, said, len(error), opcode, 0, offset)
    payload = (header + error).ljust(FTP_PAYLOAD, b"\0")
    return Reply([mavlink.MAVLink_file_transfer_protocol_message(0, *request.asker, payload)])


SERVICES = (
    Microservice("TIMESYNC", timesync, "TIMESYNC with the time of the simulation, which all telemetry uses"),
    Microservice("PING", ping, "PING, addressed to the asker"),
    Microservice("LOG_REQUEST_LIST", _log_entries, "LOG_ENTRY with 0 logs", False),
    Microservice("LOG_REQUEST_DATA", _log_data, "LOG_DATA with 0 bytes", False),
    Microservice("LOG_ERASE", _log_erase, "a STATUSTEXT", False),
    Microservice(
        "FILE_TRANSFER_PROTOCOL", ftp, "a NAK with the fitting error: there are no files on board", False
    ),
)

# Messages that are refused, and the text of the refusal, sent at most once a second.
REFUSED = {
    "SET_ATTITUDE_TARGET": "Attitude setpoint refused: only positions, velocities and accelerations are "
    "flown",
    "SET_ACTUATOR_CONTROL_TARGET": "Actuator setpoint refused: only positions, velocities and accelerations "
    "are flown",
    "PARAM_MAP_RC": "Parameter map refused: there is no RC",
    "SERIAL_CONTROL": "Shell refused: there is none",
    "SET_GPS_GLOBAL_ORIGIN": "Origin refused: it is home, which is set at start",
    "GIMBAL_MANAGER_SET_ATTITUDE": "Gimbal refused: there is none",
    "GIMBAL_MANAGER_SET_PITCHYAW": "Gimbal refused: there is none",
    "GIMBAL_MANAGER_SET_MANUAL_CONTROL": "Gimbal refused: there is none",
    "SETUP_SIGNING": "Signing setup refused: no keys over a link",
    "PLAY_TUNE": "Tune refused: there is no speaker",
}
# Those that stations repeat as long as they run: each asker gets the text once.
REFUSED_ONCE = {
    "MANUAL_CONTROL": "Manual control refused: not simulated",
    "RC_CHANNELS_OVERRIDE": "RC override refused: not simulated",
    "REQUEST_DATA_STREAM": "Data streams refused: MAV_CMD_SET_MESSAGE_INTERVAL sets rates",
}
