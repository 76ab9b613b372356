"""What people are told of a flight: in the log, and through the vehicle's clients."""

from pymavlink.dialects.v20 import common as mavlink

from aircraft.aircraft import Clients
from link.bus.log import Log


class Speaker:
    """Tells people a text of a MAV_SEVERITY: in the log and, once there are clients, as STATUSTEXT (253)."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self.clients: Clients | None = None

    def __call__(self, severity: int, text: str) -> None:
        """Tell a text."""
        self.note(severity, text)
        if self.clients:
            self.clients.tell(severity, text)

    def note(self, severity: int, text: str) -> None:
        """Log a text that the clients have heard already."""
        (self.log.warning if severity <= mavlink.MAV_SEVERITY_WARNING else self.log.info)(text)
