"""Keeps a fault of ours that one client's message meets from ending the flight for all clients."""

from collections.abc import Iterator
from contextlib import contextmanager

from aircraft.state import VehicleFailed
from link.bus.log import Log
from link.bus.mavlink import Message
from link.bus.tally import FAULT


class Handling:
    """The handling of clients' messages: a message that cannot be handled is dropped and counted."""

    def __init__(self, log: Log) -> None:
        """Take the log that is told of the first such message of each type, with the traceback."""
        self.log = log
        self._told: set[str] = set()

    @contextmanager
    def of(self, message: Message) -> Iterator[None]:
        """Drop what is raised while a message is handled, but not that the vehicle has failed."""
        try:
            yield
        except VehicleFailed:
            raise
        except Exception as error:
            self.log.tally.refuse(FAULT)
            if (kind := message.get_type()) not in self._told:
                self._told.add(kind)
                who = f"{message.get_srcSystem()}/{message.get_srcComponent()}"
                self.log.exception(f"{kind} of {who} dropped: {type(error).__name__}: {error}")
