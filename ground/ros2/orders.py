"""What ROS asks of the vehicle, sent to it as a ground station's commands. A pilot's are never overridden."""

import math
import re
from collections import deque
from contextlib import suppress
from typing import Any

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import AUTOPILOT, SEARCH, CommandName, CommandRun, order
from ground.ros2.rmw import ATTACHMENT_BYTES, is_attachment
from ground.ros2.topics import ABORT, GOAL, Topic
from ground.ros2.wire import BadMessage, Wire
from link.access.roles import ros_namespace
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT
from link.bus.mavlink import BadFrame, Codec, Message, Texts
from link.bus.messages import Health
from link.bus.session import Arrival, Bus
from link.record.own import OWN_HEALTH
from plume.geodesy import to_global
from plume.problem import FARTHEST_M
from scene.follow.history import History
from scene.follow.telemetry import TEXT, frames

# System and component id of what ROS asks for, by which the vehicle says who has taken it from its search.
ROS_IDS = (255, int(mavlink.MAV_COMP_ID_UDP_BRIDGE))
BY_US = f" by {ROS_IDS[0]}/{ROS_IDS[1]} on the bus"
TAKEN = re.compile(r"(?:Search gives way: )?.+ by .+")  # how the vehicle says who has taken it
GIVEN_BACK = "Search resumed by "
ACK = mavlink.MAVLINK_MSG_ID_COMMAND_ACK
AGAIN_S = 0.4  # time after which a command that nobody has acknowledged is sent again
MOST, WITHIN_S = 5, 1.0  # most commands in so many seconds; an abort is always taken
MALFORMED, REFUSED = "malformed", "command"  # kinds of refusals
# The same refusal is told again after so many seconds, and meanwhile at most so many others.
TOLD_S, MOST_TOLD = 10.0, 20
FLYING_ITSELF = ("taking off", "searching")  # states in which the search leads
FLYING = (*FLYING_ITSELF, "paused", "holding", "returning")
NOBODY, US, OTHERS = "nobody", "us", "others"


class Refusal(ValueError):
    """A command that is not passed on; the text gives the reason."""


class Lead:
    """Who has the vehicle, from what it says: its search, we, or others, whose commands stand."""

    def __init__(self) -> None:
        self._state = ""
        self._watched = False  # whether the search was seen to lead: nobody had taken the vehicle until then
        self._taken = NOBODY  # who has taken it since

    def is_in(self, state: str) -> None:
        """Take the state that the vehicle's health says."""
        if state in FLYING_ITSELF:
            self._watched = True
            if self._state not in FLYING_ITSELF:
                self._taken = NOBODY
        self._state = state

    def hears(self, text: str) -> None:
        """Take a text of the vehicle or its search."""
        if text.startswith(GIVEN_BACK):
            self._taken = NOBODY
        elif TAKEN.fullmatch(text):
            self._taken = US if text.endswith(BY_US) else OTHERS

    def obeyed(self) -> None:
        """The vehicle has obeyed us, unless others have taken it meanwhile."""
        if self._taken == NOBODY:
            self._taken = US

    def refusal(self) -> str:
        """Return why we may not command; empty if we may."""
        if self._state not in FLYING:
            return f"the search flies nothing: the vehicle is {self._state or 'not heard'}"
        ours = self._taken == US
        unknown = not self._watched or (self._state == "paused" and not ours)
        if self._taken == OTHERS or (unknown and not ours):
            return "a pilot or another program has the vehicle; it has to be given back to the search first"
        return ""


