"""Builds on-board logs byte by byte: ArduPilot's dataflash, PX4's ULog."""

import struct
from pathlib import Path
from typing import ClassVar

from plume.geodesy import to_global
from tests.ground.tlog.logs import HOME

GPS_WEEK, WEEK_MS = 2288, 165_632_000
"""A receiver's time of Monday, 13 November 2023, 22:00:14 UTC, which is 18 s behind GPS."""


def e7(north: float, east: float) -> tuple[int, int]:
    lat, lon = to_global(*HOME, north, east)
    return round(lat * 1e7), round(lon * 1e7)


class Dataflash:
    """Writes a dataflash log: a FMT message for each type, then messages: 0xA3 0x95 type body."""

    SIZES: ClassVar = {
        "B": "B",
        "Q": "Q",
        "I": "I",
        "H": "H",
        "L": "i",
        "e": "i",
        "f": "f",
        "N": "16s",
        "n": "4s",
    }

    def __init__(self) -> None:
        self.data = b""
        self._formats: dict[str, tuple[int, str]] = {}
        self.define("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", number=0x80, length=89)

    def define(self, name: str, letters: str, columns: str, number: int = 0, length: int = 0) -> None:
        number = number or 100 + len(self._formats)
        body = "<" + "".join(self.SIZES.get(letter, "") for letter in letters)
        self._formats[name] = number, body
        length = length or 3 + struct.calcsize(body)
        text = struct.pack("<BB4s16s64s", number, length, name.encode(), letters.encode(), columns.encode())
        self.data += bytes([0xA3, 0x95, 0x80]) + text

    def say(self, name: str, *values: object) -> bytes:
        number, body = self._formats[name]
        coded = (value.encode() if isinstance(value, str) else value for value in values)
        message = bytes([0xA3, 0x95, number]) + struct.pack(body, *coded)
        self.data += message
        return message

    def write(self, folder: Path, name: str = "00000001.BIN") -> Path:
        path = folder / name
        path.write_bytes(self.data)
        return path


def flown(north: float = 1.0, late_us: int = 0, system: int = 1, other_every: int = 0) -> Dataflash:
    """It arms at 12 s and flies east at 1 m/s from (`north`, 0), north and east of home, 5 m up."""
    log = Dataflash()
    log.define("GPS", "QBIH", "TimeUS,Status,GMS,GWk")
    log.define("ORGN", "QBLLe", "TimeUS,Type,Lat,Lng,Alt")
    log.define("POS", "QLLff", "TimeUS,Lat,Lng,Alt,RelHomeAlt")
    log.define("XKF2", "QBff", "TimeUS,C,VWN,VWE")
    log.define("ARM", "QB", "TimeUS,ArmState")
    log.define("NVAL", "QINfBB", "TimeUS,TimeBootMS,Name,Value,SSys,SCom")
    log.define("GASX", "Qf", "TimeUS,Conc")
    log.say("ORGN", 1_000_000 + late_us, 0, *e7(-3.0, -4.0), 48_800)
    log.say("ORGN", 1_000_000 + late_us, 1, *e7(0.0, 0.0), 48_800)
    log.say("ARM", 1_500_000 + late_us, 0)
    for n in range(101):
        us = 10_000_000 + 200_000 * n + late_us
        if n == 0:
            log.say("GPS", us, 3, WEEK_MS, GPS_WEEK)
        if n == 10:
            log.say("ARM", us, 1)
        log.say("POS", us, *e7(north, 0.2 * n), 493.0, 5.0)
        if other_every and n % other_every == 0:  # what another vehicle sends
            log.say("NVAL", us + 50_000, us // 1000 - 3_000, "gas", 99.0, 3 - system, 191)
        if n % 5 == 0:
            log.say("XKF2", us, 0, 1.5, -2.0)
            log.say("XKF2", us, 1, 9.0, 9.0)  # another core
            log.say("NVAL", us + 100_000, us // 1000 + 50, "gas", n / 5 + 0.25, system, 191)
            log.say("NVAL", us + 110_000, us // 1000 + 50, "gas", n / 5 + 0.25, system, 191)  # said again
            log.say("GASX", us + 100_000, 100.0 * n)
    return log


class ULog:
    """Writes a ULog: its header, then messages: size, kind, body."""

    def __init__(self) -> None:
        self.data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
        self.put("B", bytes(40))
        self._topics: dict[str, tuple[int, str]] = {}

    def put(self, kind: str, body: bytes) -> None:
        self.data += struct.pack("<HB", len(body), ord(kind)) + body

    def define(self, topic: str, layout: str, fields: str) -> None:
        self._topics[topic] = len(self._topics), layout
        self.put("F", f"{topic}:uint64_t timestamp;{fields};".encode())

    def follow(self) -> None:
        for topic, (number, _) in self._topics.items():
            self.put("A", struct.pack("<BH", 0, number) + topic.encode())

    def say(self, topic: str, *values: object) -> None:
        number, layout = self._topics[topic]
        self.put("D", struct.pack("<H", number) + struct.pack("<Q" + layout, *values))

    def write(self, folder: Path) -> Path:
        path = folder / "log.ulg"
        path.write_bytes(self.data)
        return path


def flown_by_px4() -> ULog:
    log = ULog()
    log.define("vehicle_local_position", "fff?", "float x;float y;float z;bool xy_valid")
    log.define("home_position", "ddf", "double lat;double lon;float alt")
    log.define("wind", "ff", "float windspeed_north;float windspeed_east")
    log.define("vehicle_status", "B", "uint8_t arming_state")
    log.define("vehicle_land_detected", "?", "bool landed")
    log.define("debug_key_value", "10sf", "char[10] key;float value")
    log.define("sensor_gps", "Q", "uint64_t time_utc_usec")
    log.follow()
    log.say("vehicle_status", 1_000_000, 2)
    log.say("vehicle_land_detected", 1_000_000, True)
    log.say("sensor_gps", 2_000_000, 1_700_000_002_000_000)
    log.say("vehicle_local_position", 5_000_000, 0.0, 0.0, 0.0, False)
    for n in range(51):
        us = 10_000_000 + 200_000 * n
        log.say("vehicle_local_position", us, 1.0, 0.4 * n, -3.0, True)
        if n == 5:
            log.say("vehicle_land_detected", us, False)
        if n % 5 == 4:
            log.put("S", bytes.fromhex("2f731320250cbb12"))
        if n % 5 == 0:
            log.say("wind", us, 1.5, -2.0)
            log.say("debug_key_value", us + 100_000, b"CH4", 0.5 + n)
    return log
