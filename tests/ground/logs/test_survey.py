"""Protects the reading of tables: units, places, winds and times are what one works out by hand, nothing
counts twice, and what is wrong with a row or a file is told in one line that names it.
"""

import codecs
import io
import math
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import pytest

from ground.logs import survey, table
from ground.logs.survey import read
from ground.tlog.flight import LoggedFlight
from link.bus.frames import frames_in
from link.bus.mavlink import Reading, split, unpack_reading
from link.cli import BadInput
from plume.geodesy import to_local

HEADER = "timestamp,latitude,longitude,height_ato,windspeed,winddir,temperature,pressure,ch4"
ROWS = [
    f"2026-06-01 09:00:{n:02},51.{5_000_000 + 200 * n},9.25,4.0,2.0,270.0,15.0,1013.25,{2.0 + (n == 3)}"
    for n in range(12)
]
"""Two metres north a second; 1 ppm of methane above the background at the fourth row."""
PPM_GM3 = 0.000678499
PLAIN = "time=t,lat=lat,lon=lon,gas=gas@g/m3"
"""Columns without a wind."""
CALM = (2.0, 270.0)


def written(folder: Path, rows: Iterable[str] = ROWS, header: str = HEADER, name: str = "flight.csv") -> Path:
    path = folder / name
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def plain(folder: Path, *rows: str) -> Path:
    return written(folder, rows, "t,lat,lon,gas")


def readings(flight: LoggedFlight) -> list[Reading]:
    return [unpack_reading(entry.payload) for entry in flight.entries if entry.key == "reading"]


def refused(path: Path, **chosen) -> str:
    with pytest.raises(BadInput) as error:
        read(path, **chosen)
    (line,) = str(error.value).splitlines()
    return line


# ---- what is read ----


def test_one_row_is_told_as_one(tmp_path: Path) -> None:
    notes = read(written(tmp_path, [ROWS[0], ROWS[0].replace(":00,", ":01,")])).notes
    assert "1 row that repeats the row before but for the time counts once" in notes
    assert "flight.csv: 1 row, 1 used" in read(written(tmp_path, ROWS[:1])).notes[0]


def test_a_table_gives_the_readings_that_one_works_out_by_hand(tmp_path: Path) -> None:
    flight = read(written(tmp_path))
    said = readings(flight)
    assert [reading.time_boot_ms for reading in said] == [1000 * n for n in range(12)]
    assert [reading.gas for reading in said] == pytest.approx(
        [PPM_GM3 * (n == 3) for n in range(12)], abs=1e-9
    )
    assert {reading.altitude_m for reading in said} == {4.0}
    assert all(reading.wind == pytest.approx((-2.0, 0.0), abs=1e-6) for reading in said)  # from the west
    lat, lon = flight.origin.lat_deg, flight.origin.lon_deg
    assert lat is not None
    assert lon is not None
    for n, reading in enumerate(said):
        north, east = to_local(lat, lon, 51.5 + 2e-5 * n, 9.25)
        assert reading.position == pytest.approx((east, north), abs=1e-4)
    assert flight.area_m == 30.0
    assert flight.sensed is not None
    assert "columns: those of gasflux, by the first row" in flight.notes
    assert "09:00:00 (no time zone given, taken as UTC)" in flight.notes[0]
    assert any(note.startswith("background: 2 ppm (0.001357 g/m³) is subtracted") for note in flight.notes)


def test_the_vehicle_of_a_table_tells_its_home_and_its_way(tmp_path: Path) -> None:
    flight = read(written(tmp_path))
    frames = [
        frame for entry in flight.entries if entry.key == "mavlink/out" for frame in split(entry.payload)
    ]
    assert {frame.message_id for frame in frames} == {0, 2, 32, 33, 49, 242}
    home = next(frame for frame in frames if frame.message_id == 242)
    lat_e7 = int.from_bytes(home.payload[:4], "little", signed=True)
    assert lat_e7 == round(1e7 * (flight.origin.lat_deg or 0))
    assert all(list(frames_in(entry.payload)) for entry in flight.entries)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("ppm", PPM_GM3),
        ("ppb", PPM_GM3 / 1000),
        ("%", PPM_GM3 * 10_000),
        ("ppm:co2", PPM_GM3 * 44.009 / 16.043),
        ("g/m3", 1.0),
        ("mg/m³", 1e-3),
        ("µg/m3", 1e-6),
    ],
)
def test_gas_is_converted_from_its_unit(unit: str, factor: float, tmp_path: Path) -> None:
    log = plain(tmp_path, *(f"{n},51.5,9.{250_000 + 100 * n},{8.0 + 4.0 * (n == 2)}" for n in range(9)))
    flight = read(log, columns=f"time=t,lat=lat,lon=lon,gas=gas@{unit}", wind=CALM)
    assert readings(flight)[2].gas == pytest.approx(4.0 * factor, rel=1e-4)
    told = read(log, columns=f"time=t,lat=lat,lon=lon,gas=gas@{unit}", wind=CALM, background=7.0)
    assert readings(told)[2].gas == pytest.approx(5.0 * factor, rel=1e-4)


