"""The service of files: MAVLink FTP of a vehicle that has none. Every request gets a NAK with the fitting
error.
"""

import struct

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.protocol.service import Microservice, Reply, asker

HEADER = struct.Struct("<HBBBBBxI")
"""Sequence number, session, opcode, size, requested opcode, burst complete, padding, offset; then data up
to 251 bytes in all.
"""
PAYLOAD = 251
ERRORS = {
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
"""Error of each opcode; of all others UnknownCommand. There are no sessions, no files, and nothing can be
written.
"""
HARMLESS = {mavlink.MAV_FTP_OPCODE_NONE, mavlink.MAV_FTP_OPCODE_RESETSESSION}
"""Opcodes that ask for nothing, or for what is so already: acknowledged."""
ANSWERS = {mavlink.MAV_FTP_OPCODE_ACK, mavlink.MAV_FTP_OPCODE_NAK}


def ftp(message: Message, _: float) -> Reply:
    """Answer FILE_TRANSFER_PROTOCOL (110): the sequence number is the request's plus one."""
    number, session, opcode, _, _, _, offset = HEADER.unpack_from(bytes(message.payload))
    if opcode in ANSWERS:
        return Reply([])
    harmless = opcode in HARMLESS
    error = b"" if harmless else bytes([ERRORS.get(opcode, mavlink.MAV_FTP_ERR_UNKNOWNCOMMAND)])
    answer = mavlink.MAV_FTP_OPCODE_ACK if harmless else mavlink.MAV_FTP_OPCODE_NAK
    header = HEADER.pack((number + 1) & 0xFFFF, session, answer, len(error), opcode, 0, offset)
    return Reply(
        [
            mavlink.MAVLink_file_transfer_protocol_message(
                0, *asker(message), (header + error).ljust(PAYLOAD, b"\0")
            )
        ]
    )


SERVICES = (
    Microservice(
        "FILE_TRANSFER_PROTOCOL",
        ftp,
        "a NAK with the fitting error: there are no files on board",
        supported=False,
    ),
)
