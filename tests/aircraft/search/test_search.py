"""Protects that the pilot always wins: who leads the vehicle, when the search gives way, and how it is
given back.
"""

import math
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import LAUNCHER_IDS
from aircraft.search.search import Search
from aircraft.state import Arrived
from link.bus.mavlink import POSITION_ONLY, Message, waypoint_message
from link.bus.messages import Stop
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.fence import Circle, Fence
from sitl.autopilot.plan import Item, step
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.vehicle import Vehicle
from sitl.uav.simulated import Asked

PILOT, CLIENT, AGENT = (255, 190), (245, 190), (1, 191)
STOP = Stop(9_000, 7, (4.0, 3.0), (0.04, 0.0, 0.04), 0.28, 0.5, "spread:0.5")


class Flight:
    """A vehicle with a search, and an agent that answers each reading with the next waypoint, 1 m further
    east.
    """

    def __init__(
        self, after_stop: str = "return", silence_s: float = 30.0, stream_s: float = math.inf
    ) -> None:
        self.vehicle = Vehicle(VehicleConfig(silence_s=silence_s, stream_s=stream_s))
        self.texts: list[str] = []
        self.real_s = 100.0
        self.search = Search(self.vehicle, (2.0, 3.0), after_stop, lambda _, text: self.texts.append(text))  # type: ignore[arg-type]
        self.protocol = MavlinkProtocol(self.vehicle)
        self.asked = Asked(self.vehicle, self.protocol, self.search, lambda: self.real_s)
        self.readings: list[tuple[float, float]] = []
        self.now_s = 0.0
        self.answering = True

    def fly(self, seconds: float) -> None:
        """Let time pass in steps of 0.1 s, as the uav does."""
        for _ in range(round(seconds * 10)):
            self.now_s = round(self.now_s + 0.1, 1)
            self.real_s += 0.1
            for event in self.vehicle.advance(self.now_s):
                if isinstance(event, Arrived) and self.search.measures:
                    self.readings.append((event.position[1], event.position[0]))
                    self.search.answers.sampled(round(self.now_s * 1000))
            self.search.go_on(searchers=True)
            if self.answering and self.search.answers.awaited:
                x, y = self.readings[-1]
                self.answer(x + 1, y)

    def until(self, state: str) -> None:
        """Fly until the search is in a state, at most a minute."""
        for _ in range(600):
            if self.search.state == state:
                return
            self.fly(0.1)
        raise AssertionError(f"still {self.search.state}, not {state}")

    def answer(self, x: float, y: float, time_boot_ms: int | None = None) -> list[Message]:
        """Answer the newest reading, or that of another time, as the agent does; returns the answers."""
        stamp = self.search.answers.newest if time_boot_ms is None else time_boot_ms
        result = self.search.answer(waypoint_message(1, stamp or 0, (x, y), 5.0), self.now_s)
        return self.protocol.refuse_setpoint(result, self.now_s)

    def send(self, message: Message, sender: tuple[int, int], whence: str = "on the bus") -> list[Message]:
        """Hand a message to the vehicle as if it had come over a link."""
        message.pack(mavlink.MAVLink(None, *sender))
        return self.asked.receive(message, self.now_s, whence)

    def command(self, number: int, *params: float, sender: tuple[int, int] = PILOT) -> int:
        """Send a command; returns its MAV_RESULT."""
        params = (*params, *[0.0] * (7 - len(params)))
        return self.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *params), sender)[0].result

    def change(self, mode: Mode, sender: tuple[int, int] = PILOT) -> int:
        """Ask for a mode; returns the MAV_RESULT."""
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *mode.value, sender=sender)

    def lead(self, x: float, y: float, sender: tuple[int, int] = CLIENT) -> list[Message]:
        """Send a setpoint of a client's own; returns the answers."""
        zeros = [0.0] * 8
        setpoint = mavlink.MAVLink_set_position_target_local_ned_message(
            7, 1, 1, mavlink.MAV_FRAME_LOCAL_NED, POSITION_ONLY, y, x, -5.0, *zeros
        )
        return self.send(setpoint, sender)

    def velocity(self, north: float, east: float, time_boot_ms: int = 7) -> Message:
        """Return a setpoint that is a velocity, m/s."""
        ignored = mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE * 0b111 | POSITION_ONLY & ~0b111000
        vector = [north, east, *[0.0] * 6]
        return mavlink.MAVLink_set_position_target_local_ned_message(
            time_boot_ms, 1, 1, 1, ignored, 0, 0, 0, *vector
        )

    def push(self, north: float, east: float) -> list[Message]:
        """Send a velocity of a client's own, m/s; returns the answers."""
        return self.send(self.velocity(north, east), CLIENT)

    @property
    def mode(self) -> Mode:
        return self.vehicle.state(self.now_s).mode

    @property
    def place(self) -> tuple[float, float]:
        north, east, _ = self.vehicle.state(self.now_s).position
        return round(east, 2), round(north, 2)