def test_gas_along_a_path_keeps_its_path(tmp_path: Path) -> None:
    log = plain(tmp_path, *(f"{n},51.5,9.{250_000 + 100 * n},{60 + 100 * (n == 2)}" for n in range(9)))
    columns = "time=t,lat=lat,lon=lon,gas=gas@ppm*m"
    flight = read(log, columns=columns, wind=CALM, ray_m=7.5)
    assert readings(flight)[2].gas == pytest.approx(100 * PPM_GM3, rel=1e-4)
    assert flight.sensed
    assert flight.sensed.ray_m == 7.5
    assert "no column says how long the path is; give --ray M" in refused(log, columns=columns, wind=CALM)
    empty = written(tmp_path, (f"{n},51.5,9.25,60,0" for n in range(3)), "t,lat,lon,gas,down", "empty.csv")
    said = refused(empty, columns=f"{columns},path=down", wind=CALM)
    assert "gas is in ppm*m and down is above 0 in no row; give --ray M" in said
    assert "--ray: not allowed with gas in g/m3" in refused(log, columns=PLAIN, wind=CALM, ray_m=5.0)


def test_the_air_of_a_row_counts(tmp_path: Path) -> None:
    rows = [row.replace("15.0,1013.25", "-5.0,900.0") for row in ROWS]
    share = 900.0 / 1013.25 * 288.15 / 268.15
    assert readings(read(written(tmp_path, rows)))[3].gas == pytest.approx(PPM_GM3 * share, rel=1e-5)


def test_other_units_are_named(tmp_path: Path) -> None:
    log = written(
        tmp_path,
        [f"{1000 * n},51.5,9.{250_000 + 100 * n},8,10,36,0" for n in range(5)],
        "t,lat,lon,gas,h,w,d",
    )
    columns = "time=t@ms,lat=lat,lon=lon,gas=gas@g/m3,height=h@ft,wind=w@km/h,from=d"
    said = readings(read(log, columns=columns))
    assert [reading.time_boot_ms for reading in said] == [0, 1000, 2000, 3000, 4000]
    assert said[0].altitude_m == pytest.approx(3.048)
    assert said[0].wind == pytest.approx((0.0, 10.0))


def test_an_anemometer_that_turns_with_the_vehicle_is_turned_back_and_its_own_motion_is_taken_off(
    tmp_path: Path,
) -> None:
    """The wind is 3 m/s from the west, the vehicle flies north with 2 m/s: it meets (−3, 2) m/s."""
    meets, from_deg = math.hypot(3.0, 2.0), math.degrees(math.atan2(-3.0, 2.0)) % 360
    for heading in (0.0, 90.0, 200.0):
        rows = [
            f"{n},{51.5 + 2.0 * n / 111_194.927!r},9.25,0,{meets},{(from_deg - heading) % 360},{heading}"
            for n in range(9)
        ]
        log = written(tmp_path, rows, "t,lat,lon,gas,speed,direction,yaw")
        flight = read(log, columns=f"{PLAIN},wind=speed,from=direction,heading=yaw")
        for reading in readings(flight):
            assert reading.wind == pytest.approx((-3.0, 0.0), abs=1e-3)


def test_a_reading_is_the_mean_of_the_rows_of_its_time(tmp_path: Path) -> None:
    rows = [f"{n / 10},51.5,{9.25 + 1e-5 * n:.6f},{n % 10}" for n in range(40)]
    said = readings(read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM, background=0.0, every_s=1.0))
    assert [reading.gas for reading in said] == pytest.approx([4.5] * 4)
    assert [reading.time_boot_ms for reading in said] == [400, 1400, 2400, 3400]  # from the first rows on


