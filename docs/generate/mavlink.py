"""The generator of docs/mavlink.md: what the simulated vehicle supports, refuses and lacks.

`make docs` calls it. The page is made from the tables that the code runs by.
"""

from collections.abc import Iterable, Sequence
from textwrap import fill

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import LAYOUTS
from link.modes import Mode
from sitl.autopilot.commands import COMMANDS, REQUESTED
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.lists import ACTION_S, MOST_ITEMS, RETRY_S
from sitl.autopilot.parameters import PARAMETERS, REAL, Parameters
from sitl.autopilot.plan import FLOWN, IGNORED
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.services import REFUSED, REFUSED_ONCE
from sitl.autopilot.telemetry import FLIGHT_SW_VERSION, STREAMS
from sitl.autopilot.vehicle import Vehicle

WIDTH = 148
"""Most characters of a line of prose."""
FLIES = "arming, take-off, setpoints of position and velocity, landing"
TRIED = (
    (
        "MAVSDK",
        "4.1.0",
        f"{FLIES}; missions with progress, fences, rally points, parameters; what is refused",
    ),
    (
        "MAVSDK",
        "3.17.4",
        "arming, take-off, setpoints of position, landing, return; parameters; what is refused",
    ),
    (
        "MAVProxy",
        "1.8.75",
        "`arm`, `takeoff`, `guided`, `wp`, `fence`, `rally`, `param`, `log`, `ftp`, `long`, `signing`. Its "
        "`mode` fails with every "
        "PX4 vehicle; `long DO_SET_MODE 1 4 5` returns, with the numbers of the modes",
    ),
    (
        "QGroundControl",
        "its requests, by pymavlink 2.4.50",
        "its start; the sliders and buttons for take-off, go-to, pause, altitude, return; parameters; plans, "
        "fences and rally points",
    ),
)
"""Client, version, and what the tests in tests/clients/ and tests/system/test_mavsdk.py do with it."""

