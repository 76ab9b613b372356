"""What a microservice of MAVLink is here: which message it takes, what it answers, and how."""

from collections.abc import Callable
from typing import NamedTuple

from link.bus.mavlink import Message


class Reply(NamedTuple):
    """The answer to a message: messages for its sender, and the reason if it was refused, for a STATUSTEXT
    (253).
    """

    messages: list[Message]
    reason: str = ""
    kind: str = ""
    """Kind of reason that is told at most once a second, since clients repeat such messages many times a
    second; empty: tell always.
    """


class Microservice(NamedTuple):
    """One type of message and what becomes of it."""

    request: str
    """Message type."""
    answer: Callable[[Message, float], Reply]
    """Takes the message and the simulation time, s."""
    says: str
    """What the answer is, for the documentation."""
    supported: bool = True
    """False if the answer is a refusal, or tells that there is nothing."""


def asker(message: Message) -> tuple[int, int]:
    """System and component id of a message's sender: the target of its answer."""
    return message.get_srcSystem(), message.get_srcComponent()
