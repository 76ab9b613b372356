"""How a part is doing, from its liveliness and its health messages; `plumeward status` and the page judge
alike.
"""

import math

from link.bus.messages import Health

STALE_S = 5.0
"""Each part publishes its health every second. After this long without, it hangs or its link is cut."""
OK, MISSING, STARTING, STALE, REFUSING = "ok", "missing", "starting", "stale", "refusing"


def verdict(alive: bool, health: Health | None, silent_s: float) -> str:
    """Return the verdict on a part: ok, missing, starting, stale or refusing. `silent_s` is the time since
    it spoke or appeared.
    """
    if not alive:
        return MISSING
    if health is None:
        return STARTING
    if silent_s >= STALE_S:
        return STALE
    return REFUSING if health.refused_lately else OK


def restarted(before: Health | None, now: Health) -> bool:
    """True if the part was started again between two health messages: its uptime went back."""
    return now.uptime_s < (before.uptime_s if before else -math.inf)