@pytest.fixture
def flight() -> Flight:
    return Flight()


def test_left_alone_the_search_takes_off_flies_to_its_start_and_reads_once_at_each_waypoint(
    flight: Flight,
) -> None:
    flight.until("searching")
    flight.fly(20)
    assert flight.readings[:3] == [(2.0, 3.0), (3.0, 3.0), (4.0, 3.0)]
    assert len(set(flight.readings)) == len(flight.readings) > 5
    assert flight.texts == []


@pytest.mark.parametrize("how", [Mode.HOLD, Mode.LAND, Mode.RETURN], ids=lambda mode: mode.name)
def test_a_mode_that_a_pilot_chooses_during_take_off_stays(flight: Flight, how: Mode) -> None:
    flight.until("taking off")
    flight.fly(0.5)
    assert flight.change(how) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(3)
    assert not flight.search.leads
    assert flight.mode is not Mode.OFFBOARD
    assert flight.texts == [f"Search gives way: {how.name} by 255/190 on the bus"]
    flight.fly(60)
    if how is Mode.HOLD:
        assert (flight.search.state, flight.place) == ("paused", (0.0, 0.0))
    else:
        assert flight.search.state == "landed"
        assert not flight.vehicle.state(flight.now_s).armed
    assert flight.readings == []


def test_a_search_that_was_paused_during_take_off_flies_to_its_start_when_it_is_given_back(
    flight: Flight,
) -> None:
    flight.until("taking off")
    flight.fly(0.5)
    flight.change(Mode.HOLD)
    flight.fly(100)
    assert flight.change(Mode.OFFBOARD) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(10)
    assert flight.readings[0] == (2.0, 3.0)
    assert flight.texts[-1] == "Search resumed by 255/190 on the bus"


def test_a_pause_of_any_length_can_be_ended_and_the_search_goes_on_where_it_was(flight: Flight) -> None:
    flight.until("searching")
    flight.fly(10)
    before = len(flight.readings)
    flight.change(Mode.HOLD)
    flight.fly(300)  # ten times the time after which a setpoint is stale
    assert (flight.search.state, len(flight.readings)) == ("paused", before)
    assert flight.change(Mode.OFFBOARD) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(10)
    assert flight.search.state == "searching"
    x, y = flight.readings[before - 1]
    assert flight.readings[before] == (x + 1, y)


def test_an_answer_that_comes_during_a_pause_is_flown_after_it(flight: Flight) -> None:
    flight.until("searching")
    flight.answering = False
    flight.fly(10)
    assert flight.readings == [(2.0, 3.0)]
    flight.change(Mode.HOLD)
    assert flight.search.wants_answers
    flight.answer(9.0, 9.0)
    flight.fly(5)
    assert flight.place == (2.0, 3.0)
    flight.change(Mode.OFFBOARD)
    flight.fly(10)
    assert flight.readings == [(2.0, 3.0), (9.0, 9.0)]


def test_a_motor_stop_in_mid_flight_ends_the_search(flight: Flight) -> None:
    flight.until("searching")
    flight.fly(3)
    assert flight.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == mavlink.MAV_RESULT_ACCEPTED
    flight.until("landed")
    readings = list(flight.readings)
    flight.fly(30)
    assert (flight.search.state, flight.search.leads, flight.readings) == ("landed", False, readings)
    assert "Search gives way: disarmed by 255/190 on the bus" in flight.texts


