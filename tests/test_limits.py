"""Protects the limits that docs/security.md names: they are those of the code."""

from pathlib import Path

from agent import bundle, graphs
from aircraft.bridge import links, tcp
from ground.view import access, server, serving
from link.access import crowds, roles
from link.bus import inbox, opening
from link.bus.keys import BELIEF, KEYS, READING
from link.record import reader
from link.signing import timestamps
from plume.mistakes import bounded_yaml
from plume.problems import names
from plume.walls import buildings
from sitl.script import typed_yaml

PAGE = Path(__file__).parents[1] / "docs" / "security.md"
MIB, GIB = 2**20, 2**30


def test_the_limits_on_hostile_input_are_those_of_the_code() -> None:
    section = PAGE.read_text().partition("## Limits on hostile input")[2].partition("\n## ")[0]
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in section.splitlines()
        if line.startswith("| ")
    ][1:]
    assert {row[0]: row[1] for row in rows} == {
        "message on the bus": f"{READING.most_mib} MiB, a belief {opening.MOST_MESSAGE // MIB} MiB, "
        f"a query {opening.MOST_QUERY // MIB} MiB",
        "sessions of a router": f"{opening.MOST_SESSIONS:,}; {crowds.MOST_OF_A_PART} of a vehicle's "
        "certificate, "
        f"{crowds.MOST_FOR_ALL} of another",
        "connections that are joining a router": f"{opening.MOST_JOINING:,}, for {opening.JOINING_S:g} s "
        "each",
        "policy bundle": f"{bundle.MOST_BYTES // MIB} MiB of graph, {bundle.MOST_PAGE_BYTES // MIB} MiB of "
        "page, "
        f"{graphs.MOST_NODES} nodes, {graphs.MOST_WORK:,} multiplications a decision",
        "record": f"unpacks to {reader.MOST_RATIO} times its size, or to {reader.SMALL // MIB} MiB; "
        f"{reader.LARGEST_RECORD // GIB} GiB of messages",
        "chunk of a record": f"{reader.LARGEST_PIECE // MIB} MiB",
        "mission script": f"{typed_yaml.MOST_BYTES:,} bytes; {typed_yaml.MOST_VALUES:,} values, aliases "
        "expanded",
        "problem file, file of buildings": f"{names.MOST_BYTES:,} bytes; {bounded_yaml.MOST_VALUES:,} "
        "values, aliases expanded",
        "waiting messages of a key": f"{inbox.WAITING_MESSAGES:,} and the kept ones; "
        f"{inbox.WAITING_BYTES // MIB} MiB",
        "names of services": f"ours and {inbox.MOST_OTHERS} others",
        "pages of one server": f"{server.MOST_CLIENTS} that only look, {server.MOST_CLIENTS} that may "
        "command",
        "connections to the page's server that are no page": f"{serving.MOST_WAITING}",
        "message of a page": f"{server.LONGEST_MESSAGE:,} bytes",
        "words that allow commands": f"of an address that gave a wrong one none for {access.WRONG_S:g} s; "
        f"{access.SHORTEST} characters at least",
        "commands of a page": f"{server.MOST_COMMANDS} within {server.COMMANDS_S:g} s; return and land "
        "without limit",
        "unread answers to a page's commands": f"{server.MOST_ANSWERS}",
        "vehicles on a page": f"{roles.MOST_VEHICLES}",
        "peers of a MAVLink endpoint that listens": f"{links.MOST_PEERS}",
        "what waits for a TCP connection of a bridge": f"{tcp.MOST_BYTES // 1024} KiB",
        "signed MAVLink streams": f"{timestamps.MOST_STREAMS}",
    }
    assert buildings.MOST_BYTES == names.MOST_BYTES
    assert {key.most_mib for key in KEYS if key is not BELIEF} == {READING.most_mib}
    compose = PAGE.parents[1] / "compose.yaml"
    assert f"max_message_size:{opening.MOST_MESSAGE}" in compose.read_text()  # its router is Zenoh's own
