"""Real clients fly the vehicle: what their users do must work, and whatever they ask gets an answer.

| file | client |
|---|---|
| test_mavsdk4.py | MAVSDK 4, the native binding; mavsdk4.py runs in its environment |
| test_mavproxy.py | MAVProxy, headless, typed at |
| test_qgroundcontrol.py | the request sequence of QGroundControl, from its source; qgroundcontrol.py plays it |
| test_ros2.py | PyZeROS, ROS 2 by rmw_zenoh's rules; ros2_peer.py runs in its environment |
| test_lossy.py | MAVSDK 4 and QGroundControl over a link that loses frames; lossy.py is the link |

MAVSDK 3 is part of `.venv`: tests/system/test_mavsdk.py. `make test-all` makes the other environments with
install.sh, from the exact versions in mavsdk4.txt, mavproxy.txt and pyzeros.txt. A test whose client is not installed
is skipped; in CI it fails.
"""

from collections.abc import Callable

import pytest

from tests.clients.installed import free_udp_port
from tests.system.conftest import start as start


@pytest.fixture
def vehicle(start, wait_until: Callable) -> Callable[..., int]:
    """Start a vehicle that sends to a port, by default a free one; returns the port."""

    def begin(*words: str, port: int | None = None) -> int:
        port = port or free_udp_port()
        uav = start("sitl", "uav", "--out", f"udpout:127.0.0.1:{port}", *words)
        wait_until(lambda: uav.says(f"udpin://0.0.0.0:{port}"))
        return port

    return begin