PAGE = """\
# MAVLink

What the built-in vehicle says to ground stations and companion computers. It behaves as a PX4 quadrotor. Every request gets data or a
refusal: a COMMAND_ACK, an answer of the request's own kind, or a STATUSTEXT. The tables are those that the code runs by, in `sitl/autopilot/`.
[Services](services.md#the-vehicle-and-its-mavlink) says how to connect, and who leads.

## Modes

By PX4's numbers, main and sub: {modes}. All other modes of PX4 are denied.

## Commands

By COMMAND_LONG or COMMAND_INT; SET_MODE does the same as MAV_CMD_DO_SET_MODE. A refused command says why in a STATUSTEXT. All others, those of
cameras, gimbals, storage and calibration among them, get MAV_RESULT_UNSUPPORTED.

{commands}

Take-off may come before arming, as from QGroundControl's slider: the vehicle waits in mode Takeoff until it is armed, for COM_DISARM_PRFLT at
most, then goes back to Hold.

## Messages

Sent at this rate on each link, or on request. MAV_CMD_SET_MESSAGE_INTERVAL sets other rates, and MAV_CMD_REQUEST_MESSAGE asks for one.

{streams}

PX4's onboard link streams ATTITUDE_QUATERNION and HIGHRES_IMU at 50 Hz and ODOMETRY at 30 Hz. Here they come on request: the three would more
than double what a mission records.

## Requests

{requests}

## Setpoints

SET_POSITION_TARGET_LOCAL_NED is flown in OFFBOARD: a position, a velocity, a horizontal velocity at a height, or an acceleration, in LOCAL_NED or
BODY_NED. SET_POSITION_TARGET_GLOBAL_INT is the same with a global position, its altitude above the sea, above home or above the ground, which is
level.

A setpoint is never acknowledged. A refused one gets a STATUSTEXT once a second for each kind of reason. Frames, type masks and NaN (a value that is
ignored) are read as PX4 1.15 reads them, with these choices:

- Beside a position a velocity or an acceleration is ignored; to PX4 it is feed-forward. So is an acceleration beside a velocity.
- A velocity is reached along a straight line in velocity space, at the acceleration limit. It is cut to the speed limits; its horizontal part keeps
  its direction. Velocity 0 holds.
- A velocity x, y with a position z flies at that height. Other mixtures are refused.
- An acceleration acts until a speed limit is reached; then the vehicle cruises. Acceleration 0 keeps the velocity.
- A velocity or an acceleration never leads out of the area, above the ceiling or into the ground: the vehicle brakes in time, comes to rest on the
  edge and says so once. It goes on if the setpoint leads along the edge or back inside. What touches the ground has landed. A fence is no edge: to
  fly through it is a breach, as GF_ACTION says.
- BODY_NED turns velocities and accelerations by the yaw; PX4 turns accelerations by roll and pitch, too. It has no positions.
- A yaw rate turns until told otherwise: by a setpoint without it, or another mode.
- A setpoint answers no reading, whatever its time: the agent's answers have a [key of their own](bus.md#frames).
- At speed-up 0 time jumps to the end of each way, so velocities and strict streams need a speed-up above 0.

OFFBOARD returns home when no setpoint comes for COM_OF_LOSS_T: `--silence` (30) seconds of real time, which is kind to people who try things by
hand. With `--strict` it is as in PX4, for those who test a companion: COM_OF_LOSS_T is 1 s of real time, and OFFBOARD and arming in it are refused
unless setpoints come at 2 Hz or more. The first setpoint of a stream is enough, as in PX4's code (`offboardCheck.cpp`). While the vehicle's own
search leads, it counts as a companion that streams, and its silence is allowed for `--silence` seconds.

## Missions, fences, rally points

Uploads and downloads follow MAVLink's mission protocol, by MISSION_ITEM_INT, or MISSION_ITEM from old stations. Type 0 is the mission, 1 the fence,
2 the rally points. They hold at most {limits} items, in memory: a vehicle that is started anew has forgotten them. An upload replaces the
whole list once its last item is there; until then, and if it fails, the old list stays. A missing item is asked for again after {retry:g} s, and
after {action:g} s without an item the vehicle gives up, both in real time. While one client uploads, others get MAV_MISSION_ERROR. Downloads are
answered to everyone at any time.

A mission is checked item by item when it is uploaded, and again when it starts. An item outside the area, the altitudes or the fence is refused with
MAV_MISSION_INVALID_PARAM5_X or 7. Items other than these are refused with MAV_MISSION_UNSUPPORTED, MAV_CMD_DO_SET_HOME among them.

{items}

- The vehicle comes to rest at each item. Without a yaw (NaN) the heading stays. From the ground it first climbs straight up, at least to
  MIS_TAKEOFF_ALT.
- An item is done (MISSION_ITEM_REACHED) after its flight, its turn and its wait. With autocontinue 0 the vehicle then stays.
- At the end it holds. The next start begins with the first item. A pause is HOLD, and a resume goes on with the current item.
- A mission that is uploaded or cleared in flight replaces the one that is flown: the vehicle begins the new one, or holds.
{ignored}

The fence consists of polygons and circles, inclusions (5001, 5003) and exclusions (5002, 5004). All have to be kept; their altitudes are ignored.
Home must be inside, and the vehicle if it flies. Setpoints, go-to, take-off and mission items outside are refused. A straight way that leaves the
fence, through an exclusion, is a breach at its exact time, and GF_ACTION says what happens then. The vehicle stops as fast as it can, so it ends
behind the edge. A vehicle that returns or lands already goes on. FENCE_STATUS comes on request; PX4 does not send it. MAV_CMD_DO_FENCE_ENABLE is
unsupported, as in PX4.

Rally points (5100) lie inside area and fence. A return goes to the nearest of home and rally points, as PX4's RTL_TYPE 0, and lands there.

## Parameters

A parameter acts as soon as it is set, a speed or an acceleration from the next leg on, so it is safe in flight. Times are in simulation time. What
is set lasts as long as the process. Integers are packed bytewise, as PX4 does. A value outside the range is refused: the old value comes back, and a
STATUSTEXT names what is allowed.

{parameters}

{fixed}

## Signing

Without signing, whoever reaches a UDP port of the vehicle commands it, up to motors off in the air. `--sign KEYFILE` of `fly`, `uav` and `bridge`
turns on [MAVLink 2 signing](https://mavlink.io/en/guide/message_signing.html): what is sent is signed, and what comes without a valid signature is
refused.

```sh
(umask 077; python -c 'import secrets; print(secrets.token_hex(32))' > fleet.key)
plumeward uav --out udpin:127.0.0.1:14550 --sign fleet.key
```

The key file holds one line. 64 hexadecimal digits are the key itself. Any other line is a passphrase, and the key is its SHA-256, as elsewhere:

| program | with a passphrase | with 64 digits |
| --- | --- | --- |
| MAVProxy | `signing key PASSPHRASE` | |
| QGroundControl, Mission Planner | their settings of MAVLink 2 signing | |
| pymavlink | `connection.setup_signing(hashlib.sha256(b"PASSPHRASE").digest())` | `connection.setup_signing(bytes.fromhex("..."))` |
| MAVSDK 4 | cannot sign | cannot sign |

Where pymavlink speaks first (`udpout:`), set `MAVLINK20=1` in its environment: else it begins with MAVLink 1, which cannot be signed. One recorded
frame is enough to try passphrases at home, so take a long one. Make the file readable for yourself alone (`chmod 600`); if not, a warning says so.

`--out` of `fly` and `uav` and the bridge's UDP and TCP endpoints are signed in both directions; the bridge verifies and removes signatures, and
signs anew. Its serial lines are not: they are taken for a safe cable. Nor is the bus, access to which is a matter of TLS, so records hold no
signatures. An endpoint that cannot sign, such as a simulated autopilot on the same machine, belongs in a bridge of its own, without `--sign`. Such a
bridge passes signed frames as they are, so a station and an autopilot that share a key can sign end to end.

| refused | is |
| --- | --- |
| `without a signature` | unsigned, or MAVLink 1, which cannot be signed |
| `with a wrong signature` | signed with another key, or changed on its way |
| `with an old timestamp` | a frame that came before, or of a sender whose clock is more than a minute behind |
| `with a timestamp more than 10 minutes ahead of this machine's clock` | a sender's clock is wrong, or this one's |

Each sender is named once for each reason, up to 16 a link. All are counted, in `health`, by `plumeward status` and in the bridge's last lines. Only
RADIO_STATUS passes without a signature, as the standard has it: radios have no key. Its sender does not become a peer of `udpin`. SETUP_SIGNING
(256) is never obeyed, and no bridge passes it on: keys travel in files.

Timestamps only go forward, also across restarts, kills, and clocks that step back. The last ones are in a file beside the key, written every second:
`fleet.key.uav-1` for the vehicle with system id 1, `fleet.key.bridge-uav-1` for the bridge of `uav/1`. One process at a time uses it. Without it,
frames recorded in the last minute before a restart would be taken again; a power cut costs one second.

What signing does not do:

- It hides nothing. Everyone who sees a link can read it, and a TCP client hears the telemetry without a key.
- All who have the key are equal: each can speak for each system id. Two stations need different ids, since timestamps count for each id.
- A frame names no receiver and has no date of expiry. One that somebody holds back is taken when it comes, as long as no later one of the same
  sender and link has come; of a sender that is new, within a minute. So is one that was sent to another process with the same key.
- A sender that is ahead of the clock takes all others along, as the standard wants it: one that then starts with the right time is refused until the
  clocks have caught up, for 10 minutes at most. A warning names the first one that is more than a minute ahead.
- A clock before 2015 is set by whoever signs, as the standard has it: one frame of the far future makes the vehicle deaf to the right time. Start it
  again with its clock set and without that file. A clock that is set but late, as after a reboot, refuses all that is 10 minutes ahead. Set it
  before the flight, by NTP or GPS.

## Who it says it is

AUTOPILOT_VERSION gives the PX4 version {version} whose protocol it speaks, since stations warn of old ones. `flight_custom_version` holds
Plumeward's own version, as PX4's vendors write it (patch, minor, major), and the letters `plume`. `uid2` begins with `plumeward`.

## Missing

- Setpoints of attitude, body rates, thrust and actuators.
- LOG_REQUEST_END gets no answer: it ends a download, and there is none.
- Commands that take time get one COMMAND_ACK, without progress.
- COMPONENT_METADATA: unsupported, as by a PX4 without the files. Events, as PX4 has had since 1.13: only STATUSTEXT.

## Fly it from your own code

`docs/examples/offboard.py` starts the vehicle at four times real time, takes off, flies two setpoints and lands. Its `fly()` flies PX4's simulated
vehicle as well, which sends to the same port. It needs version 4 of the package `mavsdk`; version 3 has other modules. `.venv` has version 3, and
`make setup` installs version 4 beside it: with `.venv` active, run the example with `.venv/clients/mavsdk4/bin/python`.

## Tried with

{tried}

The tests in `tests/clients/` do this on each change; MAVSDK 4 and QGroundControl's requests also over a link that loses 5% of the frames in both
directions.
"""