def test_setpoints_of_another_client_are_refused_while_the_search_leads(flight: Flight) -> None:
    flight.until("searching")
    refused = 0
    for _ in range(100):
        answers = flight.lead(20.0, 20.0)
        refused += len(answers)
        flight.fly(0.1)
    assert 9 <= refused <= 11  # told once a second
    assert all(abs(y - 3.0) < 1e-6 for _, y in flight.readings)
    assert len(set(flight.readings)) == len(flight.readings)
    assert flight.change(Mode.OFFBOARD, CLIENT) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED


@pytest.mark.parametrize("sender", [CLIENT, AGENT], ids=["another's ids", "the agent's ids"])
def test_a_setpoint_with_the_time_of_the_awaited_reading_is_no_answer_unless_it_comes_as_one(
    flight: Flight, sender: tuple[int, int]
) -> None:
    flight.until("searching")
    flight.answering = False
    flight.fly(10)
    for _ in range(30):
        flight.send(waypoint_message(1, flight.search.answers.newest or 0, (29.0, 29.0), 5.0), sender)
        flight.fly(0.1)
    assert (flight.place, flight.readings, flight.search.leads) == ((2.0, 3.0), [(2.0, 3.0)], True)
    flight.answering = True
    flight.fly(20)
    assert flight.readings[:3] == [(2.0, 3.0), (3.0, 3.0), (4.0, 3.0)]


def test_late_and_doubled_answers_are_ignored_and_an_answer_to_no_reading_is_refused(flight: Flight) -> None:
    flight.until("searching")
    flight.answering = False
    flight.fly(10)
    first = flight.search.answers.newest or 0
    assert [flight.answer(x, 3.0) for x in (4.0, 20.0)] == [[], []]
    flight.fly(10)
    assert flight.answer(25.0, 25.0, first) == []
    assert (
        "".join(said.text for said in flight.answer(25.0, 25.0, 7))
        == "Waypoint refused: no reading was taken at 7 ms"
    )
    flight.fly(10)
    assert flight.readings == [(2.0, 3.0), (4.0, 3.0)]
    assert flight.answer(4.0, 3.0) == []  # to stay, and measure again
    flight.fly(1)
    assert flight.readings == [(2.0, 3.0), (4.0, 3.0), (4.0, 3.0)]


def test_an_ignored_answer_is_no_sign_of_life_of_the_agent() -> None:
    flight = Flight(silence_s=5.0)
    flight.until("searching")
    flight.answering = False
    flight.fly(4)
    flight.answer(3.0, 3.0)
    for _ in range(100):
        flight.answer(3.0, 3.0, 7)
        flight.fly(0.1)
    assert flight.mode in (Mode.RETURN, Mode.LAND)


def test_who_ends_a_flight_is_named_by_ids_and_link_also_when_a_pilot_leads_already(flight: Flight) -> None:
    flight.until("searching")
    flight.fly(5)
    flight.change(Mode.HOLD)
    stop = mavlink.MAVLink_command_long_message(
        1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0, 21196, *[0.0] * 5
    )
    flight.send(stop, PILOT, "at 192.0.2.7:40123")
    assert flight.texts == [
        "Search gives way: HOLD by 255/190 on the bus",
        "disarmed by 255/190 at 192.0.2.7:40123",
    ]


def test_velocities_and_global_setpoints_of_another_client_are_refused_while_the_search_leads(
    flight: Flight,
) -> None:
    flight.until("searching")
    flight.fly(3)
    there = [round(47.3978 * 1e7), round(8.5457 * 1e7), 5.0, *[0.0] * 8]
    position = mavlink.MAVLink_set_position_target_global_int_message(7, 1, 1, 6, POSITION_ONLY, *there)
    for answers in (flight.push(1.0, 0.0), flight.send(position, CLIENT)):
        told = "".join(answer.text for answer in answers)
        assert told in ("Waypoint refused: the search leads, HOLD stops it", "")  # both within a second
        flight.fly(2)
    assert flight.search.leads
    assert all(y == 3.0 for _, y in flight.readings)


