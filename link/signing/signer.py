"""Signs what a process sends over MAVLink links, and refuses what comes without a valid signature."""

import threading
from collections import Counter
from pathlib import Path
from zlib import crc32

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import MAVLINK_1, frame_at
from link.bus.log import Log
from link.signing.key import read_key
from link.signing.signature import is_genuine, is_signed, link_and_timestamp, signed
from link.signing.timestamps import AHEAD, MINUTE, UNITS_A_S, Timestamps

UNSIGNED, WRONG, OLD = "without a signature", "with a wrong signature", "with an old timestamp"
# Why a frame is refused.
FAR_AHEAD = f"with a timestamp more than {AHEAD // MINUTE} minutes ahead of this machine's clock"
# Types that need no signature: radios add them to the link, and have no key. The standard lets them
# through.
FREE = frozenset({mavlink.MAVLINK_MSG_ID_RADIO_STATUS})
SYSTEM_AT = 5  # offset of the system id in a frame of MAVLink 2; the component id follows
# Senders of a link that are logged, each once for each reason. It is bounded because source addresses are
# easily forged.
MOST_TOLD = 16


class Signing:
    """The key and the timestamps of a process, which all its signed links share."""

    def __init__(self, path: str, who: str, log: Log) -> None:
        """Read the key; raises ValueError if its file or the file of its timestamps cannot be used.

        who: whose timestamps they are; part of the name of their file, which lies beside the key.
        """
        key = read_key(path)
        self.secret = key.secret
        file = Path(path).resolve()
        self._who = who
        self._numbers: set[int] = set()
        kept = file.with_name(f"{file.name}.{who}")
        self.timestamps = Timestamps(kept)
        log.info(f"signs MAVLink by {path!r}, which holds {key.made_from}")
        if key.open_to_all:
            log.warning(f"{path!r} is open to every user of this machine: chmod 600 {path}")
        if (ahead_s := self.timestamps.ahead_s) > MINUTE / UNITS_A_S:
            log.warning(
                f"the last timestamp is {ahead_s:.0f} s ahead of the clock: senders with a correct clock "
                "will be refused "
                f"(if the clock is right, remove {str(kept)!r}, at the earliest a minute after its last use)"
            )

    def link(self, url: str) -> "Signer":
        """Return what signs a link.

        Its link id comes from its URL and whose it is: two processes should not speak with the same
        ids.
        """
        number = crc32(f"{self._who} {url}".encode()) % 256
        while number in self._numbers and len(self._numbers) < 256:
            number = (number + 1) % 256
        self._numbers.add(number)
        return Signer(self, number, url)

    def close(self) -> None:
        """Free the file."""
        self.timestamps.close()


class Signer:
    """Signs and verifies the frames of one link. Safe in several threads."""

    def __init__(self, signing: Signing, number: int, url: str) -> None:
        self._signing = signing
        self._number = number
        self._url = url
        self._lock = threading.Lock()
        self._refused: Counter[str] = Counter()
        self._told: set[tuple[str, str]] = set()
        self._lines: list[str] = []

    def sign(self, frame: bytes) -> bytes:
        """Return a frame with this link's signature; empty for MAVLink 1, which has none."""
        if frame[0] == MAVLINK_1:
            return b""
        system, component = frame[SYSTEM_AT : SYSTEM_AT + 2]
        timestamp = self._signing.timestamps.next((system, component, self._number))
        return signed(frame, self._signing.secret, self._number, timestamp)

    def admits(self, frame: bytes, sender: str) -> bool:
        """Whether a whole frame is rightly signed and new, or needs no signature.

        If not, it is counted. sender: for people.
        """
        if not (reason := self._fault(frame)):
            return True
        with self._lock:
            self._refused[reason] += 1
            if (sender, reason) not in self._told and len(self._told) <= MOST_TOLD:
                self._told.add((sender, reason))
                self._lines.append(
                    f"{self._url}: more senders are refused; they are only counted from now on"
                    if len(self._told) > MOST_TOLD
                    else f"{self._url}: {sender}: frames {reason} are refused"
                )
        return False

    def _fault(self, frame: bytes) -> str:
        parts = frame_at(frame)
        if parts is None or not is_signed(frame):
            return "" if parts and parts.message_id in FREE else UNSIGNED
        if not is_genuine(frame, self._signing.secret):
            return WRONG
        link, timestamp = link_and_timestamp(frame)
        if self._signing.timestamps.accept((parts.system, parts.component, link), timestamp):
            return ""
        return FAR_AHEAD if self._signing.timestamps.is_far_ahead(timestamp) else OLD

    def tell(self, log: Log) -> Counter[str]:
        """Log and count what has been refused since the last call; returns the counts by reason."""
        with self._lock:
            refused, self._refused = self._refused, Counter()
            lines, self._lines = self._lines, []
        for reason, count in refused.items():
            log.tally.refuse(f"{reason} ({self._url})", count)
        for line in lines:
            log.warning(line)
        if notice := self._signing.timestamps.notice:
            self._signing.timestamps.notice = ""
            log.warning(notice)
        return refused
