"""What a companion computer does with MAVSDK 4: `python mavsdk4.py PORT SCENARIO` does it and prints what
it saw, as JSON.

It runs in an environment of its own and imports nothing of ours. The tests judge what it saw.
"""

import asyncio
import json
import math
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.component_metadata import ComponentMetadataAsync
from mavsdk.asyncio.plugins.ftp import FtpAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.log_files import LogFilesAsync
from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.exceptions import MavsdkError
from mavsdk.logging import log_subscribe
from mavsdk.plugins.component_metadata import MetadataType
from mavsdk.plugins.mission_raw import MissionItem
from mavsdk.plugins.offboard import PositionNedYaw, VelocityNedYaw

TIMEOUT_S = 60.0
RELATIVE_INT, WAYPOINT, TAKE_OFF, LAND = 6, 16, 22, 21
INSIDE, OUTSIDE, CIRCLE_INSIDE, RALLY = 5001, 5002, 5003, 5100
MISSION, FENCE, RALLY_POINTS = 0, 1, 2
HOME = 47.397742, 8.545594
METRES_A_DEGREE = math.radians(6_371_000)


async def until(stream: AsyncIterator, holds: Callable[[Any], bool]) -> Any:
    """Return the first item of a telemetry stream that is as wanted."""
    async with asyncio.timeout(TIMEOUT_S):
        async for item in stream:
            if holds(item):
                return item
    raise AssertionError("the stream ended")


async def answer(request: Awaitable) -> str:
    """What a request came to: `ok`, or the name of the error."""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            await request
    except MavsdkError as error:
        return str(error).partition(";")[0]
    return "ok"


def at(north_m: float, east_m: float) -> tuple[int, int]:
    """Latitude and longitude of a place relative to home, 1e-7 degrees."""
    lat_deg, lon_deg = HOME
    return (
        round((lat_deg + north_m / METRES_A_DEGREE) * 1e7),
        round((lon_deg + east_m / METRES_A_DEGREE / math.cos(math.radians(lat_deg))) * 1e7),
    )


def items(kind: int, *rows: tuple[int, float, float, float, float]) -> list[MissionItem]:
    """Items of a mission, a fence or rally points, of rows (command, param 1, north, east, up), m."""
    return [
        MissionItem(
            number,
            RELATIVE_INT,
            command,
            int(kind == MISSION and number == 0),
            1,
            p1,
            0.0,
            0.0,
            math.nan,
            *at(north, east),
            up,
            kind,
        )
        for number, (command, p1, north, east, up) in enumerate(rows)
    ]


def told(plan: list[MissionItem]) -> list[list[float]]:
    """What is compared of items."""
    return [
        [item.seq, item.frame, item.command, item.param1, item.x, item.y, item.z, item.mission_type]
        for item in plan
    ]


ROUND = items(
    MISSION,
    (TAKE_OFF, 0, 0, 0, 5),
    (WAYPOINT, 0, 8, 4, 6),
    (WAYPOINT, 0, 12, 15, 7),
    (WAYPOINT, 0, 4, 10, 5),
    (LAND, 0, 4, 10, 0),
)
FIELD = items(
    FENCE,
    *((INSIDE, 4, north, east, 0) for north, east in ((-30, -30), (-30, 60), (60, 60), (60, -30))),
    (CIRCLE_INSIDE, 100, 10, 10, 0),
)
CAMP = items(RALLY_POINTS, (RALLY, 0, 5, 5, 6), (RALLY, 0, 15, 20, 8))


async def fly(drone: System) -> dict:
    """Arm, take off, fly setpoints of position and of velocity, hold, land."""
    action, offboard, telemetry = ActionAsync(drone), OffboardAsync(drone), TelemetryAsync(drone)
    await until(telemetry.subscribe_health_all_ok(), bool)
    await action.arm()
    await action.takeoff()
    await until(telemetry.subscribe_position(), lambda p: p.relative_altitude_m > 4.7)
    seen: dict = {"disarm in the air": await answer(action.disarm())}
    await offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -5.0, 0.0))
    await offboard.start()

    def there(p: Any) -> tuple[float, float, float]:
        return p.position.north_m, p.position.east_m, p.position.down_m

    for target in ((6.0, 3.0, -5.0), (6.0, 12.0, -8.0)):
        await offboard.set_position_ned(PositionNedYaw(*target, 90.0))
        await until(
            telemetry.subscribe_position_velocity_ned(),
            lambda p, target=target: math.dist(there(p), target) < 0.3,
        )
    await offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 0.0))
    moving = await until(telemetry.subscribe_position_velocity_ned(), lambda p: there(p)[0] > 9.0)
    seen["velocity"] = [moving.velocity.north_m_s, moving.velocity.east_m_s, moving.velocity.down_m_s]
    await offboard.stop()
    await until(telemetry.subscribe_flight_mode(), lambda mode: mode.name == "HOLD")
    await action.land()
    await until(telemetry.subscribe_in_air(), lambda in_air: not in_air)
    await until(telemetry.subscribe_armed(), lambda armed: not armed)
    return seen