def test_a_velocity_is_no_answer_to_a_reading(flight: Flight) -> None:
    flight.until("searching")
    flight.answering = False
    flight.fly(5)
    result = flight.search.answer(flight.velocity(1.0, 0.0, flight.search.answers.newest or 0), flight.now_s)
    assert result.reason == "Waypoint refused: the answer to a reading is a position"
    assert flight.search.answers.awaited


def test_another_client_may_lead_by_velocity_and_then_give_the_search_back(flight: Flight) -> None:
    flight.until("searching")
    flight.fly(5)
    readings = list(flight.readings)
    flight.change(Mode.HOLD, CLIENT)
    flight.fly(3)
    x, _ = flight.place
    for n in range(100):
        flight.push(2.0, 0.0)
        if n == 5:
            assert flight.change(Mode.OFFBOARD, CLIENT) == mavlink.MAV_RESULT_ACCEPTED
        flight.fly(0.1)
    assert flight.place[0] == x
    assert flight.place[1] == pytest.approx(
        3.0 + 2.0 / 3.0 + (9.5 - 2.0 / 3.0) * 2.0, abs=0.25
    )  # 2 m/s for 9.5 s
    assert (flight.readings, flight.search.state) == (readings, "paused")
    flight.fly(2)
    assert flight.change(Mode.OFFBOARD) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(15)
    assert flight.readings[len(readings)][1] == 3.0


def test_a_strict_vehicles_own_search_need_not_stream_and_may_be_paused_and_given_back() -> None:
    flight = Flight(stream_s=1.0)
    flight.until("searching")
    flight.fly(5)
    flight.answering = False
    flight.fly(20)  # a slow agent
    assert flight.search.leads
    flight.answering = True
    flight.fly(5)
    flight.change(Mode.HOLD)
    flight.fly(1.5)
    readings = len(flight.readings)
    assert flight.change(Mode.OFFBOARD) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(10)
    assert len(flight.readings) > readings
    assert [text for text in flight.texts if "No setpoint" in text] == []


def test_a_strict_vehicle_comes_home_a_second_after_the_last_setpoint_of_another_client() -> None:
    flight = Flight(stream_s=1.0)
    flight.until("searching")
    flight.fly(5)
    flight.change(Mode.HOLD, CLIENT)
    for n in range(30):
        flight.lead(20.0, 20.0)
        if n == 5:
            assert flight.change(Mode.OFFBOARD, CLIENT) == mavlink.MAV_RESULT_ACCEPTED
        flight.fly(0.1)
    flight.fly(0.8)
    assert flight.mode is Mode.OFFBOARD
    flight.fly(0.2)
    assert flight.mode is Mode.RETURN


def test_a_search_waits_while_a_station_takes_off_before_it_arms(flight: Flight) -> None:
    assert (
        flight.command(mavlink.MAV_CMD_NAV_TAKEOFF, -1, 0, 0, math.nan, math.nan, math.nan, 488.0 + 7.0)
        == mavlink.MAV_RESULT_ACCEPTED
    )
    flight.fly(2)
    assert (flight.search.state, flight.texts) == ("standby", ["Search waits: a pilot flies the vehicle"])
    assert flight.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(20)
    assert (flight.search.state, flight.mode, flight.vehicle.state(flight.now_s).position[2]) == (
        "standby",
        Mode.HOLD,
        -7.0,
    )
    flight.change(Mode.LAND)
    flight.until("searching")


def test_a_search_begins_when_a_station_gives_up_its_take_off(flight: Flight) -> None:
    flight.command(mavlink.MAV_CMD_NAV_TAKEOFF, -1, 0, 0, math.nan, math.nan, math.nan, 488.0 + 7.0)
    flight.fly(9)
    assert flight.search.state == "standby"
    flight.until("searching")
    assert flight.vehicle.state(flight.now_s).position[2] == -5.0


