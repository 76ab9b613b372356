"""A MAVLink link over UDP to a ground station or a program: `udpout:HOST:PORT`, as pymavlink writes it."""

import logging
import re
import select
import socket
import threading
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from link.mavlink import Codec, Message

logger = logging.getLogger(__name__)

LARGEST_DATAGRAM = 65535
CHECKSUM_LENGTH = 2


def parse_url(url: str) -> tuple[str, int]:
    """Return (host, port) of `udpout:HOST:PORT`; raises ValueError where it is something else."""
    match = re.fullmatch(r"udpout:([^\s:/]+):([0-9]{1,5})", url)
    if not match or not 1 <= int(match[2]) <= 65535:
        raise ValueError(f"{url!r} is not a MAVLink link: allowed is udpout:HOST:PORT with a port from 1 to 65535")
    return match[1], int(match[2])


def decode(datagram: bytes) -> tuple[list[Message], int]:
    """Return the messages of a datagram, MAVLink 1 or 2, and how many bytes of it belong to none.

    A frame never straddles datagrams, so nothing is kept between them: garbage cannot swallow the good frame that follows it.
    """
    parser = mavlink.MAVLink(None)
    messages, skipped, at = [], 0, 0
    while at < len(datagram):
        frame = datagram[at : at + _frame_length(datagram[at : at + 3])]
        message = _decode_frame(parser, frame)
        if message is None:
            skipped += 1
            at += 1
        else:
            messages.append(message)
            at += len(frame)
    return messages, skipped


def _frame_length(head: bytes) -> int:
    """The length of the frame that may start so; 0 where none does."""
    if len(head) < 3 or head[0] not in (mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2):
        return 0
    if head[0] == mavlink.PROTOCOL_MARKER_V1:
        overhead = mavlink.HEADER_LEN_V1 + CHECKSUM_LENGTH
    elif head[2] in (0, mavlink.MAVLINK_IFLAG_SIGNED):
        overhead = mavlink.HEADER_LEN_V2 + CHECKSUM_LENGTH + (mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if head[2] else 0)
    else:
        return 0  # a receiver must drop what is incompatible in ways it does not know
    return int(overhead) + head[1]


def _decode_frame(parser: mavlink.MAVLink, frame: bytes) -> Message | None:
    if not frame:
        return None
    try:
        message = parser.decode(bytearray(frame))
    except mavlink.MAVError:
        return None
    # Of a message outside the dialect not even the checksum can be verified.
    return None if isinstance(message, mavlink.MAVLink_unknown) else message


class UdpLink:
    """Sends messages to one address and hands those that come back to a callback, in a thread of its own.

    Nobody needs to listen yet: what cannot be sent is lost, as on a radio.
    """

    def __init__(self, url: str, on_message: Callable[[Message], None], system: int = 1, component: int = 1) -> None:
        """Open the link; raises ValueError where the URL is not one or its host is not known."""
        self.garbage = 0
        """Bytes received that belong to no frame."""
        host, port = parse_url(url)
        self._codec = Codec(system, component)
        self._on_message = on_message
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))  # from now on only this peer is heard
        except OSError as error:
            self._socket.close()
            raise ValueError(f"{url!r} cannot be used: {error.strerror}; allowed is udpout:HOST:PORT with a reachable IPv4 host") from None
        self._socket.setblocking(False)
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._receive, name=f"mavlink {url}", daemon=True)
        self._thread.start()

    def send(self, *messages: Message) -> None:
        """Send each message in a datagram of its own."""
        for message in messages:
            try:
                self._socket.send(self._codec.pack(message))
            except OSError:  # nobody listens there (yet), the buffer is full, or the link is closed
                continue

    def close(self) -> None:
        """End the thread and free the socket; a second call does nothing."""
        self._wake.close()
        if self._thread is not threading.current_thread():
            self._thread.join()
        self._woken.close()
        self._socket.close()

    def _receive(self) -> None:
        while True:
            readable, _, _ = select.select([self._socket, self._woken], [], [])
            if self._woken in readable:
                return
            try:
                datagram = self._socket.recv(LARGEST_DATAGRAM)
            except OSError:  # the peer refused what was sent to it: it is not there yet
                continue
            messages, garbage = decode(datagram)
            self.garbage += garbage
            for message in messages:
                try:
                    self._on_message(message)
                except Exception:  # one message must not end the link
                    logger.exception("%s was not handled", message.get_type())