def test_a_hover_gives_a_reading_in_ten_seconds(tmp_path: Path) -> None:
    rows = [f"{n},51.5,9.25,{n}" for n in range(40)]
    assert len(readings(read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM))) == 4


def test_a_reading_does_not_reach_over_a_gap(tmp_path: Path) -> None:
    rows = [f"{n},51.5,9.25,{n}" for n in (0, 1, 2, 60, 61, 62)]
    said = readings(read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM, background=0.0))
    assert [(reading.time_boot_ms, reading.gas) for reading in said] == [(1000, 1.0), (61_000, 61.0)]


def test_a_long_flight_gives_no_more_readings_than_a_filter_can_bear(tmp_path: Path) -> None:
    rows = [f"{n},51.5,{9.25 + 1e-4 * (n % 100):.6f},{n % 7}" for n in range(2000)]
    flight = read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM)
    assert 200 < len(readings(flight)) <= survey.MOST_READINGS
    assert any("the mean of the rows of 7 s" in note for note in flight.notes)


# ---- what counts once ----


def test_repeated_rows_and_repeated_times_count_once(tmp_path: Path) -> None:
    clean = readings(read(written(tmp_path)))
    doubled = [row for row in ROWS for _ in range(3)]
    flight = read(written(tmp_path, doubled))
    assert readings(flight) == clean
    assert "24 rows that repeat the row before but for the time count once" in flight.notes


def test_rows_of_one_time_with_other_values_are_one_reading(tmp_path: Path) -> None:
    rows = [f"{n},51.5,{9.25 + 1e-4 * n:.6f},{value}" for n in range(4) for value in (1, 3)]
    said = readings(read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM, background=0.0))
    assert [reading.gas for reading in said] == [2.0] * 4


def test_what_a_log_holds_while_the_vehicle_stands_counts_once(tmp_path: Path) -> None:
    rows = [f"{n / 10},51.5,9.25,7" for n in range(50)] + ["5,51.5,9.2502,9"]
    flight = read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM, background=0.0)
    assert [reading.gas for reading in readings(flight)] == [7.0, 9.0]


# ---- bad rows ----


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({8: ""}, "1 row without ch4: first row 6: ch4 is empty; wanted a number"),
        ({8: "NaN"}, "1 row without ch4: first row 6: ch4 is 'NaN'; wanted a number"),
        ({8: "inf"}, "row 6: ch4 is 'inf'; wanted a number"),
        ({8: "1.234,5"}, "1 row too long: first row 6 has 10 cells; wanted 9 (has it decimal commas with"),
        ({1: "91.5"}, "row 6: latitude is '91.5'; wanted a number from -90 to 90 deg (are latitude and long"),
        ({1: "0", 2: "0.0"}, "row 6: latitude and longitude are 0, 0: no fix; wanted a position"),
        ({1: "51.9"}, "1 sample more than 20 km from the middle of the flight, the first at 4.0 s"),
        ({1: "51.51"}, "1 sample out of reach at 100 m/s, the first at 4.0 s"),  # 1.1 km in a second
        ({6: "288"}, "row 6: temperature is '288'; wanted a number from -90 to 70 C"),
        ({7: "98000"}, "row 6: pressure is '98000'; wanted a number from 300 to 1100 hPa"),
        (
            {0: "noon"},
            "row 6: timestamp is 'noon'; wanted a time such as 2026-11-26T12:00:00.5Z, or a number",
        ),
        ({0: "2026-06-01 08:59:00"}, "row 6: timestamp is 63.000 s before the row before; wanted times that"),
        ({4: "-1"}, "used without it: first row 6: windspeed is '-1'; wanted a number from 0 to 100 m/s"),
        ({8: "4294967295"}, "first row 6: ch4 is '4294967295'; wanted a number from -1e+09 to 1e+09"),
    ],
)
def test_a_bad_row_is_left_out_and_named(cells: dict[int, str], words: str, tmp_path: Path) -> None:
    rows = [row.split(",") for row in ROWS]
    for place, text in cells.items():
        rows[4][place] = text
    flight = read(written(tmp_path, map(",".join, rows)))
    (note,) = [note for note in flight.notes if "left out: " in note]
    assert words in note
    others = [reading for reading in readings(flight) if reading.time_boot_ms != 4000]
    assert others == [
        reading for reading in readings(read(written(tmp_path))) if reading.time_boot_ms != 4000
    ]


