"""The vehicle's time in a log, continuous across restarts, gaps and jumps of the log's clock."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog.frames import Integers
from ground.tlog.log import GLOBAL, LOCAL, Autopilot, FlightLog, few
from link.bus.frames import frame_at
from link.bus.mavlink import WRAP_MS, WRAPPED_MS
from link.cli import BadInput

Floats = NDArray[np.float64]

CLOCKS = {  # messages that every autopilot sends, with the offset of time_boot_ms in the payload
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 8,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0,
    LOCAL: 0,
    GLOBAL: 0,
}
REORDER_MS = (
    1000  # messages overtake each other by this much; a clock that goes back further may be restarted
)
LOOKAHEAD = 5  # no restart if one of the next messages continues the old clock: the one between was late
GAP_US = 5_000_000  # shortest silence that is noted


class VehicleClock(NamedTuple):
    """The vehicle's time in ms: time_boot_ms of its first boot in the log, continued across restarts.

    A tick is a record with a time_boot_ms. In all methods, `records` are indices into the log.
    """

    log: FlightLog
    ticks: Integers  # their records, and the log's times of these
    ticks_us: Integers
    raw: Integers  # their time_boot_ms
    times_ms: Integers  # their continuous times
    newest_ms: Integers  # the newest one until each
    restarts: Integers  # before each

    def boots(self, records: Integers) -> Integers:
        """Return the number of restarts before each record."""
        return self.restarts[self._tick(records)]

    def own_ms(self, records: Integers, boot_ms: Integers) -> Floats:
        """Return the vehicle's time of records that carry time_boot_ms."""
        tick = self._tick(records)
        since = (boot_ms - self.raw[tick] + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2
        return (self.times_ms[tick] + since).astype(np.float64)

    def logged_ms(self, records: Integers) -> Floats:
        """Return the vehicle's time at which records were logged, for messages without one of their own."""
        us, first, last = self.log.times_us[records], self.ticks_us[0], self.ticks_us[-1]
        beyond = np.where(us < first, us - first, np.maximum(us - last, 0)) / 1000.0
        return np.asarray(np.interp(us - first, self.ticks_us - first, self.newest_ms) + beyond)

    def logged_us(self, times_ms: Floats) -> Integers:
        """Return the log's time (µs since 1970) at the vehicle's times."""
        since_us = np.interp(times_ms, self.newest_ms, self.ticks_us - self.ticks_us[0])
        return np.asarray(self.ticks_us[0] + np.rint(since_us).astype(np.int64))

    def _tick(self, records: Integers) -> Integers:
        return np.maximum(np.searchsorted(self.ticks, records, side="right") - 1, 0)


def vehicle_clock(log: FlightLog, autopilot: Autopilot) -> VehicleClock:
    """Make the vehicle's times continuous and remove jumps from the log's clock; notes what was corrected.

    Raises BadInput if neither the log nor the vehicle's messages contain times.
    """
    ticks = log.select(autopilot.system, CLOCKS, autopilot.component)
    raw = np.array([_boot_ms(log, tick) for tick in ticks.tolist()], np.int64)
    if not len(ticks):
        if not log.is_timed:
            raise BadInput(
                "neither the log nor the vehicle's messages contain times; wanted a ground station's "
                "telemetry log (.tlog)"
            )
        ticks = np.array([0, len(log) - 1])  # the vehicle says none: ms since the log began
        raw = (log.times_us[ticks] - log.times_us[0]) // 1000
    times_ms, boots = _continuous(raw.tolist(), log.times_us[ticks].tolist())
    newest_ms = np.maximum.accumulate(times_ms)
    own = np.flatnonzero(log.records.systems == autopilot.system)
    if log.is_timed:
        _remove_jumps(log, own, ticks, times_ms, boots)
    else:
        log.times_us = np.interp(np.arange(len(log)), ticks, 1000 * newest_ms).astype(np.int64)
        log.notes.append("the log has no record times: the vehicle's own times are used")
    restarts = [
        f"at {log.seconds(ticks[tick]):.1f} s (time_boot_ms from {raw[tick - 1]:,} to {raw[tick]:,})"
        for tick in (np.flatnonzero(np.diff(boots)) + 1).tolist()
    ]
    if restarts:
        log.notes.append(f"the vehicle restarted: {few(restarts)}; its time continues across restarts here")
    silences_us = np.diff(log.times_us[own])
    if gaps := np.flatnonzero(silences_us > GAP_US).tolist():
        told = few([f"{silences_us[gap] / 1e6:.1f} s at {log.seconds(own[gap]):.1f} s" for gap in gaps])
        log.notes.append(
            f"gaps without a message from the vehicle: {told}; {silences_us[gaps].sum() / 1e6:.1f} s in total"
        )
    return VehicleClock(log, ticks, log.times_us[ticks], raw, times_ms, newest_ms, boots)


def _boot_ms(log: FlightLog, index: int) -> int:
    """Return a tick's time_boot_ms. Decoding the whole message would take ten times as long."""
    frame = frame_at(log.data, int(log.records.starts[index]))
    assert frame is not None
    at = CLOCKS[frame.message_id]
    return int.from_bytes(frame.payload[at : at + 4], "little")  # MAVLink 2 omits zeros at the end


def _continuous(raw: list[int], logged_us: list[int]) -> tuple[Integers, Integers]:
    """Return continuous times and the number of restarts before each.

    Over a restart the log's elapsed time is added, at least 1 ms.
    """
    times, boots = [], []
    boot, last = 0, raw[0]
    newest = last
    for index, now in enumerate(raw):
        late = 0
        if _goes_on(last, now):
            late = (last - now) % WRAP_MS
            if late > REORDER_MS:
                newest, last, late = newest + (now - last) % WRAP_MS, now, 0
        elif any(_goes_on(last, later) for later in raw[index + 1 : index + 1 + LOOKAHEAD]):
            late = last - now
        else:
            newest += max(1, (logged_us[index] - logged_us[index - 1]) // 1000)
            last, boot = now, boot + 1
        times.append(newest - late)
        boots.append(boot)
    return np.array(times, np.int64), np.array(boots, np.int64)


def _goes_on(last: int, now: int) -> bool:
    """True if a clock goes from `last` to `now` without a restart: later, a little late, or wrapped."""
    return now > last or (last - now) % WRAP_MS <= REORDER_MS or (now - last) % WRAP_MS <= WRAPPED_MS


def _remove_jumps(
    log: FlightLog, own: Integers, ticks: Integers, times_ms: Integers, boots: Integers
) -> None:
    """Remove the log's steps that the vehicle's clock did not take."""
    told, leapt_us = [], 0
    steps_us = np.diff(log.times_us[own])
    leaps_us = np.zeros_like(log.times_us)
    for silence in np.flatnonzero(steps_us > GAP_US).tolist():
        before = np.searchsorted(ticks, own[silence], side="right") - 1
        after = np.searchsorted(ticks, own[silence + 1])
        if before < 0 or after >= len(ticks) or boots[before] != boots[after]:
            continue
        leap_us = int(steps_us[silence]) - 1000 * max(0, int(times_ms[after] - times_ms[before]))
        if leap_us > GAP_US:
            told.append(f"{leap_us / 1e6:,.1f} s at {log.seconds(own[silence]) - leapt_us / 1e6:.1f} s")
            leaps_us[own[silence + 1]] = leap_us
            leapt_us += leap_us
    log.times_us -= np.cumsum(leaps_us)
    if told:
        log.notes.append(f"the log's clock jumps ahead of the vehicle's by {few(told)}: corrected")
