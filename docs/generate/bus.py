"""The generator of docs/bus.md: the bus contract, from the table of keys and the message types.

`make docs` calls it.
"""

from inspect import cleandoc
from typing import Any

import msgspec

from link.access.roles import EVERYBODY, MOST_VEHICLES, OF_ALL_VEHICLES, SERVICES
from link.bus.inbox import MOST_OTHERS, WAITING_BYTES, WAITING_MESSAGES
from link.bus.keys import BELIEF, KEYS, Key
from link.bus.opening import DEFAULT_ROUTER

HEAD = f"""# The bus

`make docs` generates this page from `link/bus/keys.py` and `link/bus/messages.py`; a test keeps it up to date. It is complete: with it
you can replace vehicle, estimator or agent by a program of your own, in any language.

## Joining

Connect to a router as a Zenoh 1.x **client**, with multicast scouting off. The default endpoint is `{DEFAULT_ROUTER}`; a mission prints
its own. A router relays clients, not peers. Every key below lies in the vehicle's namespace, `uav/<id>`: the belief of vehicle 1
is on `uav/1/belief`. Set `namespace` in the Zenoh configuration, or write the full keys.

## Keys
"""

MIB = WAITING_BYTES // 2**20
RULES = f"""
## Frames

Frames are MAVLink 2, dialect `common`, in the same bytes as on a serial line. A payload may hold several frames. The vehicle is system
`<id>`, component 1 (autopilot); the agent is system `<id>`, component 191 (onboard computer). `target_system` is the vehicle's id or 0.

A **reading** is one payload with three frames of the same time:

| message | fields that are read |
|---|---|
| LOCAL_POSITION_NED (32) | `time_boot_ms`; `x` = north, `y` = east, `z` = down from home, m: place of the sample |
| WIND_COV (231) | `time_usec` = 1000 · `time_boot_ms`; `wind_x` = north, `wind_y` = east: velocity of the air, m/s |
| NAMED_VALUE_FLOAT (251) | `time_boot_ms`; `name` = `gas`; `value` in g/m³, or a count of hits |

The frames of a reading carry the vehicle's system id. The estimator refuses readings of another system.

A **waypoint** is one SET_POSITION_TARGET_LOCAL_NED (84) in MAV_FRAME_LOCAL_NED that sets `x`, `y`, `z`. Its `time_boot_ms` is that of the
reading it answers. It counts only on the key `waypoint`, which takes nothing else. On `mavlink/in` or over UDP the same frame is the
setpoint of a client that wants to fly the vehicle itself: it answers no reading, and is refused while the search leads.

Commands go to `mavlink/in`. The vehicle answers them (COMMAND_LONG, COMMAND_INT) with COMMAND_ACK on `mavlink/out`; if it refuses one, it
also sends a STATUSTEXT.

The search plane has x east and y north: (x, y) = (NED y, NED x). Its wind vector points to where the wind comes **from**:
(u cos φ, u sin φ) = (−`wind_y`, −`wind_x`).

## The loop

1. The vehicle reaches a waypoint, takes one reading and publishes it. `time_boot_ms` identifies the reading and grows with each
   one. It wraps to 0 after 49.7 days: of two times, the one up to 24.8 days ahead of the other, modulo 2³², is the later.
2. The estimator answers each reading with one belief of the same `time_boot_ms`. When the stop criterion is first met, it publishes
   `agdc/stop`, then the belief with `ceased` set.
3. The agent answers each belief that has not ceased with one waypoint of the same `time_boot_ms`.
4. While a reading is unanswered, the vehicle publishes it again: first after 0.25 s, then at doubled intervals up to 2 s. A service that
   receives a message again repeats its answer. This recovers any lost message. Answers to older readings and second answers are ignored.
5. The search begins when the liveliness tokens `health/estimator` and `health/agent` exist: the vehicle arms, takes off, flies to
   its start and takes the first reading. Without waypoints it holds position; after its silence time it returns home and lands. After the
   stop it does what `--after-stop` says.

A real autopilot has no gas sensor. Its vehicle asks the payload on `payload/in`, and takes off once `health/payload` is there, too. It asks
again while it has no answer, at the intervals of step 4. The payload repeats its answer to the same question. A new question replaces the
one before, whose answer no longer counts. After NaN the vehicle asks anew, with a later `time_boot_ms` and the same `sample`.

## Late joiners

Keys with a *kept* count are published with Zenoh's advanced publisher (`zenoh.ext`, cache, publisher detection, sample-miss
detection by heartbeat). An advanced subscriber with history and recovery receives the kept messages first, in order; a plain
subscriber receives only what is published from then on. Let the cache reply with congestion control BLOCK, and leave late-publisher
detection off: with zenoh 1.10.2, the default reply or the detection loses kept messages when one joins a busy publisher. Even then some
history can be missing. Check the source sequence number of the samples, which counts from 0: if one is missing, subscribe again and
drop duplicates. The last {BELIEF.delivery.recovered} beliefs are kept for who finds a gap after its link was down; ask for a history of one
(`max_samples`) to join with the newest alone. An estimator that starts late, or again, rebuilds its belief from the kept readings.

Hear `health/*` with a plain subscriber, and ask for what is kept once, on `health/*/@adv/**`. An advanced one orders the messages of all
keys together by what each says of its source: a part that names another's would make you deaf to that one.

## Floats

Positions, wind and gas cross the wire as float32, and every service computes from the float32 values. JSON numbers are the shortest
decimals that read back as the same double.

## Refused messages

A refused message is dropped. It never stops a service and never changes the belief. It is counted in `health` under its kind, and logged
with key and reason (`overflow`: once per burst; `fault`: once for each type of message; `stranger`: once). A reading that overflowed is
fetched again from the kept ones.

| kind | refused message |
|---|---|
| `malformed` | it does not decode, or violates this page |
| `not finite` | a reading with NaN or infinity |
| `other vehicle` | a reading of another system, or a waypoint for one |
| `waypoint` | a waypoint that answers no reading or cannot be flown; a client's setpoint that is refused |
| `outside` | a reading from outside the area |
| `absurd` | a gas value that the sensor cannot give, however strong the source; a wind above 120 m/s; an altitude beyond ±10 km |
| `late` | a reading older than the newest one |
| `conflicting` | a different reading with the newest one's time |
| `repeated` | the newest reading again: it is not assimilated twice, but the belief is published again |
| `overflow` | the oldest waiting message of a key, if more than {WAITING_MESSAGES:,} (in addition to the kept ones) or {MIB} MiB wait |
| `fault` | a MAVLink message that the vehicle could not handle for a fault of its own |
| `stranger` | health, or a liveliness token, of a service of another name than ours, beyond the first {MOST_OTHERS} such names |

## Health

A service declares the liveliness token `health/<service>` when it joins: the token shows that its process is running. It publishes its
health on the same key when it is ready, after each step, and at least once a second. Its `service` is that of the key. A service that is
silent for five seconds hangs, or its link is cut; `plumeward status` reports it.

## Messages
"""


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _payload(key: Key) -> str:
    return (
        key.payload
        if isinstance(key.payload, str)
        else f"JSON [{key.payload.__name__}](#{key.payload.__name__.lower()})"
    )


