"""Messages that ask for what the vehicle does not do, and that have no acknowledgement of their own:
refused in words.
"""

from collections.abc import Callable

from link.bus.mavlink import Message
from sitl.protocol.service import Microservice, Reply, asker

REASONS = {
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
"""Message type and the reason why it is refused."""
ONCE = {
    "MANUAL_CONTROL": "Manual control refused: not simulated",
    "RC_CHANNELS_OVERRIDE": "RC override refused: not simulated",
    "REQUEST_DATA_STREAM": "Data streams refused: MAV_CMD_SET_MESSAGE_INTERVAL sets rates",
}
"""Those that stations repeat as long as they run: each asker is told once."""


def _refusal(kind: str, reason: str) -> Callable[[Message, float], Reply]:
    return lambda _message, _: Reply([], reason, kind)


def _told_once(reason: str) -> Callable[[Message, float], Reply]:
    told = set()

    def answer(message: Message, _: float) -> Reply:
        new = asker(message) not in told
        told.add(asker(message))
        return Reply([], reason if new else "")

    return answer


def services() -> tuple[Microservice, ...]:
    """Return the services of one vehicle; it remembers whom it told what need not be told again."""
    return (
        *(
            Microservice(kind, _refusal(kind, reason), f"a STATUSTEXT: {reason}", supported=False)
            for kind, reason in REASONS.items()
        ),
        *(
            Microservice(
                kind, _told_once(reason), f"a STATUSTEXT, once to each asker: {reason}", supported=False
            )
            for kind, reason in ONCE.items()
        ),
    )