class RosOrders:
    """Passes commands of ROS on, one at a time: the newest counts. Use it in one thread."""

    def __init__(self, bus: Bus, wire: Wire) -> None:
        """Take the vehicle's bus, and what decodes the commands."""
        self._bus, self._wire = bus, wire
        self._lead, self._texts, self._codec = Lead(), Texts(), Codec(*ROS_IDS)
        self._times_s: deque[float] = deque(maxlen=MOST)
        self._told: dict[str, float] = {}  # the refusals of the last TOLD_S that were told, and when
        self._run: CommandRun | None = None
        self._what = self._reason = ""
        self._asked = 0, AUTOPILOT  # system and component that the command is for

    def hears(self, it: Arrival, history: History, now_s: float) -> None:
        """Take what the vehicle says. history: it has taken the message already."""
        with suppress(BadFrame, msgspec.DecodeError, RecursionError):
            if it.name == OWN_HEALTH:
                self._lead.is_in(msgspec.json.decode(it.payload, type=Health).state)
            elif it.name == MAVLINK_OUT.name:
                for frame, fields in frames(it.payload, {ACK, TEXT}):
                    if not (history.own.sent(frame) or history.own.searched(frame)):
                        continue
                    if frame.message_id == TEXT:
                        self._hears_text(fields)
                    elif self._run and (frame.system, frame.component) == self._asked and _to_us(fields):
                        self._run.acknowledged(fields["command"], fields["result"], now_s)

    def _hears_text(self, fields: dict[str, Any]) -> None:
        """Take a STATUSTEXT. The one that follows a refusal has its reason."""
        if text := self._texts.joined(fields["text"], fields["id"], fields["chunk_seq"]):
            self._lead.hears(text)
            if self._run and self._run.refused:
                self._reason = text

    def take(self, topic: Topic, data: bytes, attached: bytes, history: History, now_s: float) -> None:
        """Take a message of a command's topic. One that is not obeyed is counted and told.

        now_s: by time.monotonic().
        """
        try:
            if not is_attachment(attached):
                raise BadMessage(f"it has no attachment of {ATTACHMENT_BYTES} bytes, as ROS gives it")
            message = self._wire.decode(topic.kind, data)
            what, component, command = self._command(topic, message, history)
            if reason := self._lead.refusal():
                raise Refusal(reason)
            if topic is not ABORT and len(self._times_s) == MOST and now_s - self._times_s[0] < WITHIN_S:
                raise Refusal(f"more than {MOST} commands within {WITHIN_S:g} s")
        except (BadMessage, Refusal) as error:
            kind = REFUSED if isinstance(error, Refusal) else MALFORMED
            self._refuse(topic.name, str(error), kind, now_s)
            return
        self._times_s.append(now_s)
        self._what, self._reason, self._asked = what, "", (history.own.system, component)
        self._run = run = CommandRun(command, lambda: run.accepted, lambda: self._reason, AGAIN_S)
        self._bus.log.info(f"ROS asks: {what}")
        self.go_on(now_s)

    def go_on(self, now_s: float) -> None:
        """Send the command again if that is due, and tell what became of it. now_s: by time.monotonic()."""
        if (run := self._run) is None:
            return
        if (result := run.over(now_s)) is None:
            if copy := run.send(now_s):
                self._bus.publish(MAVLINK_IN, self._codec.pack(copy))
            return
        self._run = None
        if result.accepted:
            self._lead.obeyed()
            self._bus.log.info(f"the vehicle obeys: {self._what}")
        else:
            self._refuse(self._what, result.reason, REFUSED, now_s)

    def _refuse(self, what: str, reason: str, kind: str, now_s: float) -> None:
        """Count a refusal, and log it unless that floods the log: a node may ask fifty times a second."""
        self._bus.tally.refuse(kind)
        said = f"refused {what}: {reason[:300]}"
        self._told = {told: at_s for told, at_s in self._told.items() if now_s - at_s < TOLD_S}
        if said not in self._told and len(self._told) < MOST_TOLD:
            self._told[said] = now_s
            self._bus.log.warning(said)

    def _command(self, topic: Topic, message: Any, history: History) -> tuple[str, int, Message]:
        """Return a command in words, the component it is for, and the MAVLink message. Raises Refusal."""
        system = history.own.system
        if not system:
            raise Refusal("no vehicle has been heard")
        if topic is GOAL:
            return self._goal(message, history, system)
        word: CommandName = "return" if topic is ABORT else "hold" if message.data else "resume"
        component = SEARCH if history.is_real else AUTOPILOT
        return word, component, order(word, system, component)

    def _goal(self, message: Any, history: History, system: int) -> tuple[str, int, Message]:
        own = f"{ros_namespace(history.backdrop.vehicle).removeprefix('/')}/map"
        place, frame = message.pose.position, message.header.frame_id
        if frame.removeprefix("/") not in ("", own):
            raise Refusal(f"its frame is {frame[:100]!r}; wanted {own}, or none")
        if not (abs(place.x) <= FARTHEST_M and abs(place.y) <= FARTHEST_M and 0.0 <= place.z <= FARTHEST_M):
            raise Refusal(f"its position is below home, or not within {FARTHEST_M:,.0f} m of it")
        if history.home is None or history.craft is None:
            raise Refusal("the vehicle has not told yet where its home is")
        up_m = place.z or history.craft.altitude_m
        latitude, longitude, altitude_m = (
            *to_global(*history.home[:2], place.y, place.x),
            history.home[2] + up_m,
        )
        go_to = mavlink.MAVLink_command_int_message(
            system,
            AUTOPILOT,
            mavlink.MAV_FRAME_GLOBAL,
            mavlink.MAV_CMD_DO_REPOSITION,
            0,
            0,
            -1.0,  # at the usual speed
            mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE,
            0.0,
            math.nan,  # with the heading as it is
            round(1e7 * latitude),
            round(1e7 * longitude),
            altitude_m,
        )
        return f"go to ({place.x:.2f}, {place.y:.2f}) m, {up_m:.2f} m up", AUTOPILOT, go_to


def _to_us(fields: dict[str, Any]) -> bool:
    return fields["target_system"] in (0, ROS_IDS[0]) and fields["target_component"] in (0, ROS_IDS[1])