async def fly_a_mission(drone: System) -> dict:
    """Upload a mission, fly it to its end."""
    mission, telemetry = MissionRawAsync(drone), TelemetryAsync(drone)
    await until(telemetry.subscribe_health_all_ok(), bool)
    await mission.upload_mission(ROUND)
    await ActionAsync(drone).arm()
    await mission.start_mission()
    passed: list[int] = []
    places: list[list[float]] = []

    async def watch() -> None:
        async for progress in mission.subscribe_mission_progress():
            passed.append(progress.current)

    async def look() -> None:
        async for place in telemetry.subscribe_position_velocity_ned():
            places.append([place.position.north_m, place.position.east_m, place.position.down_m])

    watching = [asyncio.create_task(watch()), asyncio.create_task(look())]
    await until(telemetry.subscribe_in_air(), bool)
    await until(telemetry.subscribe_armed(), lambda armed: not armed)
    for task in watching:
        task.cancel()
    finished = await mission.is_mission_finished()
    nearest = [
        min(math.dist(place, target) for place in places)
        for target in ((8, 4, -6), (12, 15, -7), (4, 10, -5))
    ]
    return {"progress": sorted(set(passed)), "nearest_m": nearest, "landed": places[-1], "finished": finished}


async def plan(drone: System) -> dict:
    """Upload and download a mission, a fence and rally points; clear the mission."""
    mission = MissionRawAsync(drone)
    await mission.upload_mission(ROUND)
    await mission.upload_geofence(FIELD)
    await mission.upload_rally_points(CAMP)
    loaded = [
        await mission.download_mission(),
        await mission.download_geofence(),
        await mission.download_rallypoints(),
    ]
    await mission.clear_mission()
    return {
        "sent": [told(ROUND), told(FIELD), told(CAMP)],
        "loaded": [told(each) for each in loaded],
        "after the clear": told(await mission.download_mission()),
    }


async def configure(drone: System) -> dict:
    """Read all parameters; set one; try what is not allowed."""
    param, action = ParamAsync(drone), ActionAsync(drone)
    every = await param.get_all_params()
    seen: dict = {"all": {p.name: p.value for p in (*every.float_params, *every.int_params)}}
    seen["set"] = await answer(param.set_param_float("MIS_TAKEOFF_ALT", 8.0))
    seen["too high"] = await answer(param.set_param_float("MIS_TAKEOFF_ALT", 1000.0))
    seen["unknown"] = await answer(param.get_param_float("NO_SUCH_PARAM"))
    seen["wrong type"] = await answer(param.get_param_int("MIS_TAKEOFF_ALT"))
    seen["value"] = await param.get_param_float("MIS_TAKEOFF_ALT")
    await action.set_return_to_launch_altitude(12.0)
    seen["altitudes"] = [await action.get_takeoff_altitude(), await action.get_return_to_launch_altitude()]
    return seen


async def ask(drone: System) -> dict:
    """Ask for all that the vehicle lacks, and for who it is."""
    action, info = ActionAsync(drone), InfoAsync(drone)
    ftp, logs, metadata = FtpAsync(drone), LogFilesAsync(drone), ComponentMetadataAsync(drone)
    await metadata.request_autopilot_component()
    version = await info.get_version()
    since = time.monotonic()
    answers = {
        "files": await answer(ftp.list_directory("/")),
        "logs": await answer(logs.get_entries()),
        "metadata": await answer(metadata.get_metadata(1, MetadataType.PARAMETER)),
        "reboot": await answer(action.reboot()),
        "servo": await answer(action.set_actuator(1, 0.5)),
    }
    return {
        "version": [version.flight_sw_major, version.flight_sw_minor],
        "uid": (await info.get_identification()).hardware_uid,
        "answers": answers,
        "seconds": time.monotonic() - since,
    }


async def lossy(drone: System) -> dict:
    """Everything that is said in several messages, for a link that loses some of them."""
    seen = await plan(drone) | await configure(drone)
    return seen | {
        "files": (await ask(drone))["answers"]["files"],
        "arm": await answer(ActionAsync(drone).arm()),
    }


async def main(port: str, scenario: str) -> None:
    """Connect, do the scenario, print what it saw."""
    log_subscribe(lambda *_: True)  # stdout is for the result
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        drone = await mavsdk.first_autopilot(timeout_s=TIMEOUT_S)
        assert drone is not None, "no vehicle"
        print(json.dumps(await globals()[scenario](drone)))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