def test_another_client_that_took_control_leads_with_its_own_setpoints_and_burns_no_readings(
    flight: Flight,
) -> None:
    flight.until("searching")
    flight.fly(5)
    readings = list(flight.readings)
    flight.change(Mode.HOLD, CLIENT)
    for n in range(100):
        flight.lead(20.0, 20.0)
        if n == 5:
            assert flight.change(Mode.OFFBOARD, CLIENT) == mavlink.MAV_RESULT_ACCEPTED
        flight.fly(0.1)
    assert flight.place == (20.0, 20.0)
    assert (flight.readings, flight.search.state) == (readings, "paused")
    # It ends its stream; a pilot gives the vehicle back.
    flight.fly(2)
    flight.change(Mode.HOLD)
    assert flight.change(Mode.OFFBOARD) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(15)
    assert flight.readings[len(readings)][1] == 3.0


def test_a_go_to_takes_control_too(flight: Flight) -> None:
    flight.until("searching")
    flight.fly(3)
    latitude_deg = 47.397742 + math.degrees(10 / 6_371_000)
    reposition = mavlink.MAVLink_command_int_message(
        1,
        1,
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
        mavlink.MAV_CMD_DO_REPOSITION,
        0,
        0,
        -1,
        0,
        0,
        math.nan,
        round(latitude_deg * 1e7),
        round(8.545594 * 1e7),
        5.0,
    )
    flight.send(reposition, PILOT)
    flight.fly(20)
    assert flight.search.state == "paused"
    assert flight.place == pytest.approx((0.0, 10.0), abs=0.03)


@pytest.mark.parametrize(("after_stop", "ends"), [("return", (0.0, 0.0)), ("land", None)])
def test_a_found_source_is_told_and_the_vehicle_lands(
    after_stop: str, ends: tuple[float, float] | None
) -> None:
    flight = Flight(after_stop)
    flight.until("searching")
    flight.fly(6)
    there = flight.place
    flight.answering = False
    for _ in range(2):  # it may come again
        flight.search.declare(STOP)
    flight.until("landed")
    assert flight.texts == ["Source found at (4.00, 3.00) m, spread 0.28 m"]
    assert flight.place == (ends or pytest.approx(there, abs=2.0))
    assert not flight.vehicle.state(flight.now_s).armed


def test_a_found_source_may_leave_the_vehicle_in_the_air_until_told() -> None:
    flight = Flight("hold")
    flight.until("searching")
    flight.fly(6)
    flight.search.declare(STOP)
    flight.fly(100)
    assert (flight.search.state, flight.mode, flight.vehicle.state(flight.now_s).armed) == (
        "holding",
        Mode.HOLD,
        True,
    )
    flight.change(Mode.LAND)
    flight.until("landed")


def test_a_stop_does_not_move_a_vehicle_that_a_pilot_leads(flight: Flight) -> None:
    flight.until("searching")
    flight.fly(6)
    flight.change(Mode.HOLD)
    flight.fly(2)
    there = flight.place
    flight.search.declare(STOP)
    flight.fly(60)
    assert (flight.mode, flight.place) == (Mode.HOLD, there)
    assert flight.texts[-1].startswith("Source found at")


def test_a_search_waits_for_a_vehicle_that_a_pilot_flies(flight: Flight) -> None:
    flight.vehicle.arm(0.0)
    flight.vehicle.take_off(0.0, 10.0)
    flight.fly(20)
    assert (flight.search.state, flight.texts) == ("standby", ["Search waits: a pilot flies the vehicle"])
    flight.change(Mode.LAND)
    flight.until("searching")


def test_a_vehicle_whose_estimator_has_stopped_before_stays_on_the_ground_and_says_why(
    flight: Flight,
) -> None:
    flight.search.declare(STOP)  # of the last mission: it is kept for late joiners
    flight.fly(20)
    assert (flight.search.state, flight.vehicle.state(flight.now_s).armed) == ("standby", False)
    assert flight.texts == ["Search not begun: its estimator has stopped already; start it anew"]


def test_a_silent_agent_brings_the_vehicle_home_and_ends_the_search() -> None:
    flight = Flight(silence_s=5.0)
    flight.until("searching")
    flight.fly(3)
    flight.answering = False
    flight.until("landed")
    assert flight.place == (0.0, 0.0)


