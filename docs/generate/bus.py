"""The generator of docs/bus.md: the bus contract, from the table of keys and the message types.

`make docs` calls it.
"""

from inspect import cleandoc
from typing import Any

import msgspec

from link.access.roles import MOST_SEARCHES, MOST_VEHICLES, OF_A_SEARCH, OF_ALL_VEHICLES, SERVICES
from link.bus.inbox import MOST_OTHERS, WAITING_BYTES, WAITING_MESSAGES
from link.bus.keys import BELIEF, HEALTH, KEYS, OF_A_VEHICLE, Key
from link.bus.messages import Contribution, LeftAt, RoundReading, Stand, Stop
from link.bus.opening import DEFAULT_ROUTER

HEAD = f"""# The bus

`make docs` generates this page from `link/bus/keys.py` and `link/bus/messages.py`; a test keeps it up to date. It is complete: with it
you can replace vehicle, estimator or agent by a program of your own, in any language.

## Joining

Connect to a router as a Zenoh 1.x **client**, with multicast scouting off: a router relays clients, not peers. The default endpoint is
`{DEFAULT_ROUTER}`; a mission prints its own. Every key below lies in the vehicle's namespace, `uav/<id>`: the belief of vehicle 1 is
on `uav/1/belief`. Set `namespace` in the Zenoh configuration, or write the full keys. [Several vehicles](#several-vehicles) that search
together share a namespace, `search/<id>`.

## Keys

Unless the last column says otherwise, a key is reliable, its publisher waits under congestion, its messages travel express with priority
*data* and have at most 1 MiB, and none is kept for late joiners.
"""

