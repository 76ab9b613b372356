"""Protects the MAVLink protocol against a real client: MAVSDK-Python and its server, over UDP."""

import asyncio
import math
import socket
from collections.abc import Callable

import pytest
from mavsdk import System
from mavsdk.action import ActionError
from mavsdk.ftp import FtpError
from mavsdk.geofence import Circle, FenceType, GeofenceData, Point
from mavsdk.log_files import LogFilesError
from mavsdk.mission import MissionError, MissionItem, MissionPlan
from mavsdk.offboard import (
    AccelerationNed,
    ActuatorControl,
    ActuatorControlGroup,
    Attitude,
    AttitudeRate,
    OffboardError,
    PositionGlobalYaw,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)
from mavsdk.param import ParamError

from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from tests.system.drones import TIMEOUT_S, connected, until
from tests.system.wires import free_port

pytestmark = pytest.mark.full

CONFIG = VehicleConfig()


@pytest.fixture
def port(start, wait_until: Callable) -> int:
    udp_port = free_port(socket.SOCK_DGRAM)
    uav = start("sitl", "uav", "--out", f"udpout:127.0.0.1:{udp_port}", "--speedup", "3")
    wait_until(lambda: uav.says(f"udpin://0.0.0.0:{udp_port}"))
    return udp_port


def test_mavsdk_arms_takes_off_flies_setpoints_lands_and_finds_it_disarmed(port: int) -> None:
    async def fly() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone:
            await until(drone.telemetry.health_all_ok(), bool)
            await drone.action.takeoff()  # accepted, as by PX4: it waits to be armed
            await drone.action.arm()
            await until(drone.telemetry.armed(), bool)
            await until(drone.telemetry.position(), lambda p: p.relative_altitude_m > 4.7)
            with pytest.raises(ActionError, match="COMMAND_DENIED"):
                await drone.action.disarm()  # not in the air
            await drone.offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -5.0, 0.0))
            await drone.offboard.start()
            for north, east, down in ((6.0, 3.0, -5.0), (6.0, 12.0, -8.0), (0.5, 0.5, -5.0)):
                await drone.offboard.set_position_ned(PositionNedYaw(north, east, down, 90.0))

                def reached(p, target=(north, east, down)) -> bool:
                    place = p.position
                    return math.dist((place.north_m, place.east_m, place.down_m), target) < 0.3

                await until(drone.telemetry.position_velocity_ned(), reached)
            await drone.offboard.stop()
            await until(drone.telemetry.flight_mode(), lambda mode: str(mode) == "HOLD")
            await drone.action.land()
            await until(drone.telemetry.in_air(), lambda in_air: not in_air)
            await until(drone.telemetry.armed(), lambda armed: not armed)

    asyncio.run(fly())


def test_mavsdk_is_told_why_a_setpoint_is_refused_and_can_return_home(port: int) -> None:
    async def fly() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone:
            await until(drone.telemetry.health_all_ok(), bool)
            version = await drone.info.get_version()
            assert (version.flight_sw_major, version.flight_sw_minor) == (1, 15)
            await drone.action.arm()
            await drone.action.takeoff()
            await until(drone.telemetry.position(), lambda p: p.relative_altitude_m > 4.7)
            await drone.offboard.set_position_ned(PositionNedYaw(3.0, 2.0, -5.0, 0.0))
            await drone.offboard.start()
            await until(
                drone.telemetry.position_velocity_ned(),
                lambda p: math.dist((p.position.north_m, p.position.east_m), (3, 2)) < 0.3,
            )
            await drone.offboard.set_position_ned(PositionNedYaw(-5.0, 2.0, -5.0, 0.0))
            await until(
                drone.telemetry.status_text(), lambda text: "(2.0, -5.0) m is outside the area" in text.text
            )
            await drone.action.return_to_launch()
            await until(drone.telemetry.armed(), lambda armed: not armed)
            home = await until(drone.telemetry.position_velocity_ned(), lambda p: True)
            assert (
                math.dist((home.position.north_m, home.position.east_m, home.position.down_m), (0, 0, 0))
                < 0.01
            )

    asyncio.run(fly())


async def hovering(drone: System) -> None:
    """Arm and take off to 5 m."""
    await until(drone.telemetry.health_all_ok(), bool)
    await drone.action.arm()
    await drone.action.takeoff()
    await until(drone.telemetry.position(), lambda p: p.relative_altitude_m > 4.7)


async def ned(drone: System, holds: Callable):
    """Return the first (north, east, down, and their velocities) that is as wanted."""

    def flat(p):
        return (
            p.position.north_m,
            p.position.east_m,
            p.position.down_m,
            p.velocity.north_m_s,
            p.velocity.east_m_s,
            p.velocity.down_m_s,
        )

    return flat(await until(drone.telemetry.position_velocity_ned(), lambda p: holds(*flat(p))))