def document() -> str:
    """Return the page."""
    vehicle = Vehicle(VehicleConfig())
    services = MavlinkProtocol(vehicle).services.values()
    names = {number: entry.name for number, entry in mavlink.enums["MAV_CMD"].items()}
    requested = [(LAYOUTS[number].kind, number, "on request", row.says) for number, row in REQUESTED.items()]
    streams = [
        (LAYOUTS[row.message_id].kind, row.message_id, _rate(row.rate_hz), _says(row.build))
        for row in STREAMS
    ]
    values = Parameters(vehicle)
    return PAGE.format(
        tried=_table(("client", "version", "what"), TRIED),
        modes=", ".join(
            f"{mode.name.capitalize()} {main} {sub}" for mode in Mode for main, sub in [mode.value]
        ),
        commands=_table(
            ("command", "number", "does"),
            ((names[number], number, row.does) for number, row in COMMANDS.items()),
        ),
        streams=_table(("message", "number", "rate", "says"), [*streams, *requested]),
        requests=_table(
            ("request", "answer"),
            _grouped(
                [
                    *((row.request, row.says) for row in sorted(services, key=lambda row: not row.supported)),
                    *((kind, f"a STATUSTEXT: {reason}") for kind, reason in REFUSED.items()),
                    *(
                        (kind, f"a STATUSTEXT, once to each asker: {reason}")
                        for kind, reason in REFUSED_ONCE.items()
                    ),
                ]
            ),
        ),
        parameters=_table(
            ("parameter", "type", "default", "is", "allowed"),
            (
                (
                    p.name,
                    "REAL32" if p.kind == REAL else "INT32",
                    f"{values.value(p):.9g}",
                    p.about,
                    p.allowed.removeprefix("allowed is "),
                )
                for p in PARAMETERS
                if p.field
            ),
        ),
        fixed=fill(
            "Others can be read, and not set: "
            + "; ".join(f"{p.name} {values.value(p):.9g} ({p.about})" for p in PARAMETERS if not p.field),
            WIDTH,
        ),
        limits=f"{MOST_ITEMS[0]}, {MOST_ITEMS[1]} and {MOST_ITEMS[2]}",
        retry=RETRY_S,
        action=ACTION_S,
        items=_table(
            ("item", "number", "does"), ((names[number], number, says) for number, says in FLOWN.items())
        ),
        ignored=fill(
            "- Items for a camera or a gimbal are taken and passed over, as by a PX4 that has neither: "
            + ", ".join(names[number].removeprefix("MAV_CMD_") for number in sorted(IGNORED)),
            WIDTH,
            subsequent_indent="  ",
        ),
        version=".".join(map(str, FLIGHT_SW_VERSION[:3])),
    )


def _rate(rate_hz: float) -> str:
    return f"{rate_hz:g} Hz" if rate_hz else "on request"


def _says(build: object) -> str:
    """What a message says: the first paragraph of its builder, behind the message's name."""
    paragraph = " ".join((build.__doc__ or "").partition("\n\n")[0].split())
    return paragraph.partition(": ")[2].rstrip(".")


def _grouped(rows: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return one row for each answer, with all requests that get it."""
    requests: dict[str, list[str]] = {}
    for request, answer in rows:
        requests.setdefault(answer, []).append(request)
    return [(", ".join(several), answer) for answer, several in requests.items()]


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


if __name__ == "__main__":
    print(document(), end="")
