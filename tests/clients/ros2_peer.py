"""A ROS 2 node of others, PyZeROS, in an environment of its own: hears a vehicle's topics, and commands it.

Its session is a client of the router. PyZeROS knows no latched topics: those are heard by Zenoh's advanced
subscriber, with rmw_zenoh's options, on PyZeROS's keys, and decoded by it. Nor does it know sequences of messages: PointCloud2, Path and TFMessage
are left out.

Usage: ros2_peer.py ENDPOINT DOMAIN NAMESPACE. Each line on stdin is an order, `goal_pose 3 4 0`, `pause
true`, `abort`, `raw TOPIC HEX`, or `end`. It says `ready` on stdout, then at the end all that it has
heard, as JSON.
"""

import asyncio
import json
import sys
from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np
import pyzeros
import zenoh
import zenoh.ext
from pyzeros.builtin_msgs import Attachment
from pyzeros.sub import RawSub
from ros2_pyterfaces.cydr.geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped
from ros2_pyterfaces.cydr.rosgraph_msgs.msg import Clock
from ros2_pyterfaces.cydr.sensor_msgs.msg import Illuminance, NavSatFix
from ros2_pyterfaces.cydr.std_msgs.msg import Bool, Empty, String

VOLATILE = {
    "fix": NavSatFix,
    "pose": PoseStamped,
    "gas": Illuminance,
    "wind": Vector3Stamped,
    "/clock": Clock,
}
LATCHED = {
    "estimate": PoseWithCovarianceStamped,
    "estimate_fix": NavSatFix,
    "stop": PoseWithCovarianceStamped,
    "state": String,
}
MOST = 20_000


def compile_messages() -> None:
    """A first message of a kind compiles for seconds: too long for a callback, whose session is then lost."""
    for kind in (*VOLATILE.values(), *LATCHED.values(), Bool, Empty, Attachment):
        kind.deserialize(kind().serialize())


def plain(value: Any) -> Any:
    """A message as JSON has it."""
    if hasattr(value, "__struct_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (bytes, bytearray)):
        return bytes(value).decode()
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value


class Peer:
    """The node, and what it has heard by topic: messages, their attachments, and how often."""

    def __init__(self, session: zenoh.Session, namespace: str) -> None:
        self._session, self._namespace = session, namespace
        self.heard: dict[str, deque[Any]] = {}
        self.attached: dict[str, list[list[Any]]] = {}
        self._subs = [self._hear(topic, kind) for topic, kind in VOLATILE.items()]
        self._subs += [self._hear_latched(topic, kind) for topic, kind in LATCHED.items()]
        self._pubs = {
            topic: pyzeros.Pub(kind, f"{namespace}/{topic}")
            for topic, kind in (("goal_pose", PoseStamped), ("pause", Bool), ("abort", Empty))
        }

    def _name(self, topic: str) -> str:
        return topic if topic.startswith("/") else f"{self._namespace}/{topic}"

    def _keep(self, topic: str, kind: Any, sample: zenoh.Sample) -> None:
        said = Attachment.deserialize(b"\0\1\0\0" + sample.attachment.to_bytes())
        attached = [int(said.sequence_number), int(said.source_timestamp), bytes(said.source_gid).hex()]
        self.heard.setdefault(topic, deque(maxlen=MOST)).append(kind.deserialize(sample.payload.to_bytes()))
        self.attached.setdefault(topic, []).append(attached)

    def _hear(self, topic: str, kind: Any) -> Any:
        return RawSub(kind, self._name(topic), lambda sample: self._keep(topic, kind, sample))

    def _hear_latched(self, topic: str, kind: Any) -> Any:
        key = RawSub(kind, self._name(topic), print, defer=True).subscriber_keyexpr
        return zenoh.ext.declare_advanced_subscriber(
            self._session,
            key,
            lambda sample: self._keep(topic, kind, sample),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            subscriber_detection=True,
        )

    def order(self, words: list[str]) -> None:
        """Publish a command."""
        if words[0] == "raw":
            self._pubs[words[1]].publish(bytes.fromhex(words[2]))
        elif words[0] == "goal_pose":
            goal = PoseStamped()
            for name, word in zip("xyz", words[1:], strict=True):
                setattr(goal.pose.position, name, np.float64(word))
            self._pubs["goal_pose"].publish(goal)
        elif words[0] == "pause":
            self._pubs["pause"].publish(Bool(data=np.bool_(words[1] == "true")))
        else:
            self._pubs["abort"].publish(Empty())

    def tokens(self, domain: str) -> list[str]:
        """The tokens of the graph, as every node of ROS asks for them."""
        replies = self._session.liveliness().get(f"@ros2_lv/{domain}/**", timeout=10)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok})


async def main(endpoint: str, domain: str, namespace: str) -> None:
    """Hear and command until told to end."""
    compile_messages()
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    session = zenoh.open(config)
    with pyzeros.auto_context("peer", session, domain_id=int(domain)):
        peer = Peer(session, namespace)
        print("ready", flush=True)
        loop = asyncio.get_running_loop()
        while (words := (await loop.run_in_executor(None, sys.stdin.readline)).split()) and words != ["end"]:
            peer.order(words)
        tokens = await loop.run_in_executor(None, peer.tokens, domain)
        heard = {topic: [plain(one) for one in said] for topic, said in peer.heard.items()}
        print(json.dumps({"heard": heard, "attached": peer.attached, "tokens": tokens}))
    with suppress(zenoh.ZError):  # on a busy machine it does not close in time
        session.close()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