def test_mavsdk_flies_by_velocity_in_both_frames(port: int) -> None:
    async def fly() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone:
            await hovering(drone)
            await drone.offboard.set_velocity_ned(VelocityNedYaw(1.0, 2.0, -0.5, 90.0))
            await drone.offboard.start()
            north, east, *_ = await ned(
                drone, lambda n, e, d, *v: math.dist(v, (1.0, 2.0, -0.5)) < 1e-3 and e > 4.0
            )
            assert north == pytest.approx(east / 2.0, abs=1e-2)
            await until(drone.telemetry.attitude_euler(), lambda attitude: abs(attitude.yaw_deg - 90.0) < 0.1)
            await drone.offboard.set_velocity_body(
                VelocityBodyYawspeed(0.0, -2.0, 0.5, 0.0)
            )  # nose to the east, left is north
            await ned(drone, lambda n, e, d, *v: math.dist(v, (2.0, 0.0, 0.5)) < 1e-3)
            await drone.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 20.0))
            yaw = await until(drone.telemetry.attitude_euler(), lambda attitude: attitude.yaw_deg < -90.0)
            assert yaw.yaw_deg < -90.0  # it has turned right by more than half a turn from north
            await drone.offboard.set_velocity_ned(VelocityNedYaw(-5.0, 0.0, 0.0, 0.0))
            await until(drone.telemetry.status_text(), lambda text: text.text.startswith("Setpoint ends at"))
            north, *_, speed, _, _ = await ned(drone, lambda *_: True)
            assert (north, speed) == (0.0, 0.0)
            await drone.offboard.stop()
            await until(drone.telemetry.flight_mode(), lambda mode: str(mode) == "HOLD")

    asyncio.run(fly())


def test_mavsdk_flies_by_acceleration_and_to_positions_of_every_kind(port: int) -> None:
    async def fly() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone:
            await hovering(drone)
            await drone.offboard.set_acceleration_ned(AccelerationNed(0.5, 0.5, 0.0))
            await drone.offboard.start()
            await ned(drone, lambda n, e, d, vn, ve, vd: abs(vn - 2.0) < 0.3 and abs(ve - 2.0) < 0.3)
            still = VelocityNedYaw(0.0, 0.0, 0.0, 0.0)
            await drone.offboard.set_position_velocity_ned(PositionNedYaw(8.0, 4.0, -6.0, 0.0), still)
            await ned(drone, lambda n, e, d, *v: math.dist((n, e, d), (8.0, 4.0, -6.0)) < 0.01)
            await drone.offboard.set_position_velocity_acceleration_ned(
                PositionNedYaw(4.0, 8.0, -5.0, 0.0), still, AccelerationNed(0.0, 0.0, 0.0)
            )
            await ned(drone, lambda n, e, d, *v: math.dist((n, e, d), (4.0, 8.0, -5.0)) < 0.01)
            lat_deg, lon_deg = to_global(
                VehicleConfig().home_lat_deg, VehicleConfig().home_lon_deg, 10.0, 12.0
            )
            kinds = PositionGlobalYaw.AltitudeType
            for kind, altitude_m, down in (
                (kinds.REL_HOME, 7.0, -7.0),
                (kinds.AMSL, 488.0 + 5.0, -5.0),
                (kinds.AGL, 6.0, -6.0),
            ):
                await drone.offboard.set_position_global(
                    PositionGlobalYaw(lat_deg, lon_deg, altitude_m, 0.0, kind)
                )
                await ned(
                    drone, lambda n, e, d, *v, down=down: math.dist((n, e, d), (10.0, 12.0, down)) < 0.02
                )

    asyncio.run(fly())


def test_mavsdk_is_told_what_is_not_flown(port: int) -> None:
    async def ask() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone:
            await hovering(drone)
            nothing = ActuatorControl([ActuatorControlGroup([0.0] * 8)])
            for send, told in (
                (
                    lambda: drone.offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.5)),
                    "Attitude setpoint refused",
                ),
                (
                    lambda: drone.offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, 0.0, 0.5)),
                    "Attitude setpoint refused",
                ),
                (lambda: drone.offboard.set_actuator_control(nothing), "Actuator setpoint refused"),
            ):
                texts = drone.telemetry.status_text()
                await send()
                with pytest.raises(OffboardError, match="COMMAND_DENIED"):
                    await drone.offboard.start()  # no setpoint received yet
                await until(texts, lambda text, told=told: text.text.startswith(told))

    asyncio.run(ask())


