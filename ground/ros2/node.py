"""The node: a session that ROS 2 sees as a node with publishers and subscriptions, by rmw_zenoh's rules."""

import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from ground.ros2 import rmw
from ground.ros2.rmw import PUBLISHER, SUBSCRIPTION, Node
from ground.ros2.topics import Topic
from link.bus.session import Bus

Heard = Callable[[Topic, bytes, bytes], None]  # topic, payload, attachment


class RosNode(Bus):
    """A node on a router. Its keys are ROS's own, outside the namespaces of vehicles."""

    def __init__(
        self,
        node: Node,
        hash_of: Callable[[str], str],
        published: Iterable[Topic],
        commands: Iterable[Topic],
        heard: Heard,
        connect: str,
        vehicle: str,
        secure: Path | None = None,
    ) -> None:
        """Join a router, and show all topics; raises what `Bus` raises.

        hash_of: a type's hash; heard: called with each message of `commands`, in a thread of Zenoh's.
        vehicle: the namespace whose certificate is used.
        """
        super().__init__("ros2", connect, None, announced=False, secure=secure, certified=vehicle)
        self._node, self._hash_of, self._heard = node, hash_of, heard
        self._kept: dict[Topic, bytes] = {}  # the newest messages of latched topics
        self._counts: dict[Topic, int] = {}
        self._gids: dict[Topic, bytes] = {}
        self._numbers: dict[Topic, int] = {}  # of the entities in the session; the node is 0
        self._shown = self._session
        self.others: set[str] = set()  # the sessions that publish what is watched, ours perhaps among them
        self._hold(
            "node",
            lambda session: session.liveliness().declare_token(rmw.node_token(node, str(session.zid()))),
        )
        for topic in published:
            self.offer(topic)
        for topic in commands:
            self._number(topic)
            self._hold(f"listen {topic.name}", partial(self._listen, topic))
            self._hold(f"token {topic.name}", partial(self._show, topic, SUBSCRIPTION))

    def key_of(self, topic: Topic) -> str:
        """Return the key of a topic."""
        name = self._node.absolute(topic.name)
        return rmw.topic_key(self._node.domain, name, topic.kind, self._hash_of(topic.kind))

    def offer(self, topic: Topic) -> None:
        """Publish a topic from now on; what was latched of it is forgotten."""
        self._number(topic)
        self._kept.pop(topic, None)
        self._counts[topic] = 0
        self._hold(topic.name, lambda session: rmw.declare_publisher(session, self.key_of(topic), topic.qos))
        self._hold(f"token {topic.name}", partial(self._show, topic, PUBLISHER))

    def offers(self, topic: Topic) -> bool:
        """Whether a topic is published."""
        return topic.name in self._held

    def withdraw(self, topic: Topic) -> None:
        """Publish a topic no more."""
        for name in (topic.name, f"token {topic.name}"):
            if held := self._held.pop(name, None):
                held[1].undeclare()

    def say(self, topic: Topic, message: bytes) -> None:
        """Publish a message of a topic that is offered."""
        if not self.offers(topic):
            return
        self._counts[topic] += 1
        attached = rmw.attachment(self._counts[topic], time.time_ns(), self._gids[topic])
        self._held[topic.name][1].put(message, attachment=attached)
        if topic.qos.latched:
            self._kept[topic] = message

    def watch_publishers(self, topic: Topic) -> None:
        """Learn from now on who else publishes a topic: see `others`."""
        tokens = rmw.publishers_of(self._node.domain, self._node.absolute(topic.name))

        def changed(sample: zenoh.Sample) -> None:
            session = rmw.session_of(str(sample.key_expr))
            (self.others.add if sample.kind == zenoh.SampleKind.PUT else self.others.discard)(session)

        self._hold(
            f"publishers of {topic.name}",
            lambda session: session.liveliness().declare_subscriber(tokens, changed, history=True),
        )

    def leaves_to_another(self, topic: Topic) -> bool:
        """Whether a topic that is watched is another's: the lower session's, of two that begin at once."""
        own = str(self._session.zid())
        others = self.others - {own}
        return any(other < own for other in others) if self.offers(topic) else bool(others)

    def keep_link(self) -> None:
        """Go on with a new session if the router keeps ours out; what is latched is published on it."""
        super().keep_link()
        if self._session is not self._shown:
            self._shown = self._session
            for topic, message in tuple(self._kept.items()):
                self.say(topic, message)

    def _number(self, topic: Topic) -> None:
        self._numbers.setdefault(topic, len(self._numbers) + 1)

    def _show(self, topic: Topic, entity: str, session: zenoh.Session) -> Any:
        """Declare the token of a publisher or a subscription."""
        token = rmw.topic_token(
            self._node,
            str(session.zid()),
            self._numbers[topic],
            entity,
            topic.name,
            topic.kind,
            self._hash_of(topic.kind),
            topic.qos,
        )
        self._gids[topic] = rmw.gid(token)
        return session.liveliness().declare_token(token)

    def _listen(self, topic: Topic, session: zenoh.Session) -> Any:
        def received(sample: zenoh.Sample) -> None:
            attached = sample.attachment.to_bytes() if sample.attachment else b""
            self._heard(topic, sample.payload.to_bytes(), attached)

        return session.declare_subscriber(self.key_of(topic), received)
