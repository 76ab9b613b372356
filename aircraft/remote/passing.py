"""A real vehicle's clients: what its autopilot says is passed on to them, what they say to it.

The search is a component beside it.
"""

import contextlib
import time
from collections.abc import Callable, Sequence

from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.address import parse_address
from aircraft.bridge.bus_link import BRIDGED
from aircraft.bridge.endpoints import endpoint_of
from aircraft.bridge.links import Hub
from aircraft.bridge.routing import SETUP_SIGNING
from aircraft.operator import (
    AUTOPILOT,
    OPERATOR_IDS,
    SEARCH,
    CommandName,
    companion_heartbeat,
    named,
    word_of,
)
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.search.clock import Clock
from aircraft.search.search import Search
from aircraft.search.uav import Handling
from aircraft.state import UNSUPPORTED, Result, denied
from aircraft.words import Words
from link.bus.frames import Frame, FrameStream, fields_of
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT
from link.bus.mavlink import Codec, Message, gas_message, message_of
from link.bus.session import Arrival, Bus
from link.signing.signer import Signing

BEAT_S = 1.0  # real time between two HEARTBEATs of the search
COMMAND_IDS = {mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT}
SETPOINT_IDS = {
    mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
    mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
}
# Commands of which a change of the flight mode may come.
MODE_COMMANDS = {
    mavlink.MAV_CMD_DO_SET_MODE,
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH,
    mavlink.MAV_CMD_NAV_LAND,
    mavlink.MAV_CMD_NAV_TAKEOFF,
    mavlink.MAV_CMD_DO_REPOSITION,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE,
    mavlink.MAV_CMD_MISSION_START,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
}
POSED, WITH_KEY = "in the vehicle's name", "with a key"  # kinds of clients' frames that are dropped
# Longest real time in which a real vehicle is told to return home when this program ends; a launcher waits
# for 11 s.
LEAVE_S, LEAVE_POLL_S = 8.0, 0.02


