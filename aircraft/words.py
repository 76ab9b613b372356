"""What clients are told in words, and how often: texts, and why something was refused."""

import math
from collections import Counter

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Result
from link.bus.mavlink import TEXT_LENGTH, Message

# Clients repeat setpoints at 20 Hz: each kind of refusal is reported at most once per interval
REFUSAL_INTERVAL_S = 1.0


class Words:
    """The texts of one sender. Times in s."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()  # refused setpoints, by kind of reason
        self._told_s: dict[str, float] = {}  # when each kind of refusal was last reported
        self._chunked_texts = 0

    def statustext(self, severity: int, text: str) -> list[Message]:
        """Return a text as STATUSTEXT (253).

        A long text is split into chunks of one id; the first chunk that is not full ends it.
        """
        raw = text.encode("ascii", "replace")
        if len(raw) <= TEXT_LENGTH:
            return [mavlink.MAVLink_statustext_message(severity, raw)]
        self._chunked_texts = self._chunked_texts % 0xFFFF + 1
        chunks = [raw[at : at + TEXT_LENGTH] for at in range(0, len(raw) + 1, TEXT_LENGTH)]
        return [
            mavlink.MAVLink_statustext_message(severity, chunk, self._chunked_texts, n)
            for n, chunk in enumerate(chunks)
        ]

    def refuse(self, message: Message, result: Result) -> list[Message]:
        """Return the answer to a command or a change of mode that is refused."""
        return self.answer(
            message,
            mavlink.MAVLINK_MSG_ID_SET_MODE if message.get_type() == "SET_MODE" else message.command,
            result,
        )

    def answer(self, message: Message, command: int, result: Result) -> list[Message]:
        """Return the acknowledgement of a command, and the reason if it is refused."""
        ack = mavlink.MAVLink_command_ack_message(
            command,
            result.code,
            target_system=message.get_srcSystem(),
            target_component=message.get_srcComponent(),
        )
        return [ack, *self.reason(result)]

    def refuse_setpoint(self, result: Result, t_s: float) -> list[Message]:
        """Count a setpoint that is denied, and return the reason as STATUSTEXT.

        Nothing if the same kind was told within a second.
        """
        if result.code != mavlink.MAV_RESULT_DENIED:
            return []
        self.refused[result.kind] += 1
        return [] if self.has_told(result.kind, t_s) else self.reason(result)

    def has_told(self, kind: str, t_s: float) -> bool:
        """Whether this kind of refusal was told within a second; if not, it is now."""
        if t_s - self._told_s.get(kind, -math.inf) < REFUSAL_INTERVAL_S:
            return True
        self._told_s[kind] = t_s
        return False

    def reason(self, result: Result) -> list[Message]:
        """Return the reason of a refusal as STATUSTEXT, if there is one."""
        return self.statustext(mavlink.MAV_SEVERITY_WARNING, result.reason) if result.reason else []
