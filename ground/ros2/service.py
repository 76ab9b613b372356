"""The part: follows one vehicle on its bus, and says it to ROS."""

import threading
import time
from pathlib import Path

from ground.ros2.messages import Messages
from ground.ros2.node import RosNode
from ground.ros2.orders import RosOrders
from ground.ros2.rmw import Node
from ground.ros2.topics import CLOCK, COMMANDS, OF_A_MISSION, PUBLISHED, Topic
from ground.ros2.translation import Translation
from ground.ros2.wire import Wire
from link.access.roles import ros_namespace
from link.bus.inbox import Inbox
from link.bus.keys import BELIEF, HEALTH, MAVLINK_OUT, READING, STOP
from link.record.tap import Tap

EVERY_S = 0.02  # how often messages are taken
MOST_COMMANDS = 100  # commands that wait; beyond that the oldest are dropped, and counted
READ = (MAVLINK_OUT, READING, BELIEF, STOP, HEALTH)
Asked = tuple[Topic, bytes, bytes]  # topic, payload, attachment


class Ros:
    """One vehicle, said to ROS."""

    def __init__(
        self,
        bus: Tap,
        wire: Wire,
        vehicle: str,
        domain: int,
        connect: str,
        secure: Path | None,
        commands: bool,
    ) -> None:
        """Join the router once more, as a node; raises what `Bus` raises. vehicle: its namespace, `uav/1`."""
        self._bus = bus
        self.node = Node(domain, ros_namespace(vehicle), "plumeward")
        self._inbox = Inbox()
        lanes = {topic: self._inbox.lane(topic.name, MOST_COMMANDS) for topic in COMMANDS if commands}
        self._ros = RosNode(
            self.node,
            wire.hash_of,
            [topic for topic in PUBLISHED if topic is not CLOCK],
            lanes,
            lambda topic, data, attached: lanes[topic]((topic, data, attached), len(data)),
            connect,
            vehicle,
            secure,
        )
        self._ros.watch_publishers(CLOCK)
        self._translation = Translation(vehicle, Messages(wire, self.node.namespace.removeprefix("/")))
        self._orders = RosOrders(bus, wire) if commands else None
        self._missions = self._translation.missions
        self._connected = True
        self._ended = threading.Event()
        bus.subscribe(*READ)

    def end(self) -> None:
        """Let `run` return."""
        self._ended.set()

    def run(self) -> None:
        """Translate until `end` is called."""
        while not self._ended.wait(EVERY_S):
            self._look_after()
            arrivals = self._bus.take()
            now_s = time.monotonic()
            for topic, message in self._translation.take(arrivals, now_s):
                self._say(topic, message)
            if self._orders:
                history = self._translation.history
                for arrival in arrivals:
                    self._orders.hears(arrival, history, now_s)
                self._ask(self._orders, now_s)
                self._orders.go_on(now_s)

    def close(self) -> None:
        """Leave ROS."""
        self._ros.close()

    def _say(self, topic: Topic, message: bytes) -> None:
        if self._translation.missions != self._missions:  # late subscriptions get nothing of the one before
            self._missions = self._translation.missions
            for latched in OF_A_MISSION:
                self._ros.offer(latched)
        self._ros.say(topic, message)
        self._bus.tally.did(-1)

    def _ask(self, orders: RosOrders, now_s: float) -> None:
        self._inbox.tell_dropped(self._bus.log)
        for _ in range(self._inbox.waiting()):
            asked: Asked = self._inbox.get(0.0)
            orders.take(*asked, self._translation.history, now_s)

    def _look_after(self) -> None:
        """Keep the link and the clock."""
        self._ros.keep_link()
        if self._bus.connected != self._connected:
            self._connected = self._bus.connected
            say = self._bus.log.info if self._connected else self._bus.log.warning
            say("the router is back" if self._connected else "the router is gone; it is tried again")
        offered = self._ros.offers(CLOCK)
        wanted = self._translation.is_real is False and not self._ros.leaves_to_another(CLOCK)
        if wanted and not offered:
            self._ros.offer(CLOCK)
        elif offered and not wanted:
            self._ros.withdraw(CLOCK)