@pytest.mark.parametrize(
    ("north_m", "later_s", "count"),
    [
        (15.0, 0.0, 39),  # two rows of each second
        (300.0, 0.0, 78),
        (300.0, 0.01, 78),  # rows of both within the time over which rows are averaged
        (300.0, 0.5, 78),
    ],
)
def test_two_vehicles_in_one_table_are_told(
    tmp_path: Path, north_m: float, later_s: float, count: int
) -> None:
    rows = [
        f"{n + later_s * second},{51.5 + (2.0 * n + north_m * second) / 111_195:.7f},9.25,{n % 7}"
        for n in range(40)
        for second in (0, 1)
    ]
    notes = read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM, background=0.0).notes
    assert (
        f"{count} of 80 rows are far from the row before and near to one before that: are there two vehicles "
        "in the table? wanted the rows of one"
    ) in notes
    alone = read(plain(tmp_path, *rows[::2]), columns=PLAIN, wind=CALM, background=0.0)
    assert "vehicles" not in "".join(alone.notes)


def test_a_status_that_is_not_valid_leaves_its_row_out(tmp_path: Path) -> None:
    rows = [f"{n},51.5,9.{250_000 + 100 * n},{n},{(0, 1, 2, '')[n % 4]}" for n in range(8)]
    log = written(tmp_path, rows, "t,lat,lon,gas,ok")
    flight = read(log, columns=f"{PLAIN},status=ok", wind=CALM, background=0.0)
    assert [reading.gas for reading in readings(flight)] == [0.0, 1.0, 4.0, 5.0]
    assert any(
        "2 rows with a ok that is not allowed: first row 4: ok is '2'; wanted 0 or 1" in note
        for note in flight.notes
    )


def test_a_wind_that_comes_seldom_holds_for_half_a_minute(tmp_path: Path) -> None:
    rows = [f"{n},51.5,9.{250_000 + 100 * n},{n},{2 if n == 0 else ''},270" for n in range(50)]
    log = written(tmp_path, rows, "t,lat,lon,gas,wind,from")
    flight = read(log, columns=f"{PLAIN},wind=wind,from=from", every_s=1.0)
    assert [reading.time_boot_ms for reading in readings(flight)] == [1000 * n for n in range(31)]
    assert any(
        "19 samples without a wind in the 30 s before, the first at 31.0 s" in note for note in flight.notes
    )


# ---- bad files ----


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", " is empty; wanted a first row with the names of columns"),
        (b"\n\n \n", " is empty; "),
        (HEADER.encode(), ": none of its 0 rows can be a sample; it has no rows after the first"),
        (b"t,gas\n1,2\n", ": its columns are of none of the presets (skyhub, gasflux); give --columns "),
        (b"\x00\x01\x02" * 100, ", row 1: it is not text; wanted a table"),
        (b"x" * 200_000, ", row 1: it has more than 65,536 characters; wanted a table"),
        (HEADER.encode() + b'\n"' + b"1,2\n" * 60_000, ": it cannot be read (field larger than field limit"),
        (HEADER.encode() + b"\n1,2\n", "row 2 has 2 cells and no longitude; wanted 9 or more"),
    ],
)
def test_a_file_that_is_no_table_is_one_line(data: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_bytes(data)
    assert words in refused(path)
    assert str(path) in refused(path)


def test_a_file_that_is_not_there_or_a_folder_is_one_line(tmp_path: Path) -> None:
    assert refused(tmp_path / "none.csv").endswith("none.csv cannot be read: No such file or directory")
    assert "cannot be read" in refused(tmp_path)


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ("time=t,lat=lat,lon=lon", "gas has no column; wanted gas=COLUMN"),
        ("time=t,lat=lat,lon=lon,gas=gas", "wanted gas=gas@UNIT, ppb, ppm, %"),
        ("time=t,lat=lat,lon=lon,gas=gas@lel", "'lel' is not a unit of gas; wanted ppb, ppm"),
        ("time=t,lat=lat,lon=lon,gas=gas@ppm:radon", "names no gas that is known; wanted ch4"),
        (
            "time=t@h,lat=lat,lon=lon,gas=gas@ppm",
            "time=t@h is not allowed; wanted @auto, @s, @ms, @us, or a zone",
        ),
        (f"{PLAIN},wind=w@m", "wind=w@m is not allowed; wanted @m/s, @km/h"),
        (f"{PLAIN},wind=w", "wind=w has no from; wanted wind=COLUMN, its speed, and from=COLUMN"),
        (f"{PLAIN},heading=h", "heading is of no use without wind"),
        (f"{PLAIN},colour=c", "'colour=c' is not allowed; wanted skyhub, gasflux, or NAME=COLUMN"),
        ("dji", "'dji' is not allowed; wanted skyhub, gasflux, or NAME=COLUMN"),
        (
            "time=t,lat=lat,lon=longitude,gas=gas@ppm",
            "row 1: no column 'longitude' for lon; wanted one of t, lat",
        ),
    ],
)
def test_columns_that_cannot_be_are_one_line(columns: str, words: str, tmp_path: Path) -> None:
    assert words in refused(plain(tmp_path, "1,51.5,9.25,3"), columns=columns, wind=CALM)


