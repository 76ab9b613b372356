"""The uav service of a real vehicle."""

from collections.abc import Sequence

from aircraft.remote.passing import RealClients
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.search.clock import Clock
from aircraft.search.events import OnBoard
from aircraft.search.search import AfterStop
from aircraft.search.uav import Uav
from link.bus.inbox import Inbox
from link.bus.session import Bus
from link.signing.signer import Signing
from plume.world import World


def real_uav(
    vehicle: RemoteVehicle,
    world: World,
    clock: Clock,
    inbox: Inbox,
    bus: Bus,
    outs: Sequence[str] = (),
    events: Sequence[OnBoard] = (),
    after_stop: AfterStop = "return",
    signing: Signing | None = None,
    wind: tuple[float, float] | None = None,
) -> Uav:
    """Return the service. Raises ValueError for a URL in `outs` that cannot be used.

    wind: that of all readings, if it is given; else the payload or the autopilot tells it.
    """

    def clients(uav: Uav) -> RealClients:
        return RealClients(vehicle, uav.search, bus, outs, clock, uav.handling, signing)

    return Uav(vehicle, clients, world, clock, inbox, bus, bus.log, events, after_stop, vehicle, wind)