def _key_tables() -> str:
    lines = ["| key | payload | from → to | rate |", "|---|---|---|---|"]
    lines += [
        f"| `{key.name}` | {_payload(key)} | {key.source} → {key.target} | {key.rate} |" for key in KEYS
    ]
    lines += [
        "",
        "| key | reliable | under congestion | priority | express | kept | at most |",
        "|---|---|---|---|---|---|---|",
    ]
    for key in KEYS:
        how = key.delivery
        waits, priority = (
            "publisher waits" if how.blocking else "dropped",
            "real time" if how.realtime else "data",
        )
        cells = _yes(how.reliable), waits, priority, _yes(how.express), how.kept or "", f"{key.most_mib} MiB"
        lines.append(f"| `{key.name}` | {' | '.join(map(str, cells))} |")
    lines += ["", *(f"- `{key.name}`: {key.meaning}" for key in KEYS)]
    return "\n".join(lines)


ACCESS = f"""
## Access

With `--secure DIR` the router speaks mutual TLS on `tls/` endpoints, and admits each client by the common name of its certificate:
`uav/<id>/<role>`, with an id from 1 to {MOST_VEHICLES}, or one of {" and ".join(f"`{role}`" for role in OF_ALL_VEHICLES)}, who are of all
vehicles. Everything that this table does not allow is dropped. See [security](security.md).
"""


def _access_tables() -> str:
    lines = ["| role | services |", "|---|---|"]
    lines += [f"| {role} | {', '.join(SERVICES[role])} |" for role in EVERYBODY]
    lines += ["", "| key | may publish | may receive |", "|---|---|---|"]
    for key in KEYS:
        if "<service>" in key.name:
            lines.append(f"| `{key.name}` | each role its own services | all |")
        else:
            lines.append(
                f"| `{key.name}` | {', '.join(key.writers)} | {', '.join((*key.readers, *OF_ALL_VEHICLES))} |"
            )
    return "\n".join(lines)


def _type(schema: dict[str, Any]) -> str:
    if "prefixItems" in schema:
        return "[" + ", ".join(_type(item) for item in schema["prefixItems"]) + "]"
    if "additionalProperties" in schema and schema["type"] == "object":
        return f"object of {_type(schema['additionalProperties'])}"
    if schema.get("items"):
        return f"array of {_type(schema['items'])}"
    limits = [
        f"{sign} {schema[name]:g}"
        for name, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"))
        if name in schema
    ]
    return " ".join([schema["type"], *limits])


def _message(kind: type) -> str:
    schema = msgspec.json.schema_components([kind])[1][kind.__name__]
    lines = [
        f"### {kind.__name__}",
        "",
        cleandoc(schema["description"]),
        "",
        "| field | type | meaning |",
        "|---|---|---|",
    ]
    lines += [
        f"| `{name}` | {_type(field)} | {field.get('description', '')} |"
        for name, field in schema["properties"].items()
    ]
    return "\n".join(lines)


ATTACHMENT = """
The **attachment** of a belief is the particle array: N rows of little-endian float32. A row holds one value for each of `unknowns`, then
the weight. If only x and y are unknown, that is (x m, y m, weight) and 12 N bytes. The weights sum to one. Payload and attachment are one
sample: they always belong to the same step.

Frames that a bridge brings to `mavlink/out` and `mavlink/in` have the attachment `bridge`. Other bridges see by it that their sender is not
itself on the bus.

Unknowns of the measurement: `wind-direction` is what has to be added to the measured direction, degrees counter-clockwise; `wind-speed`
is a factor, true by measured speed; `gain` is a factor, reading by concentration; `noise` is a factor on the noise of `sensor`; `cv` is the
gas's intermittency, the coefficient of variation of the concentration around the plume's mean.
"""


def bus_document() -> str:
    """Return the whole page."""
    messages = [_message(key.payload) for key in KEYS if not isinstance(key.payload, str)]
    return (
        HEAD
        + "\n"
        + _key_tables()
        + "\n"
        + ACCESS
        + "\n"
        + _access_tables()
        + "\n"
        + RULES
        + "\n"
        + "\n\n".join(messages)
        + "\n"
        + ATTACHMENT
    )


if __name__ == "__main__":
    print(bus_document(), end="")
