"""The autopilot's MAVLink, as a PX4 speaks it: messages in; acknowledgements, messages and texts out."""

import time
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Result, denied
from aircraft.words import Words
from link.bus.mavlink import Message
from sitl.autopilot.commands import COMMANDS, CommandRequest, obey, params, set_custom_mode
from sitl.autopilot.lists import PlanService
from sitl.autopilot.parameters import Parameters
from sitl.autopilot.services import REFUSED, REFUSED_ONCE, SERVICES, Microservice, Reply, Request
from sitl.autopilot.setpoint import GLOBAL, LOCAL, read
from sitl.autopilot.telemetry import Telemetry
from sitl.autopilot.vehicle import Vehicle

COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1


class MavlinkProtocol(Words):
    """Handles the MAVLink messages of all clients of one vehicle and builds the answers.

    The clock is real time, s: clients live in it.
    """

    def __init__(self, vehicle: Vehicle, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._vehicle = vehicle
        self.plans = PlanService(vehicle, clock)
        self._parameters = Parameters(vehicle)
        # By the type of message that each takes.
        self.services: dict[str, Microservice] = {
            service.request: service
            for service in (*self._parameters.services, *SERVICES, *self.plans.services)
        }
        self._told: set[tuple[str, int, int]] = set()  # (message type, sender) of texts that are sent once

    def receive(self, message: Message, t_s: float, streams: Telemetry | None = None) -> list[Message]:
        """Handle a message received at `t_s`; return the answers, to be sent back over the same link.

        Messages to another system or component get no answer. `streams` is the telemetry of the link:
        requests for messages and rates act on it; without it they are unsupported.
        """
        self._vehicle.catch_up(t_s)
        if not self.is_addressed(message):
            return []
        request, kind = Request(message, t_s, streams), message.get_type()
        match kind:
            case "COMMAND_LONG" | "COMMAND_INT":
                return self._command(request)
            case "SET_MODE":
                main, sub = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24
                result = set_custom_mode(self._vehicle, t_s, message.base_mode, main, sub)
                return self.answer(message, mavlink.MAVLINK_MSG_ID_SET_MODE, result)
            case _ if kind in (LOCAL, GLOBAL):
                setpoint = read(message, self._vehicle.config, self._vehicle.state(t_s).yaw)
                if not isinstance(setpoint, Result):
                    setpoint = self._vehicle.setpoint(t_s, setpoint)
                return self.refuse_setpoint(setpoint, t_s)
            case _ if kind in REFUSED:
                return [] if self.has_told(kind, t_s) else self.reason(denied(REFUSED[kind]))
            case _ if kind in REFUSED_ONCE:
                is_new = (kind, *request.asker) not in self._told
                self._told.add((kind, *request.asker))
                return self.reason(denied(REFUSED_ONCE[kind])) if is_new else []
            case _ if kind in self.services:
                return self._said(self.services[kind].answer(request))
        return []

    def due(self, streams: Telemetry) -> list[Message]:
        """Return what to send again over a link, of the telemetry `streams`: a client has not answered."""
        return self._said(self.plans.due(streams))

    def is_addressed(self, message: Message) -> bool:
        """True unless a message is for others, or comes from our own ids: PX4 ignores those, too."""
        ours = self._vehicle.config.sysid, COMPONENT
        if (message.get_srcSystem(), message.get_srcComponent()) == ours:
            return False
        return all(
            getattr(message, f"target_{name}", 0) in (0, own)
            for name, own in zip(("system", "component"), ours, strict=True)
        )

    def _command(self, request: Request) -> list[Message]:
        message = request.message
        known = COMMANDS.get(message.command)
        if message.target_system == 0 and not (known and known.for_all):
            return self.refuse(
                message,
                Result(mavlink.MAV_RESULT_FAILED, "Command refused: sent to all, wanted one vehicle"),
            )
        answers: list[Message] = []
        asked = CommandRequest(self._vehicle, self._parameters, request.t_s, request.streams, answers)
        ack, *reason = self.answer(message, message.command, obey(message.command, asked, params(message)))
        return [ack, *answers, *reason]

    def _said(self, reply: Reply) -> list[Message]:
        return [*reply.messages, *self.reason(denied(reply.reason))]