def test_a_name_that_two_columns_have_is_refused(tmp_path: Path) -> None:
    log = written(tmp_path, ["1,51.5,9.25,3,4"], "t,lat,lon,gas,gas")
    assert "row 1: 'gas' is the name of 2 columns; wanted one" in refused(log, columns=PLAIN, wind=CALM)


def test_a_table_without_wind_asks_for_it(tmp_path: Path) -> None:
    words = refused(plain(tmp_path, "1,51.5,9.25,3"), columns=PLAIN)
    assert words.endswith("name it with --columns wind=COLUMN,from=COLUMN, or give --wind SPEED,FROM")


# ---- how it is written ----


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("delimiter", [";", "\t", "|"])
def test_encodings_delimiters_and_decimal_commas(encoding: str, delimiter: str, tmp_path: Path) -> None:
    text = "\r\n".join([f"{HEADER},größe", *(f"{row},1.0" for row in ROWS)])
    text = text.replace(",", delimiter).replace(".", ",")
    path = tmp_path / "flight.csv"
    path.write_bytes(text.encode(encoding))
    assert readings(read(path)) == readings(read(written(tmp_path, name="plain.csv")))


def test_a_quoted_cell_may_have_a_decimal_comma(tmp_path: Path) -> None:
    rows = [f'{n},51.5,9.{250_000 + 100 * n},"{n},5"' for n in range(3)]
    said = readings(read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM, background=0.0))
    assert [reading.gas for reading in said] == [0.5, 1.5, 2.5]


@pytest.mark.parametrize(
    ("column", "first", "second", "began"),
    [
        ("t", "2026-06-01T09:00:00Z", "2026-06-01T11:00:01+02:00", "2026-06-01 09:00:00 UTC"),
        ("t@+02:00", "2026-06-01 11:00:00", "2026-06-01 11:00:01", "2026-06-01 09:00:00 UTC"),
        ("t", "2026/06/01 09:00:00.0", "2026/06/01 09:00:01", "2026-06-01 09:00:00 (no time zone given"),
        ("t", "01.06.2026 09:00:00", "01.06.2026 09:00:01", "2026-06-01 09:00:00 (no time zone given"),
        ("t", "1780304400000", "1780304401000", "2026-06-01 09:00:00 UTC"),
        ("t", "1780304400", "1780304401", "2026-06-01 09:00:00 UTC"),
        ("t@us", "1780304400000000", "1780304401000000", "2026-06-01 09:00:00 UTC"),
        ("t", "17.5", "18.5", ""),
        ("t@ms", "159082", "160082", ""),
    ],
)
def test_times(column: str, first: str, second: str, began: str, tmp_path: Path) -> None:
    log = plain(tmp_path, f"{first},51.5,9.25,1", f"{second},51.5,9.2501,2")
    flight = read(log, columns=PLAIN.replace("time=t", f"time={column}"), wind=CALM)
    assert [reading.time_boot_ms for reading in readings(flight)] == [0, 1000]
    assert f" from {began}" in flight.notes[0] if began else " from " not in flight.notes[0]


def test_a_flight_over_the_date_line_is_one_flight(tmp_path: Path) -> None:
    rows = [f"{n},-17.0,{179.99996 + 2e-5 * n - 360 * (n > 1):.6f},1" for n in range(4)]
    said = readings(read(plain(tmp_path, *rows), columns=PLAIN, wind=CALM))
    east = [reading.position[0] for reading in said]
    assert [b - a for a, b in pairwise(east)] == pytest.approx([2.1267] * 3, abs=1e-3)


