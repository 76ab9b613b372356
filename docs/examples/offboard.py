"""Flies the simulated vehicle from a companion computer, with MAVSDK 4: take-off, two setpoints, landing."""

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
