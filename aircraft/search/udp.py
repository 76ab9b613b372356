"""MAVLink over UDP with ground stations and programs: `udpout:HOST:PORT` or `udpin:HOST:PORT`, pymavlink's
URLs.
"""

import logging
import re
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.access.reach import is_open
from link.bus.frames import LAYOUTS, Frame, checksums, frame_at, frame_length
from link.bus.log import Log
from link.bus.mavlink import Codec, Message
from link.bus.px4 import ADDED
from link.signing.signer import FREE, Signer

logger = logging.getLogger(__name__)

LARGEST_DATAGRAM = 65535
FORGET_AFTER_S = 60.0
"""A peer of a `udpin` that is silent for this long is dropped: a ground station sends a heartbeat every
second.
"""
MOST_PEERS = 16
"""A `udpin` answers at most this many peers, the latest to have sent a frame: source addresses are easily
forged.
"""
ALLOWED = "udpout:HOST:PORT or udpin:HOST:PORT"
PX4_SENDS, PX4_LISTENS = 14540, 14580
"""Ports of PX4's first simulated vehicle for programs: where it sends to, and where it listens."""


class Url(NamedTuple):
    """The parts of a UDP URL."""

    listens: bool
    """True for `udpin`: bind to the address and answer every sender. False for `udpout`: send to the
    address.
    """
    host: str
    port: int

    @property
    def text(self) -> str:
        """The URL itself, with its port."""
        return f"udp{'in' if self.listens else 'out'}:{self.host}:{self.port}"

    @property
    def open(self) -> bool:
        """Whether it listens to other machines."""
        return self.listens and is_open(self.host)

    @property
    def counterpart(self) -> str:
        """The URL that a client needs to reach this link."""
        if self.listens:
            return f"MAVSDK: udpout://HOST:{self.port}, pymavlink and MAVProxy: udpout:HOST:{self.port}"
        return f"MAVSDK: udpin://0.0.0.0:{self.port}, pymavlink and MAVProxy: udpin:0.0.0.0:{self.port}"


def parse_url(url: str, instance: int = 0) -> Url:
    """Parse a URL; raises ValueError if it is not valid. A missing port is that of PX4's simulated vehicle
    of this number.
    """
    match = re.fullmatch(r"udp(in|out):([^\s:/]+)(?::([0-9]{1,5}))?", url)
    if not match or not 1 <= int(match[3] or 1) <= 65535:
        raise ValueError(
            f"{url!r} is not a MAVLink UDP URL: allowed is {ALLOWED} with a port from 1 to 65535"
        )
    listens = match[1] == "in"
    return Url(listens, match[2], int(match[3] or (PX4_LISTENS if listens else PX4_SENDS) + instance))


class Datagram(NamedTuple):
    """What a datagram holds."""

    messages: list[Message]
    garbage: int
    """Bytes that belong to no message."""
    rest: bytes
    """The bytes at the end that may be the beginning of a frame; shorter than the longest frame."""


MARKER = re.compile(rb"[\xfd\xfe]")
"""The first byte of a frame."""
MOST_FALSE_STARTS = 500
"""Bytes in a datagram that look like the start of a frame and are none. Of noise one byte in 128 does;
only a flood comes this far.
"""


def decode(datagram: bytes, admits: Callable[[bytes], bool] = lambda _: True) -> Datagram:
    """Return the messages in a datagram (MAVLink 1 or 2), the number of bytes that belong to none, and the
    beginning of a last frame.

    `admits` says of each whole frame whether it may be read; those that may not are passed over.
    Garbage cannot swallow a good frame that follows it, also not a frame's beginning whose end never
    comes. After `MOST_FALSE_STARTS` the rest of the datagram is garbage.
    """
    parser = mavlink.MAVLink(None)
    messages: list[Message] = []
    used, rest_at, false_starts, at = 0, len(datagram), 0, 0
    while (found := MARKER.search(datagram, at)) and false_starts < MOST_FALSE_STARTS:
        start = found.start()
        frame = frame_at(datagram, start)
        message = _message(parser, frame) if frame else None
        if frame and message:
            if admits(frame.data):
                messages.append(message)
            at = start + len(frame.data)
            used, rest_at = used + len(frame.data), len(datagram)
        else:
            false_starts += 1
            at = start + 1
            if (
                frame is None
                and rest_at == len(datagram)
                and _may_begin(datagram[start : start + 3], len(datagram) - start)
            ):
                rest_at = start
    rest = datagram[rest_at:] if false_starts < MOST_FALSE_STARTS else b""
    return Datagram(messages, len(datagram) - used - len(rest), rest)


def _may_begin(head: bytes, left: int) -> bool:
    """Whether a frame whose first bytes are `head` is longer than what is left of the datagram."""
    if head[0] == mavlink.PROTOCOL_MARKER_V2 and len(head) == 3 and head[2] & ~mavlink.MAVLINK_IFLAG_SIGNED:
        return False
    return len(head) < 3 or left < frame_length(head, 0)


