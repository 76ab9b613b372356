"""What the page says to those who write for a companion computer: an example that flies, and the clients
that were tried.
"""

EXAMPLE = """\
import asyncio
import math
import subprocess

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.offboard import PositionNedYaw


async def until(stream, holds):
    async for item in stream:
        if holds(item):
            return


async def fly():
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)) as mavsdk:
        await mavsdk.add_any_connection("udpin://127.0.0.1:14540")
        drone = await mavsdk.first_autopilot(timeout_s=30)
        action, offboard, telemetry = ActionAsync(drone), OffboardAsync(drone), TelemetryAsync(drone)
        await until(telemetry.subscribe_health_all_ok(), bool)
        await action.arm()
        await action.takeoff()
        await until(telemetry.subscribe_position(), lambda at: at.relative_altitude_m > 4.7)

        await offboard.set_position_ned(PositionNedYaw(0, 0, -5, 0))  # one setpoint comes before offboard
        await offboard.start()
        for north_m, east_m in ((6, 3), (6, 12)):
            await offboard.set_position_ned(PositionNedYaw(north_m, east_m, -5, 0))
            await until(
                telemetry.subscribe_position_velocity_ned(),
                lambda at: math.dist((at.position.north_m, at.position.east_m), (north_m, east_m)) < 0.3,
            )
            print(f"reached {north_m} m north, {east_m} m east")
        await offboard.stop()

        await action.land()
        await until(telemetry.subscribe_armed(), lambda armed: not armed)


vehicle = subprocess.Popen(["plumeward", "uav", "--out", "udpout:127.0.0.1:14540", "--speedup", "4"])
try:
    asyncio.run(asyncio.wait_for(fly(), timeout=120))
finally:
    vehicle.terminate()
    vehicle.wait()
"""
"""For MAVSDK 4; tests/test_docs.py flies it."""

FLIES = "arming, take-off, setpoints of position and velocity, landing"
TRIED = (
    (
        "MAVSDK",
        "4.1.0",
        f"{FLIES}; missions with progress, fences, rally points, parameters; what is refused",
    ),
    (
        "MAVSDK",
        "3.17.4",
        "arming, take-off, setpoints of position, landing, return; parameters; what is refused",
    ),
    (
        "MAVProxy",
        "1.8.75",
        "`arm`, `takeoff`, `guided`, `wp`, `fence`, `rally`, `param`, `log`, `ftp`, `long`, `signing`. Its "
        "`mode` fails with every "
        "PX4 vehicle; `long DO_SET_MODE 1 4 5` returns, with the numbers of the table of modes",
    ),
    (
        "QGroundControl",
        "its requests, by pymavlink 2.4.50",
        "its start; the sliders and buttons for take-off, go-to, pause, altitude, return; parameters; plans, "
        "fences and rally points",
    ),
)
"""Client, version, and what the tests in tests/clients/ and tests/system/test_mavsdk.py do with it."""