def test_commands_to_all_systems_and_from_the_vehicles_own_ids_are_not_obeyed(flight: Flight) -> None:
    arm = mavlink.MAVLink_command_long_message(
        0, 0, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0
    )
    assert flight.send(arm, PILOT)[0].result == mavlink.MAV_RESULT_FAILED
    arm = mavlink.MAVLink_command_long_message(
        1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0
    )
    assert flight.send(arm, (1, 1)) == []
    assert not flight.vehicle.state(0.0).armed
    assert (
        flight.send(arm, (1, 191))[0].result == mavlink.MAV_RESULT_ACCEPTED
    )  # another component of the vehicle may
    version = mavlink.MAVLink_command_long_message(
        0, 0, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0
    )
    assert flight.send(version, PILOT)[0].result != mavlink.MAV_RESULT_FAILED


# ---- missions and the fence ----


def fly_mission(flight: Flight) -> None:
    """Let the pilot fly a mission: 10 m north, and stay there."""
    items = (Item(17, 6, 1, (0.0, 0.0, 0.0, math.nan), 473978320, 85455940, 5.0),)
    flight.vehicle.load(flight.now_s, tuple(step(item, 1, flight.vehicle.config) for item in items))
    assert flight.change(Mode.MISSION) == mavlink.MAV_RESULT_ACCEPTED


def test_a_pilot_who_starts_a_mission_in_mid_search_leads_until_the_search_is_given_back(
    flight: Flight,
) -> None:
    flight.until("searching")
    flight.fly(10)
    flight.answering = False
    before = len(flight.readings)
    fly_mission(flight)
    assert flight.texts == ["Search gives way: MISSION by 255/190 on the bus"]
    flight.answering = True
    flight.fly(60)
    assert flight.search.state == "paused"
    assert flight.mode is Mode.MISSION
    assert flight.place == pytest.approx((0.0, 10.0), abs=0.05)
    assert len(flight.readings) == before
    assert flight.change(Mode.OFFBOARD) == mavlink.MAV_RESULT_ACCEPTED
    flight.fly(20)
    assert flight.texts[-1] == "Search resumed by 255/190 on the bus"
    assert len(flight.readings) > before + 2


def test_a_waypoint_outside_the_fence_is_refused_and_silence_brings_the_vehicle_home() -> None:
    flight = Flight(silence_s=20.0)
    flight.vehicle.configure(
        0.0, replace(flight.vehicle.config, fence=Fence((Circle(True, (0.0, 0.0), 8.0),)))
    )
    flight.until("searching")
    flight.fly(20)  # the agent goes east, 1 m at a time: the eighth waypoint is outside
    assert flight.readings[-1] == (7.0, 3.0)
    assert flight.search.answers.awaited
    flight.until("landed")
    assert flight.place == (0.0, 0.0)
    assert flight.texts[-1:] != ["Search gives way: HOLD by the autopilot"]


def test_a_breach_of_the_fence_in_mid_search_pauses_it(flight: Flight) -> None:
    flight.vehicle.configure(
        0.0, replace(flight.vehicle.config, fence=Fence((Circle(False, (3.0, 4.5), 0.3),)))
    )
    flight.until("searching")
    flight.fly(20)  # the zone lies between two waypoints
    assert flight.readings[-1] == (4.0, 3.0)
    assert flight.texts == ["Search gives way: HOLD by the autopilot"]
    assert flight.search.state == "paused"
    assert flight.mode is Mode.HOLD


def test_a_search_that_a_pilot_ends_says_who_and_how_when_it_has_landed(flight: Flight) -> None:
    flight.until("searching")
    flight.command(mavlink.MAV_CMD_NAV_LAND)
    flight.until("landed")
    assert flight.texts[-1] == flight.search.waits_for == "ended by the pilot: LAND by 255/190 on the bus"


def test_the_launchers_return_is_the_launchers_and_no_pilot_has_ended_the_search(flight: Flight) -> None:
    flight.until("searching")
    flight.command(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, sender=LAUNCHER_IDS)
    flight.until("landed")
    assert flight.texts == ["Search gives way: RETURN by the launcher"]
    assert flight.search.waits_for == ""