MIB = WAITING_BYTES // 2**20
_OF_SERVICES = ", ".join(f"`{HEALTH.named(service)}`" for service in sorted(OF_A_VEHICLE, reverse=True))
OWN = ", ".join([*(f"`{key.name}`" for key in KEYS if key.own), _OF_SERVICES])
SHARED = ", ".join(f"`{key.name}`" for key in KEYS if not key.own) + " of the other services"
RULES = f"""
## Frames

Frames are MAVLink 2, dialect `common`, in the same bytes as on a serial line. A payload may hold several frames. The vehicle is system
`<id>`, component 1 (autopilot); the agent is system `<id>`, component 191 (onboard computer). `target_system` is the vehicle's id or 0.

A **reading** is one payload with three frames of the same time and the vehicle's system id. The estimator refuses readings of another system.

| message | fields that are read |
|---|---|
| LOCAL_POSITION_NED (32) | `time_boot_ms`; `x` = north, `y` = east, `z` = down from home, m: place of the sample |
| WIND_COV (231) | `time_usec` = 1000 · `time_boot_ms`; `wind_x` = north, `wind_y` = east: velocity of the air, m/s |
| NAMED_VALUE_FLOAT (251) | `time_boot_ms`; `name` = `gas`; `value` in g/m³, or a count of hits |

A **waypoint** is one SET_POSITION_TARGET_LOCAL_NED (84) in MAV_FRAME_LOCAL_NED that sets `x`, `y`, `z`. Its `time_boot_ms` is that of the
reading it answers. On `mavlink/in` or over UDP the same frame is the setpoint of a client that wants to fly the vehicle itself: it answers no
reading, and is refused while the search leads.

**Commands** go to `mavlink/in`. The vehicle answers COMMAND_LONG and COMMAND_INT with COMMAND_ACK on `mavlink/out`, and a refused one also with
a STATUSTEXT.

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
5. The search begins when the liveliness tokens `health/estimator` and `health/agent` exist: the vehicle arms, takes off, flies to its start and
   takes the first reading. Without waypoints it holds; after its silence time it returns home and
   lands. After the stop it does what `--after-stop` says.

A real autopilot has no gas sensor. Its vehicle asks the payload on `payload/in`, and takes off once `health/payload` is there, too. It asks again
at the intervals of step 4. The payload repeats its answer to the same question; a new question replaces the one before. After NaN the vehicle
asks anew, with a later `time_boot_ms` and the same `sample`.

## Several vehicles

Vehicles that [search together](fleet.md) are numbered from 1. Their search is a namespace, `search/<id>`, with one estimator, one agent, one
belief and one stop. In it each vehicle has keys of its own below `uav/<number>`, the others are the search's:

| of each vehicle | of the search |
|---|---|
| {OWN} | {SHARED} |

So the readings of vehicle 2 are on `search/1/uav/2/reading`, and the belief that takes them on `search/1/belief`. Messages are the same but for
these:

1. A **round** has one reading of each vehicle that takes part in it: round k has reading k of each, counted from 0 by the order of their times.
   The estimator takes a round when the last of its readings has come, and then in the order of the vehicles. So neither speed nor delays
   change the order: it is that of rounds, then of vehicles.
2. One **belief** answers a round. Its `readings` say whose and which; its own `time_boot_ms`, `position`, `altitude_m` and `gas` are the last
   vehicle's, and its `step` is the number of the round. Each vehicle has a clock of its own, so a `time_boot_ms` identifies a reading only
   together with its vehicle.
3. One **waypoint** message answers a belief. It has a SET_POSITION_TARGET_LOCAL_NED for each vehicle of the round, in their order, with the
   system id and the `time_boot_ms` of its reading. A vehicle flies to its own, and knows from the others where all go.
4. A reading that comes **late** holds up its round: the others wait where they are. It is never taken in a later round; one from
   before its vehicle's newest is refused as `late`. A vehicle publishes its reading again until it has a waypoint, as one alone does. The
   estimator repeats a belief for a vehicle whose newest reading has been answered; while a reading waits for its round, it has no answer.
5. The search begins when estimator, agent and all vehicles are there, by their tokens: no vehicle takes off before. Our estimator says its health
   before its token: its `about` has the number of vehicles. A vehicle that counts another number does not take off, and ends.
6. The stop is one, and ends the search of all. Its `measured` says who has measured what.
7. A vehicle **leaves** when others wait for its reading, and it returns or has landed, or they have waited for `--overdue` seconds (20) of real
   time, whatever the cause: no token, no value, a pilot. The estimator, which decides it, publishes a `departure`. Its `step` is the number of
   the vehicle's readings that have come: the first round that it takes no part in. When it left is the only thing that a clock decides; all
   that follows is a function of readings and departures, in whatever order these come.
8. Who has left stays out: its readings from `step` on are refused as `left`, and the waypoints have none for it. A vehicle that hears of its own
   departure does what `--after-stop` says, unless a pilot leads it. The departure brings the vehicle's readings, which may have died with it.
   Agent and estimator say a departure again that they hear, once, so that it outlives either. An estimator that starts asks for those that
   are kept before it takes a reading, and lets nobody leave in its first 5 s.
9. An operator **leaves out** a vehicle by an order on `leave-out`. The estimator answers with its departure, from the next round on, with
   `forgotten` set: the readings that the vehicle took before no longer count either. From that `step` on the belief is the one that the others'
   readings alone give, in the order of rounds and vehicles, from the prior on. The last vehicle that is left cannot be left out.
10. Who was on the bus and is gone from it for `--overdue` seconds before any vehicle has read leaves at step 0: the others take off. For one that
   has not come yet all wait without end, unless it comes late.
11. A belief names in `doubted` the vehicle whose readings of the rounds before do not fit the others', and those whose sensor is stuck.
   The estimator warns of them in its health.
12. A vehicle **joins late** after an order on `leave-out` with `late` set, given before it has come. The estimator publishes that on `latecomer`, and
   the others begin. A vehicle that finds itself named there does not take off: it asks on `join`. The estimator answers on `latecomer` with where it
   takes off, and beliefs from `since` on have that place in `left_at`: the others keep clear of it. Once a belief has it, and the readings of that
   round were taken clear of it, the vehicle asks with `clear` set. It is given the next round as its `step`, takes off, and its first reading is the
   one of that round. When it joined is, as when one left, a message: agent and estimator say again what they hear of it, each stage once.

## Late joiners

What is *kept* is published with Zenoh's advanced publisher (`zenoh.ext`, cache, publisher detection, sample-miss detection by heartbeat). An
advanced subscriber with history and recovery receives it first, in order; a plain one receives only what is published from then on.

- The cache has to reply with congestion control BLOCK, and late-publisher detection stays off: with zenoh 1.10.2 either loses kept messages
  when one joins a busy publisher.
- Even then some history can be missing. The samples' source sequence numbers count from 0: if one is missing, subscribe again and drop
  duplicates. An estimator that starts late, or again, rebuilds its belief from the kept readings.
- The last {BELIEF.delivery.recovered} beliefs are kept for those who find a gap after their link was down. Ask for a history of one
  (`max_samples`) to join with the newest alone.
- Hear `health/*` with a plain subscriber, and ask once for what is kept, on `health/*/@adv/**`. An advanced one orders the messages of all keys
  together by what each says of its source: a part that names another's would make you deaf to that one.

## Floats

Positions, wind and gas cross the wire as float32, and every service computes from the float32 values. JSON numbers are the shortest
decimals that read back as the same double.

## Refused messages

A refused message is dropped. It never stops a service and never changes the belief. `health` counts it by kind. The log names key and reason
(`overflow`: once per burst; `fault`: once for each type of message; `stranger`: once). A reading that overflowed is fetched again.

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
| `left` | a reading of a vehicle that has left the search of several |
| `order` | an order to leave out a vehicle that the search does not have, or its last one, or after the stop; a request to join of one that does not come late |
| `repeated` | the newest reading again: it is not assimilated twice, but the belief is published again |
| `overflow` | the oldest waiting message of a key, if more than {WAITING_MESSAGES:,} (in addition to the kept ones) or {MIB} MiB wait |
| `fault` | a MAVLink message that the vehicle could not handle for a fault of its own |
| `stranger` | health, or a liveliness token, of a service of another name than ours, beyond the first {MOST_OTHERS} such names |

## Health

A service declares the liveliness token `health/<service>` when it joins. It publishes its health on the same key when it is ready, after each step,
and at least once a second. `service` is that of the key. A service that is silent for five seconds hangs, or its link is cut.

## Messages
"""