class RealClients:
    """The clients of a real vehicle.

    Each gets every frame of the autopilot, and every word of the search, which is component 191.
    """

    component = SEARCH

    def __init__(
        self,
        vehicle: RemoteVehicle,
        search: Search,
        bus: Bus,
        outs: Sequence[str],
        clock: Clock,
        handling: Handling,
        signing: Signing | None,
    ) -> None:
        """Open the links; raises ValueError for a URL that cannot be used."""
        self._vehicle, self._search, self._bus, self._clock = vehicle, search, bus, clock
        self._handling = handling
        self._words = Words()
        self._codec: Codec | None = None  # once the system is known
        self._beat_at_s = 0.0
        self._outs = Hub(handling.log)
        for url in outs:
            self._outs.open(endpoint_of(parse_address(url), self._outs), signing)

    @property
    def system(self) -> int:
        """The autopilot's system id; 0 until one is found."""
        return self._vehicle.system

    # ---- what they are told ----

    def serve(self) -> None:
        """Pass on what has come from the autopilot and the clients of --out since the last call.

        Send a HEARTBEAT if it is due.
        """
        if frames := self._vehicle.frames():
            self._pass_on(frames)
        for link, frame in self._outs.take():
            self._hear(frame, f"at {link.who}")
        if self.system and time.monotonic() >= self._beat_at_s:
            self.changed()

    def wait_s(self) -> float:
        """Return the real time until something is due."""
        return max(self._beat_at_s - time.monotonic(), 0.0) if self.system else BEAT_S

    def changed(self) -> None:
        """Tell that the search is there, and where its area's origin is, if that is not home."""
        self._beat_at_s = time.monotonic() + BEAT_S
        self.send(companion_heartbeat(mavlink.MAV_STATE_ACTIVE))
        if (origin := self._vehicle.area_origin) is not None:
            lat_deg, lon_deg, altitude_m = origin
            self.send(
                mavlink.MAVLink_gps_global_origin_message(
                    round(lat_deg * 1e7), round(lon_deg * 1e7), round(altitude_m * 1000)
                )
            )

    def tell(self, severity: int, text: str) -> None:
        """Tell a text."""
        self.send(*self._words.statustext(severity, text))

    def measured(self, time_boot_ms: int, gas: float) -> None:
        """Tell a reading, once."""
        self.send(gas_message(time_boot_ms, gas))

    def send(self, *messages: Message) -> None:
        """Say something as the search; nothing before the autopilot is known, whose system id it has."""
        if not self.system or not messages:
            return
        codec = self._codec = self._codec or Codec(self.system, SEARCH)
        self._pass_on([codec.pack(message) for message in messages])

    def _pass_on(self, frames: Sequence[bytes]) -> None:
        self._bus.publish(MAVLINK_OUT, b"".join(frames))
        self._outs.send_all(frames)

    # ---- what they ask ----

    def take(self, arrival: Arrival) -> None:
        """Take a payload of `mavlink/in`."""
        frames = FrameStream().take(arrival.payload, datagram=True)
        if sum(len(frame.data) for frame in frames) < len(arrival.payload):
            self._bus.refuse(MAVLINK_IN, "the payload is not made of whole MAVLink frames", "malformed")
        for frame in frames:
            self._hear(frame, "through a bridge" if arrival.attachment == BRIDGED else "on the bus")

    def _hear(self, frame: Frame, whence: str) -> None:
        """Hand a client's frame on to the autopilot, if it is for that.

        The search's own commands are obeyed here.
        """
        system, tally = self.system, self._handling.log.tally
        target_system, target_component = frame.target
        if not system or target_system not in (0, system):
            return
        if frame.system == system and frame.component in (AUTOPILOT, SEARCH):
            tally.refuse(POSED)
        elif frame.message_id == SETUP_SIGNING:  # a key from a safe link must not leave by another one
            tally.refuse(WITH_KEY)
        elif target_system and target_component == SEARCH:
            if frame.message_id in COMMAND_IDS:
                with contextlib.suppress(mavlink.MAVError):
                    self._obey(message_of(frame), whence)
        elif frame.message_id in SETPOINT_IDS and self._search.leads:
            self.refuse(
                denied("Setpoint refused: the search leads, HOLD stops it", "not leading"),
                self._clock.now_s(),
            )
            tally.refuse("waypoint")
        else:
            self._vehicle.forward(
                frame.data, named((frame.system, frame.component), whence) if _changes(frame) else ""
            )

    def _obey(self, message: Message, whence: str) -> None:
        with self._handling.of(message):
            word = word_of(message.command, message.param1)
            who = named((message.get_srcSystem(), message.get_srcComponent()), whence)
            result = self._search.obey(word, self._clock.now_s(), who) if word else UNSUPPORTED
            self._say(self._words.answer(message, message.command, result))

    def refuse(self, result: Result, t_s: float) -> None:
        """Tell why a setpoint or a waypoint is refused."""
        self._say(self._words.refuse_setpoint(result, t_s))

    def operate(self, name: CommandName) -> None:
        """Obey a word of the script's operator."""
        self._say(
            self._words.reason(
                self._search.obey(name, self._vehicle.now_s, named(OPERATOR_IDS, "in the script"))
            )
        )

    def _say(self, answers: Sequence[Message]) -> None:
        if texts := [answer.text for answer in answers if answer.get_type() == "STATUSTEXT"]:
            self._handling.log.warning("".join(texts))
        self.send(*answers)

    def end(self, say: Callable[[int, str], None]) -> None:
        """See to it that a vehicle in the air has someone in charge, for at most `LEAVE_S`; close the links.

        Call it where no signal can cut it short (`link.interrupts.uninterrupted`).
        """
        vehicle, until_s, told = self._vehicle, time.monotonic() + LEAVE_S, False
        while True:
            with contextlib.suppress(Exception):  # whatever fails, the way home is asked for again
                if (said := vehicle.leave()) and not told:
                    told = True
                    say(mavlink.MAV_SEVERITY_WARNING, said)
            with contextlib.suppress(Exception):
                vehicle.catch_up(self._clock.now_s())
            if vehicle.left or time.monotonic() >= until_s:
                break
            time.sleep(LEAVE_POLL_S)
        if not vehicle.left:
            say(mavlink.MAV_SEVERITY_CRITICAL, "The vehicle has not answered: its keeper goes on")
        self._outs.close()


def _changes(frame: Frame) -> bool:
    """Whether a change of the flight mode may come of a frame."""
    if frame.message_id not in COMMAND_IDS:
        return bool(frame.message_id == mavlink.MAVLINK_MSG_ID_SET_MODE)
    fields = fields_of(frame)
    arms = fields["command"] == mavlink.MAV_CMD_COMPONENT_ARM_DISARM and fields["param1"] == 1.0
    return fields["command"] in MODE_COMMANDS and not arms
