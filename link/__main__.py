"""`python -m link`: prints docs/bus.md, the bus contract, made from the table of keys and the message types."""

from typing import Any

import msgspec

from link.bus.inbox import WAITING_BYTES, WAITING_MESSAGES
from link.bus.keys import KEYS, Key
from link.bus.session import DEFAULT_ROUTER

HEAD = f"""# The bus

Made from `link/bus/keys.py` and `link/bus/messages.py` by `make docs`; a test keeps it up to date. It says all that a client in any
language needs: any of vehicle, estimator and agent can be replaced by one that keeps to this page.

## Joining

Connect as a Zenoh 1.x **client** to a router (`{DEFAULT_ROUTER}` unless said otherwise; a mission prints its own), multicast scouting
off. A router relays clients, not peers. Every key below lies under the vehicle's namespace, `uav/<id>`, so the belief of vehicle 1
is on `uav/1/belief`. Set `namespace` in the Zenoh configuration, or write the full keys.

## Keys
"""

MIB = WAITING_BYTES // 2**20
RULES = f"""
## Frames

MAVLink 2, dialect `common`, as they would go over a serial line; a payload may hold several. The vehicle is system `<id>`,
component 1 (autopilot); the agent is system `<id>`, component 191 (onboard computer). `target_system` is the vehicle's id or 0.

A **reading** is one payload with three frames of one time:

| message | fields that count |
|---|---|
| LOCAL_POSITION_NED (32) | `time_boot_ms`; `x` = north, `y` = east, `z` = down from home, m: where the sample was taken |
| WIND_COV (231) | `time_usec` = 1000 · `time_boot_ms`; `wind_x` = north, `wind_y` = east: velocity of the air, m/s |
| NAMED_VALUE_FLOAT (251) | `time_boot_ms`; `name` = `gas`; `value` in g/m³, or a count of hits |

Its frames are of the vehicle's system: a reading of another system is refused.

A **waypoint** is a SET_POSITION_TARGET_LOCAL_NED (84) in MAV_FRAME_LOCAL_NED with `x`, `y`, `z` used, whose `time_boot_ms` is that of the
reading it answers. Commands (COMMAND_LONG, COMMAND_INT) are answered by COMMAND_ACK on `mavlink/out`, a refusal also by a STATUSTEXT.

The search plane has x east and y north, so (x, y) = (NED y, NED x); its wind points to where the wind comes **from**:
(u cos φ, u sin φ) = (−`wind_y`, −`wind_x`).

## The loop

1. The vehicle reaches a waypoint, takes one reading and publishes it. `time_boot_ms` grows from reading to reading and names it.
2. The estimator answers each reading with one belief of the same `time_boot_ms`. When the spread first falls below the threshold it
   publishes `agdc/stop`, before that belief, which says `ceased`.
3. The agent answers each belief that has not ceased with one waypoint of the same `time_boot_ms`.
4. While a reading is unanswered the vehicle publishes it again, after 0.25 s, then at doubled intervals up to 2 s. Who gets a message
   again says the same answer again; so whichever message was lost, it comes. Answers to older readings and second answers are ignored.
5. The search begins when the liveliness tokens `health/estimator` and `health/agent` are there: the vehicle arms, takes off, flies to
   its start and takes the first reading. Without waypoints it holds, and after its silence time returns home and lands.

## Late joiners

Keys with a *kept* count are published with Zenoh's advanced publisher (`zenoh.ext`, cache, publisher detection, sample-miss
detection by heartbeat). An advanced subscriber with history and recovery is given the kept messages first, in order; a plain
subscriber gets what is published from then on. Let the cache reply with congestion control BLOCK, and leave late-publisher
detection off: with zenoh 1.10.2 either default loses kept messages when one joins a busy publisher. Even so, some of the history can
be missing. A sample's source sequence number counts from 0: where the first one is greater, subscribe anew and drop what comes twice.
An estimator that starts late or again rebuilds its belief from the kept readings.

## Floats

Positions, wind and gas cross the wire as float32, and every service computes from the float32 values. JSON numbers are the shortest
decimals that read back as the same double.

## What is refused

What is refused is counted in `health` under its kind, logged with key and reason (`overflow`: once a burst), and leaves the belief as
it is to the last bit. It never stops a service. A reading that overflowed is fetched again from the kept ones.

| kind | refused is |
|---|---|
| `malformed` | what does not decode, or is not what this page says |
| `not finite` | a reading with NaN or infinity |
| `other vehicle` | a reading of another system |
| `outside` | a reading from outside the area |
| `absurd` | a gas value that the sensor cannot have given, however strong the source may be |
| `late` | a reading older than the newest one |
| `conflicting` | another reading under the newest one's time |
| `repeated` | the newest reading again: it is not taken twice, but the belief is said again |
| `overflow` | the oldest waiting message of a key, once more than {WAITING_MESSAGES:,} (beside the kept ones) or {MIB} MiB wait |

## Health

A service declares the liveliness token `health/<service>` when it joins: its process is there. It publishes its health on the same key
when it is ready, after each step, and at least once a second. One that has been silent for five seconds hangs, or its link is cut;
`python -m sitl status` says so.

## Messages
"""


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _payload(key: Key) -> str:
    return key.payload if isinstance(key.payload, str) else f"JSON [{key.payload.__name__}](#{key.payload.__name__.lower()})"


def _key_tables() -> str:
    lines = ["| key | payload | from → to | rate |", "|---|---|---|---|"]
    lines += [f"| `{key.name}` | {_payload(key)} | {key.source} → {key.target} | {key.rate} |" for key in KEYS]
    lines += ["", "| key | reliable | under congestion | priority | express | kept |", "|---|---|---|---|---|---|"]
    for key in KEYS:
        how = key.delivery
        waits, priority = "publisher waits" if how.blocking else "dropped", "real time" if how.realtime else "data"
        lines.append(f"| `{key.name}` | {_yes(how.reliable)} | {waits} | {priority} | {_yes(how.express)} | {how.kept or ''} |")
    lines += [""] + [f"- `{key.name}`: {key.meaning}" for key in KEYS]
    return "\n".join(lines)


def _type(schema: dict[str, Any]) -> str:
    if "prefixItems" in schema:
        return "[" + ", ".join(_type(item) for item in schema["prefixItems"]) + "]"
    if "additionalProperties" in schema and schema["type"] == "object":
        return f"object of {_type(schema['additionalProperties'])}"
    if schema.get("items"):
        return f"array of {_type(schema['items'])}"
    limits = [
        f"{sign} {schema[name]:g}" for name, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤")) if name in schema
    ]
    return " ".join([schema["type"], *limits])


def _message(kind: type) -> str:
    schema = msgspec.json.schema_components([kind])[1][kind.__name__]
    lines = [f"### {kind.__name__}", "", schema["description"], "", "| field | type | meaning |", "|---|---|---|"]
    lines += [f"| `{name}` | {_type(field)} | {field.get('description', '')} |" for name, field in schema["properties"].items()]
    return "\n".join(lines)


ATTACHMENT = """
The **attachment** of a belief is the particle array: N rows of little-endian float32, one for each of `unknowns` and then the
weight: (x m, y m, weight), 12 N bytes, where nothing else is unknown. The weights sum to one. Payload and attachment are one sample:
they cannot come from different steps.
"""


def bus_document() -> str:
    """Return the whole page."""
    messages = [_message(key.payload) for key in KEYS if not isinstance(key.payload, str)]
    return HEAD + "\n" + _key_tables() + "\n" + RULES + "\n" + "\n\n".join(messages) + "\n" + ATTACHMENT


if __name__ == "__main__":
    print(bus_document(), end="")
