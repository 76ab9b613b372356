"""The vehicle's side of the payload: one question at a time, asked again until it is answered."""

import math
import time
from collections.abc import Callable

from aircraft.payload.messages import Sample, Wind, pack_question, unpack_answer
from aircraft.state import Ned
from link.bus.backoff import Backoff
from link.bus.keys import RESEND_FIRST_S, RESEND_LAST_S
from link.bus.mavlink import Codec


class Asking:
    """Asks the payload for a value.

    Question or answer may be lost, doubled or late; the payload may start again.
    """

    def __init__(
        self, send: Callable[[bytes], None], codec: Codec, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Take what publishes on `payload/in`, the vehicle's codec, and the clock of real time, s."""
        self._send = send
        self.codec = codec  # packs the questions
        self._clock = clock
        self._open: tuple[int, bytes] | None = None  # time_boot_ms of the question, and its frames
        self._repeating = Backoff(RESEND_FIRST_S, RESEND_LAST_S)

    @property
    def waiting(self) -> bool:
        """Whether a question is open."""
        return self._open is not None

    def ask(self, time_boot_ms: int, number: int, position: Ned, wind: Wind | None) -> None:
        """Ask for reading `number` at a position (north, east, down) m.

        It replaces an open question, whose answer no longer counts.

        wind: (u cos φ, u sin φ) m/s, points to where it comes from, as the autopilot reports it; None if
        it reports none.
        """
        frames = pack_question(self.codec, time_boot_ms, number, position, wind)
        self._open = time_boot_ms, frames
        self._repeating.tried(self._clock())
        self._send(frames)

    def again(self) -> None:
        """Ask again if it is time to."""
        if self._open and self._repeating.due(self._clock()):
            self._send(self._open[1])

    def next_s(self) -> float:
        """Return when `again` is to be called, by the clock; infinity if no question is open."""
        return self._repeating.due_s if self._open else math.inf

    def receive(self, payload: bytes) -> Sample | None:
        """Return the answer to the open question, which is then closed; None for any other.

        Raises BadFrame as `unpack_answer` does.
        """
        sample = unpack_answer(payload)
        if self._open is None or sample.time_boot_ms != self._open[0]:
            return None
        self._open = None
        return sample
