"""The vehicle's time in a telemetry log, continuous across restarts, gaps and jumps of the log's clock."""

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog import frames
from ground.tlog.frames import Integers
from ground.tlog.sender import GLOBAL, LOCAL, Autopilot, FlightError, FlightLog, few
from link.bus.mavlink import WRAP_MS, WRAPPED_MS

Floats = NDArray[np.float64]

CLOCKS = {  # messages that every autopilot sends, with the offset of time_boot_ms in the payload
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 8,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0,
    LOCAL: 0,
    GLOBAL: 0,
}
REORDER_MS = 1000
"""Messages overtake each other by up to this time, on a radio or over UDP; a clock that goes back further
may have restarted.
"""
LOOKAHEAD = 5
"""If one of the next LOOKAHEAD messages continues the old clock, a message that went back further was only
late: no restart.
"""
GAP_US = 5_000_000
"""Shortest silence that is noted."""


class VehicleClock:
    """The vehicle's time in ms: time_boot_ms of its first boot in the log, continued across restarts;
    without any, ms since the log began.

    A tick is a record that carries time_boot_ms. In all methods, `records` are indices into the log.
    """

    def __init__(
        self, log: FlightLog, ticks: Integers, raw: Integers, times_ms: Integers, boots: Integers
    ) -> None:
        """Take the ticks' records, their time_boot_ms (`raw`), their continuous times, and the number of
        restarts before each.
        """
        self._log = log
        self._ticks = ticks
        self._raw = raw
        self._times_ms = times_ms
        self._boots = boots
        self._ticks_us = log.times_us[ticks]
        self._newest_ms = np.maximum.accumulate(times_ms) if len(ticks) else times_ms

    def boots(self, records: Integers) -> Integers:
        """Return the number of restarts before each record."""
        return self._boots[self._tick(records)] if len(self._ticks) else np.zeros(len(records), np.int64)

    def own_ms(self, records: Integers, boot_ms: Integers) -> Floats:
        """Return the vehicle's time of records that carry time_boot_ms."""
        if not len(self._ticks):
            return self.logged_ms(records)
        tick = self._tick(records)
        since = (boot_ms - self._raw[tick] + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2
        return (self._times_ms[tick] + since).astype(np.float64)

    def logged_ms(self, records: Integers) -> Floats:
        """Return the vehicle's time at which records were logged, for messages without a time of their
        own.
        """
        us = self._log.times_us[records]
        if not len(self._ticks):
            return np.asarray((us - self._log.times_us[0]) / 1000.0)
        first, last = self._ticks_us[0], self._ticks_us[-1]
        beyond = np.where(us < first, us - first, np.maximum(us - last, 0)) / 1000.0
        return np.asarray(np.interp(us - first, self._ticks_us - first, self._newest_ms) + beyond)

    def logged_us(self, times_ms: Floats) -> Integers:
        """Return the log's time (µs since 1970) at the vehicle's times."""
        first = self._log.times_us[self._ticks[0] if len(self._ticks) else 0]
        if not len(self._ticks):
            return np.asarray(first + np.rint(1000.0 * times_ms).astype(np.int64))
        return np.asarray(
            first + np.rint(np.interp(times_ms, self._newest_ms, self._ticks_us - first)).astype(np.int64)
        )

    def _tick(self, records: Integers) -> Integers:
        return np.maximum(np.searchsorted(self._ticks, records, side="right") - 1, 0)


def vehicle_clock(log: FlightLog, autopilot: Autopilot) -> tuple[VehicleClock, list[str]]:
    """Make the vehicle's times continuous and remove jumps from the log's clock. Return the clock and
    notes for people.

    Raises FlightError if neither the log nor the vehicle's messages contain times.
    """
    ticks = log.select(autopilot.system, CLOCKS, autopilot.component)
    raw = []
    for start, message_id in zip(
        log.records.starts[ticks].tolist(), log.records.message_ids[ticks].tolist(), strict=True
    ):
        at = CLOCKS[message_id]
        raw.append(int.from_bytes(frames.payload(log.data, start)[at : at + 4], "little"))
    times_ms, boots = _continuous(raw, log.times_us[ticks].tolist())
    own = np.flatnonzero(log.records.systems == autopilot.system)
    if log.is_timed:
        notes = _remove_jumps(log, own, ticks, times_ms, boots)
    elif len(ticks):
        log.times_us = np.interp(np.arange(len(log)), ticks, np.maximum.accumulate(times_ms) * 1000).astype(
            np.int64
        )
        notes = ["the log has no record times: the vehicle's own times are used"]
    else:
        raise FlightError(
            "neither the log nor the vehicle's messages contain times; wanted a ground station's telemetry "
            "log (.tlog)"
        )
    starts = (np.flatnonzero(np.diff(boots)) + 1).tolist()
    if starts:
        told = [
            f"at {log.seconds(ticks[tick]):.1f} s (time_boot_ms from {raw[tick - 1]:,} to {raw[tick]:,})"
            for tick in starts
        ]
        notes.append(f"the vehicle restarted: {few(told)}; its time continues across restarts here")
    return VehicleClock(log, ticks, np.array(raw, np.int64), times_ms, boots), notes + _notes_on_gaps(
        log, own
    )


def _continuous(raw: list[int], logged_us: list[int]) -> tuple[Integers, Integers]:
    """Return continuous times and the number of restarts before each; over a restart the log's elapsed
    time is added, at least 1 ms.
    """
    times, boots = [], []
    boot, last = 0, raw[0] if raw else 0
    newest = last
    for index, now in enumerate(raw):
        if _goes_on(last, now):
            late = (last - now) % WRAP_MS
            if late > REORDER_MS:
                newest, last, late = newest + (now - last) % WRAP_MS, now, 0
        elif any(_goes_on(last, later) for later in raw[index + 1 : index + 1 + LOOKAHEAD]):
            late = last - now
        else:
            newest += max(1, (logged_us[index] - logged_us[index - 1]) // 1000)
            last, late, boot = now, 0, boot + 1
        times.append(newest - late)
        boots.append(boot)
    return np.array(times, np.int64), np.array(boots, np.int64)


def _goes_on(last: int, now: int) -> bool:
    """True if a clock can go from `last` to `now` without a restart: later, slightly earlier (a late
    message), or wrapped.
    """
    return now > last or (last - now) % WRAP_MS <= REORDER_MS or (now - last) % WRAP_MS <= WRAPPED_MS


def _remove_jumps(
    log: FlightLog, own: Integers, ticks: Integers, times_ms: Integers, boots: Integers
) -> list[str]:
    told = []
    steps_us = np.diff(log.times_us[own])
    leaps_us = np.zeros_like(log.times_us)
    leapt_us = 0
    for silence in np.flatnonzero(steps_us > GAP_US).tolist():
        before, after = (
            np.searchsorted(ticks, own[silence], side="right") - 1,
            np.searchsorted(ticks, own[silence + 1]),
        )
        if before < 0 or after >= len(ticks) or boots[before] != boots[after]:
            continue
        leap_us = int(steps_us[silence]) - 1000 * max(0, int(times_ms[after] - times_ms[before]))
        if leap_us > GAP_US:
            at_s = int(log.times_us[own[silence]] - log.times_us[0] - leapt_us) / 1e6
            told.append(f"{leap_us / 1e6:,.1f} s at {at_s:.1f} s")
            leaps_us[own[silence + 1]] = leap_us
            leapt_us += leap_us
    log.times_us -= np.cumsum(leaps_us)
    return [f"the log's clock jumps ahead of the vehicle's by {few(told)}: corrected"] if told else []


def _notes_on_gaps(log: FlightLog, own: Integers) -> list[str]:
    silences_us = np.diff(log.times_us[own])
    gaps = np.flatnonzero(silences_us > GAP_US).tolist()
    told = [f"{silences_us[gap] / 1e6:.1f} s at {log.seconds(own[gap]):.1f} s" for gap in gaps]
    return (
        [
            f"gaps without a message from the vehicle: {few(told)}; {silences_us[gaps].sum() / 1e6:.1f} s in "
            "total"
        ]
        if gaps
        else []
    )