def test_mavsdk_flies_a_strict_vehicle_and_loses_it_a_second_after_its_stream(
    start, wait_until: Callable
) -> None:
    udp_port = free_port(socket.SOCK_DGRAM)
    uav = start("sitl", "uav", "--out", f"udpout:127.0.0.1:{udp_port}", "--speedup", "3", "--strict")
    wait_until(lambda: uav.says(f"udpin://0.0.0.0:{udp_port}"))

    async def fly() -> None:
        async with connected(f"udpin://127.0.0.1:{udp_port}") as drone:
            await hovering(drone)
            await drone.offboard.set_velocity_ned(VelocityNedYaw(0.5, 0.0, 0.0, 0.0))
            await drone.offboard.start()
            await ned(drone, lambda n, *_: n > 5.0)  # 3 s of real time, and more than one time-out

    asyncio.run(fly())  # the client ends, and with it its stream
    wait_until(lambda: uav.says("No setpoint for 3 s: returning home"))  # of simulated time


def test_mavsdk_reads_and_sets_parameters_and_what_it_sets_acts(port: int) -> None:
    async def configure() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone, asyncio.timeout(TIMEOUT_S):
            every = await drone.param.get_all_params()
            floats, ints = (
                {p.name: p.value for p in kind} for kind in (every.float_params, every.int_params)
            )
            assert (floats["MPC_Z_VEL_MAX_DN"], ints["SYS_AUTOSTART"]) == (1.5, 4001)
            await drone.param.set_param_float("MIS_TAKEOFF_ALT", 8.0)
            assert await drone.param.get_param_float("MIS_TAKEOFF_ALT") == 8.0
            assert await drone.param.get_param_int("MAV_SYS_ID") == 1
            with pytest.raises(ParamError):
                await drone.param.set_param_float("MIS_TAKEOFF_ALT", 1000.0)
            with pytest.raises(ParamError):
                await drone.param.get_param_float("NO_SUCH_PARAM")
            assert await drone.param.get_param_float("MIS_TAKEOFF_ALT") == 8.0
            await until(drone.telemetry.health_all_ok(), bool)
            await drone.action.arm()
            assert await drone.action.get_takeoff_altitude() == 8.0
            await drone.action.takeoff()
            await until(drone.telemetry.position(), lambda p: p.relative_altitude_m > 7.7)

    asyncio.run(configure())


def test_mavsdk_gets_an_answer_to_whatever_it_asks_and_does_not_hang(port: int) -> None:
    async def ask() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone, asyncio.timeout(TIMEOUT_S):
            identity = await drone.info.get_identification()
            assert identity.hardware_uid.lower().startswith(b"plumeward".hex())
            with pytest.raises(LogFilesError, match="NO_LOGFILES"):
                await drone.log_files.get_entries()
            with pytest.raises(FtpError):
                await drone.ftp.list_directory("/")
            with pytest.raises(FtpError):
                await drone.ftp.are_files_identical(__file__, "/extras.txt")
            assert await drone.mission_raw.download_mission() == []

    asyncio.run(ask())


def test_mavsdk_plans_a_mission_with_a_fence_and_flies_it(port: int) -> None:
    def item(north: float, east: float) -> MissionItem:
        lat, lon = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, north, east)
        nan = math.nan
        return MissionItem(
            lat,
            lon,
            5.0,
            5.0,
            True,
            nan,
            nan,
            MissionItem.CameraAction.NONE,
            nan,
            nan,
            nan,
            nan,
            nan,
            MissionItem.VehicleAction.NONE,
        )

    async def fly() -> None:
        async with connected(f"udpin://127.0.0.1:{port}") as drone:
            await until(drone.telemetry.health_all_ok(), bool)
            home = Point(*to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 0.0, 0.0))
            await drone.geofence.upload_geofence(GeofenceData([], [Circle(home, 20.0, FenceType.INCLUSION)]))
            await drone.mission.set_return_to_launch_after_mission(True)
            await drone.mission.upload_mission(MissionPlan([item(8.0, 2.0), item(8.0, 8.0)]))
            assert len((await drone.mission.download_mission()).mission_items) == 2
            await drone.action.arm()
            await drone.mission.start_mission()
            await until(drone.mission.mission_progress(), lambda progress: progress.current >= 1)
            await drone.mission.pause_mission()
            await until(drone.telemetry.flight_mode(), lambda mode: str(mode) == "HOLD")
            await drone.mission.start_mission()
            await until(drone.telemetry.flight_mode(), lambda mode: str(mode) == "RETURN_TO_LAUNCH")
            assert await drone.mission.is_mission_finished()
            await until(drone.telemetry.armed(), lambda armed: not armed)
            await drone.mission.clear_mission()
            assert await drone.mission_raw.download_mission() == []
            with pytest.raises(MissionError):
                await drone.mission.upload_mission(MissionPlan([item(20.0, 20.0)]))  # outside the fence

    asyncio.run(fly())
