"""The page of what the vehicle supports, refuses and lacks (`docs/mavlink.md`), made from the tables that the code runs by."""

from collections.abc import Iterable, Sequence

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import LAYOUTS
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.state import Mode
from sitl.autopilot.status import FLIGHT_SW_VERSION
from sitl.autopilot.telemetry import STREAMS
from sitl.autopilot.vehicle import Vehicle
from sitl.protocol.companions import EXAMPLE, TRIED
from sitl.protocol.parameters import PARAMETERS, REAL, Parameters
from sitl.protocol.protocol import COMMANDS, REQUESTED, MavlinkProtocol

PAGE = """\
# MAVLink

What the built-in vehicle says to ground stations and companion computers. It behaves as a PX4 quadrotor. Every request gets data or a
refusal: a COMMAND_ACK, an answer of the request's own kind, or a STATUSTEXT. This page is made from the tables of the code,
in `sitl/protocol/` and `sitl/autopilot/telemetry.py`.
[Services](services.md#the-vehicle-and-its-mavlink) says how to connect, and who leads.

## Modes

{modes}

All other modes of PX4 are denied.

## Commands

By COMMAND_LONG or COMMAND_INT; SET_MODE does the same as MAV_CMD_DO_SET_MODE. A refused command says why in a STATUSTEXT.

{commands}

All others, those of cameras, gimbals, storage and calibration among them, get MAV_RESULT_UNSUPPORTED.

## Messages

Sent at this rate on each link, or on request. MAV_CMD_SET_MESSAGE_INTERVAL sets other rates, and MAV_CMD_REQUEST_MESSAGE asks for one.

{streams}

PX4's onboard link streams ATTITUDE_QUATERNION and HIGHRES_IMU at 50 Hz and ODOMETRY at 30 Hz. Here they come on request, because the three
would more than double what a mission records. SYSTEM_TIME has no date, and HIGHRES_IMU no compass and no pressure: they are not simulated.

## Requests that are answered

SET_POSITION_TARGET_LOCAL_NED is a waypoint: a position in LOCAL_NED, with or without a yaw. It is never acknowledged; a refused one gets a
STATUSTEXT once a second.

{answered}

## Requests that are refused

{refused}

## Parameters

A parameter acts as soon as it is set. A change of speed or acceleration acts from the next leg on, so it is safe in flight. Times are in
simulation time. What is set lasts as long as the process. Integers are packed bytewise, as PX4 does.

{parameters}

A value outside the range is refused: the old value comes back, and a STATUSTEXT names what is allowed.

## Who it says it is

AUTOPILOT_VERSION gives the PX4 version {version} whose protocol it speaks, since stations warn of old ones. `flight_custom_version` holds
Plumeward's own version, as PX4's vendors write it (patch, minor, major), and the letters `plume`. `uid2` begins with `plumeward`.

## Missing

- Missions, fences and rally points; setpoints of velocity, acceleration and attitude; global setpoints.
- Take-off while disarmed. MAVSDK arms first; QGroundControl's slider does not.
- Commands that take time get one COMMAND_ACK, without progress.
- MAVLink signing: signed frames are read, their signature is not checked.
- COMPONENT_METADATA: unsupported, as by a PX4 without the files. Events, as PX4 has had since 1.13: only STATUSTEXT.

## Fly it from your own code

The example needs the package `mavsdk`, version 4. It starts the vehicle at four times real time, takes off, flies two setpoints and lands.
PX4's simulated vehicle sends to the same port, so `fly` flies it as well.

```python
{example}```

## Tried with

{tried}

The tests in `tests/clients/` do this on each change. MAVSDK 4 and QGroundControl's requests are also tried over a link that loses 5% of the
frames in both directions.
"""


def document() -> str:
    """Return the page."""
    vehicle = Vehicle(VehicleConfig())
    services = MavlinkProtocol(vehicle).services.values()
    names = {number: entry.name for number, entry in mavlink.enums["MAV_CMD"].items()}
    requested = [(LAYOUTS[number].kind, number, "on request", says.partition(": ")[2]) for number, says in REQUESTED.items()]
    streams = [(LAYOUTS[row.message_id].kind, row.message_id, _rate(row.rate_hz), _says(row.build)) for row in STREAMS]
    values = Parameters(vehicle)
    return PAGE.format(
        example=EXAMPLE,
        tried=_table(("client", "version", "what"), TRIED),
        modes=_table(("mode", "PX4 main", "sub"), ((mode.name.capitalize(), *mode.value) for mode in Mode)),
        commands=_table(("command", "number", "does"), ((f"{names[number]}", number, says) for number, says in COMMANDS.items())),
        streams=_table(("message", "number", "rate", "says"), [*streams, *requested]),
        answered=_table(("request", "answer"), ((row.request, row.says) for row in services if row.supported)),
        refused=_table(("request", "answer"), ((row.request, row.says) for row in services if not row.supported)),
        parameters=_table(
            ("parameter", "type", "default", "is", "may be set"),
            (
                (
                    p.name,
                    "REAL32" if p.kind == REAL else "INT32",
                    f"{values.value(p):.9g}",
                    p.about,
                    p.allowed.removeprefix("allowed is ") if p.field else "no",
                )
                for p in PARAMETERS
            ),
        ),
        version=".".join(map(str, FLIGHT_SW_VERSION[:3])),
    )


def _rate(rate_hz: float) -> str:
    return f"{rate_hz:g} Hz" if rate_hz else "on request"


def _says(build: object) -> str:
    """What a message says: the first line of its builder, behind the message's name."""
    return (build.__doc__ or "").splitlines()[0].partition(": ")[2].rstrip(".")


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