def _message(parser: mavlink.MAVLink, frame: Frame) -> Message | None:
    """Return the message of a frame; None if its checksum is wrong, or its type unknown: then the checksum
    cannot be verified.
    """
    layout = LAYOUTS.get(frame.message_id)
    if layout is None or frame.message_id in ADDED:  # none of them asks for anything
        return None
    received, right = checksums(frame, layout.seed)
    if received != right:
        return None
    try:
        return parser.decode(bytearray(frame.data))
    except mavlink.MAVError:
        return None


class UdpLink:
    """Sends messages to its peers and passes received ones, with the sender's HOST:PORT, to a callback, in
    a thread of its own.

    A `udpout` has one peer, its address, whether or not anyone answers there; a message that cannot be
    sent is lost, as on a radio. The peers of a `udpin` are all who sent it a frame in the last minute,
    other than a radio's RADIO_STATUS, which needs no signature.
    """

    def __init__(
        self,
        url: str,
        on_message: Callable[[Message, str], None],
        system: int = 1,
        component: int = 1,
        signer: Signer | None = None,
    ) -> None:
        """Open the link; raises ValueError if the URL is not valid or its host or port cannot be used.

        With a signer, what is sent is signed, and frames without a valid signature are passed over.
        """
        self.garbage = 0
        """Received bytes that belong to no message."""
        where = parse_url(url)
        self.rests: dict[tuple[str, int], bytes] = {}
        """Of each peer, the beginning of a frame that its last datagram ended with; of strangers, the
        latest `MOST_PEERS`.
        """
        self._codec = Codec(system, component)
        self.signer = signer
        self._on_message = on_message
        self._heard: dict[tuple[str, int], float] | None = {} if where.listens else None
        """When each peer of a `udpin` was last heard, the latest last. Replaced as a whole because two
        threads use it.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if where.listens:
                self._socket.bind(where[1:])
            else:
                self._socket.connect(where[1:])  # from now on the kernel delivers only this peer's datagrams
        except OSError as error:
            self._socket.close()
            raise ValueError(
                f"{url!r} cannot be used: {error.strerror}; allowed is {ALLOWED} with a usable IPv4 host"
            ) from None
        self._socket.setblocking(False)
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._receive, name=f"mavlink {url}", daemon=True)
        self._thread.start()

    def send(self, *messages: Message) -> None:
        """Send each message in a datagram of its own."""
        peers = self._peers()
        for message in messages:
            frame = self._codec.pack(message)
            if self.signer:
                frame = self.signer.sign(frame)
            for peer in peers:
                try:
                    if peer is None:
                        self._socket.send(frame)
                    else:
                        self._socket.sendto(frame, peer)
                except OSError:  # no listener there (yet), a full buffer, or a closed link
                    continue

    def tell_refused(self, log: Log) -> None:
        """Log and count the frames that had no valid signature since the last call."""
        if self.signer:
            self.signer.tell(log)

    def _peers(self) -> list[tuple[str, int] | None]:
        if self._heard is None:
            return [None]
        oldest = time.monotonic() - FORGET_AFTER_S
        return [peer for peer, heard in self._heard.items() if heard >= oldest]

    def close(self) -> None:
        """End the thread and free the socket; a second call has no effect."""
        self._wake.close()
        if self._thread is not threading.current_thread():
            self._thread.join()
        self._woken.close()
        self._socket.close()

    def _joined(self, datagram: bytes, peer: tuple[str, int]) -> list[Message]:
        """Return the messages of a peer's datagram; a frame may have begun in its last one."""
        signer, sender = self.signer, f"{peer[0]}:{peer[1]}"
        data = self.rests.pop(peer, b"") + datagram
        messages, garbage, rest = (
            decode(data, lambda frame: signer.admits(frame, sender)) if signer else decode(data)
        )
        self.garbage += garbage
        if rest:
            strangers = [other for other in self.rests if other not in (self._heard or {})]
            for other in strangers[: max(len(strangers) + 1 - MOST_PEERS, 0)]:
                self.garbage += len(self.rests.pop(other))
            self.rests[peer] = rest
        return messages

    def _receive(self) -> None:
        while True:
            readable, _, _ = select.select([self._socket, self._woken], [], [])
            if self._woken in readable:
                return
            try:
                datagram, peer = self._socket.recvfrom(LARGEST_DATAGRAM)
            except OSError:  # the peer refused an earlier datagram: no listener there yet
                continue
            messages = self._joined(datagram, peer)
            if self._heard is not None and any(message.get_msgId() not in FREE for message in messages):
                others = [(other, heard) for other, heard in self._heard.items() if other != peer]
                self._heard = dict([*others, (peer, time.monotonic())][-MOST_PEERS:])
            for message in messages:
                try:
                    self._on_message(message, f"{peer[0]}:{peer[1]}")
                except Exception:  # one message must not end the link
                    logger.exception("%s was not handled", message.get_type())