def test_a_huge_table_is_read_row_by_row(tmp_path: Path) -> None:
    """A quarter of a million rows of half a minute are as many means as half a minute has."""
    taken = table.read(tmp_path, io.BytesIO(codecs.BOM_UTF8 + b"a,b\n" + b"1,2\n" * 3))
    assert list(taken.rows) == [(2, ["1", "2"]), (3, ["1", "2"]), (4, ["1", "2"])]
    rows = (f"{n / 2000:.4f},51.5,{9.25 + 1e-8 * n:.8f},{n % 9}" for n in range(60_000))
    log = plain(tmp_path, *rows)
    took, _ = survey.samples(log, PLAIN)
    assert (took.rows, len(took.times_s)) == (60_000, 150)


# ---- what nobody can mean ----


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"wind": (2.0, math.inf)}, "wind 2,inf is not allowed; wanted a speed from 0 to"),
        ({"wind": (math.nan, 3.0)}, "wind nan,3 is not allowed"),
        ({"wind": (-2.0, 3.0)}, "wind -2,3 is not allowed"),
        ({"origin": (math.nan, 0.0)}, "origin nan,0 is not allowed; wanted m north and m east"),
        ({"area_m": math.inf}, "an area of inf m is not allowed; wanted a number above 0"),
        ({"columns": "gasflux,time=timestamp@+25:00"}, "time=timestamp@+25:00 is not allowed"),
    ],
)
def test_a_wind_place_or_zone_that_cannot_be_is_one_line(wanted: dict, words: str, tmp_path: Path) -> None:
    assert words in refused(written(tmp_path), **wanted)


def test_a_date_before_1970_is_no_time(tmp_path: Path) -> None:
    rows = [row.replace("2026-", "1904-") for row in ROWS]
    assert "timestamp is '1904-06-01 09:00:00'; wanted a time" in refused(written(tmp_path, rows))


def test_one_wrong_time_does_not_empty_a_flight_in_silence(tmp_path: Path) -> None:
    ahead = [*ROWS[:2], ROWS[2].replace("2026-", "2036-"), *ROWS[3:]]
    words = refused(written(tmp_path, ahead))
    assert "9 of its 12 rows are earlier than a row before: first row 5: timestamp is" in words
    before_the_fix = [ROWS[0].replace("2026-", "1980-"), *ROWS[1:]]
    words = refused(written(tmp_path, before_the_fix))
    assert "11 of its 12 readings are later than 49 days after the first row, 1980-06-01 09:00:00" in words


def test_rows_are_numbered_as_in_the_file_whatever_came_before(tmp_path: Path) -> None:
    log = written(tmp_path, [HEADER, *ROWS[:3], "noon,51.5,9.25,4,2,270,15,1013,2", *ROWS[4:]], "\n\n ")
    assert any("first row 8: timestamp is 'noon'" in note for note in read(log).notes)  # its line


def test_names_of_columns_may_hold_delimiters_and_breaks_between_quotes(tmp_path: Path) -> None:
    rows = [row.replace(",", ";") for row in ROWS]
    header = (
        HEADER.replace(",", ";")
        .replace("pressure", '"pressure\n[hPa]"')
        .replace("height_ato", '"a,b,c,d,e,f,g,h,i,j"')
    )
    log = written(tmp_path, rows, header)
    columns = "gasflux,height=,pressure=pressure [hPa]"
    said = readings(read(log, columns=columns))
    assert [reading.gas for reading in said] == [
        reading.gas for reading in readings(read(written(tmp_path, name="plain.csv")))
    ]


def test_a_quote_that_is_not_closed_does_not_take_the_rest_of_a_flight(tmp_path: Path) -> None:
    many = [f"{n},51.5,9.{250_000 + 100 * n},1" for n in range(60)]
    words = refused(plain(tmp_path, *many[:30], f'"{many[30]}', *many[31:]), columns=PLAIN, wind=CALM)
    assert words.endswith(
        'row 32: its quote (") is not closed before row 61; wanted quotes in pairs, within 20 rows'
    )
    remark = f'"{many[30]}\nin three\nlines"'
    assert (
        len(readings(read(plain(tmp_path, *many[:30], remark, *many[31:]), columns=PLAIN, wind=CALM))) == 59
    )


def test_a_comma_that_may_part_thousands_is_no_number_beside_points(tmp_path: Path) -> None:
    rows = [f'{n},51.5,9.{250_000 + 100 * n},"{n + 1},900"' for n in range(3)]
    assert "gas is '1,900'; wanted a number" in refused(plain(tmp_path, *rows), columns=PLAIN, wind=CALM)