def _delivery(key: Key) -> str:
    """Return how a key differs from what the page says of all."""
    how = key.delivery
    return ", ".join(
        words
        for words, differs in (
            ("not reliable", not how.reliable),
            ("dropped under congestion", not how.blocking),
            ("priority *real time*", how.realtime),
            ("not express", not how.express),
            (f"{how.kept:,} kept", how.kept > 0),
            (f"at most {key.most_mib} MiB", key.most_mib != 1),
        )
        if differs
    )


def _payload(key: Key) -> str:
    return (
        key.payload
        if isinstance(key.payload, str)
        else f"JSON [{key.payload.__name__}](#{key.payload.__name__.lower()})"
    )


def _key_table() -> str:
    lines = ["| key | payload | from → to | rate | delivery |", "|---|---|---|---|---|"]
    lines += [
        f"| `{key.name}` | {_payload(key)} | {key.source} → {key.target} | {key.rate} | {_delivery(key)} |"
        for key in KEYS
    ]
    lines += ["", *(f"- `{key.name}`: {key.meaning}" for key in KEYS)]
    return "\n".join(lines)


def _others() -> str:
    """Return the roles whose services have other names than theirs."""
    return "".join(
        f"; `{role}`: {', '.join(services)}" for role, services in SERVICES.items() if services != (role,)
    )


ACCESS = f"""
## Access

With `--secure DIR` the router speaks mutual TLS on `tls/` endpoints, and admits each client by the common name of its certificate. That is
`uav/<id>/<role>`, with an id from 1 to {MOST_VEHICLES}, or {" or ".join(f"`{role}`" for role in OF_ALL_VEHICLES)}, a role of all vehicles.
In a search of several it is `search/<id>/<role>` for {" and ".join(OF_A_SEARCH)}, with an id from 1 to {MOST_SEARCHES}, else
`search/<id>/uav/<number>/<role>`: it has this table's rights to its own vehicle's keys and to those of the search, and none to another vehicle's.
`ros` has no key of this page ([ROS 2](ros2.md#secured)). A role says the health of the services of its name{_others()}.
All that this table does not allow is dropped. See [security](security.md).
"""


def _access_table() -> str:
    lines = ["| key | may publish | may receive |", "|---|---|---|"]
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
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if schema.get("items"):
        return f"array of {_type(schema['items'])}"
    if "minimum" in schema and "maximum" in schema:
        return f"{schema['type']} from {schema['minimum']:,} to {schema['maximum']:,}"
    limits = [
        f"{sign} {schema[name]:,}"
        for name, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"))
        if name in schema
    ]
    return " ".join([schema["type"], *limits])


def _message(kind: type) -> str:
    schema = msgspec.json.schema_components([kind])[1][kind.__name__]
    lines = [
        f"### {kind.__name__}",
        "",
        cleandoc(schema["description"]).partition("\n\nExample")[0],
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
sample, so they belong to the same step.

Unknowns of the measurement: `wind-direction` is what has to be added to the measured direction, degrees counter-clockwise; `wind-speed`
is a factor, true by measured speed; `gain` is a factor, reading by concentration; `noise` is a factor on the noise of `sensor`. Those of the
gas's intermittency: `cv` is a coefficient of variation that the concentration has everywhere; `puff-rate`, puffs a second, and `puff-share`, of the
diffusivity that widens a puff, say how much more it varies the nearer the source is.

Frames that a bridge brings to `mavlink/out` and `mavlink/in` have the attachment `bridge`: it tells other bridges that their sender is not
itself on the bus.
"""


def bus_document() -> str:
    """Return the whole page."""
    kinds = [key.payload for key in KEYS if not isinstance(key.payload, str)]
    kinds[1:1] = RoundReading, Stand, LeftAt  # in a belief
    kinds.insert(kinds.index(Stop) + 1, Contribution)
    messages = [_message(kind) for kind in kinds]
    return (
        HEAD
        + "\n"
        + _key_table()
        + "\n"
        + ACCESS
        + "\n"
        + _access_table()
        + "\n"
        + RULES
        + "\n"
        + "\n\n".join(messages)
        + "\n"
        + ATTACHMENT
    )


if __name__ == "__main__":
    print(bus_document(), end="")
