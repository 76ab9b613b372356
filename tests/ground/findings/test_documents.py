"""Protects the documents of the findings: other programs read them, they agree with each other and with the
record, and nothing of a record is markup, a script or a formula in them.
"""

import csv
import io
import json
import math
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import jsonschema
import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from ground.findings.documents import DOCUMENTS, write
from ground.findings.exchange import cell, figures_csv, geojson, kml, readings_csv
from ground.findings.figures import Findings, as_json, findings_of
from ground.findings.flight import Remark, sha256_of
from ground.findings.page import page
from ground.findings.verdict import OUTSIDE, Judgement
from link.bus.mavlink import Codec
from link.record.reader import read
from link.record.record import Entry
from link.record.writer import Writer
from plume.geodesy import to_local
from tests.ground.findings.records import FOUND, GOLDEN, believing, findings, of_format, rewritten

KML = "{http://www.opengis.net/kml/2.2}"
POSITION = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 3}
RING = {"type": "array", "items": POSITION, "minItems": 4}
COORDINATES = {
    "Point": POSITION,
    "LineString": {"type": "array", "items": POSITION, "minItems": 2},
    "Polygon": {"type": "array", "items": RING, "minItems": 1},
    "MultiPolygon": {"type": "array", "items": {"type": "array", "items": RING, "minItems": 1}},
}
GEOJSON = {
    "type": "object",
    "required": ["type", "features"],
    "properties": {
        "type": {"const": "FeatureCollection"},
        "features": {
            "type": "array",
            "items": {
                "type": "object",
                "required": ["type", "geometry", "properties"],
                "properties": {
                    "type": {"const": "Feature"},
                    "properties": {"type": "object"},
                    "geometry": {
                        "oneOf": [
                            {"type": "null"},
                            *(
                                {
                                    "type": "object",
                                    "required": ["type", "coordinates"],
                                    "properties": {"type": {"const": kind}, "coordinates": shape},
                                }
                                for kind, shape in COORDINATES.items()
                            ),
                        ]
                    },
                },
            },
        },
    },
}
"""RFC 7946, as far as we write it."""


@pytest.fixture(scope="module")
def found() -> Findings:
    return findings()


def text_of(markup: str) -> str:
    """Return a page without its marks."""
    return " ".join(re.sub(r"<[^>]*>", " ", markup).split())


def collection(it: Findings) -> dict[str, Any]:
    said = json.loads(geojson(it), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    jsonschema.validate(said, GEOJSON)
    return said


def features(it: Findings, kind: str) -> list[dict[str, Any]]:
    return [each for each in collection(it)["features"] if each["properties"]["kind"] == kind]


def local(it: Findings, position: list[float]) -> tuple[float, float]:
    lon, lat = position[:2]
    assert it.flight.home
    north, east = to_local(*it.flight.home, lat, lon)
    return east, north


# ---- what they say ----


def test_the_geojson_puts_the_source_where_the_belief_has_it(found: Findings) -> None:
    [source] = features(found, "source")
    assert local(found, source["geometry"]["coordinates"]) == pytest.approx(found.last.mean, abs=0.005)
    told = source["properties"]
    assert [told["longitude_deg"], told["latitude_deg"]] == pytest.approx(
        source["geometry"]["coordinates"], abs=1e-8
    )
    assert told["rate_kgh"] == pytest.approx(3.6 * told["rate_gs"])
    low, high = told["rate_interval_gs"]
    assert 0 < low < told["rate_gs"] < high
    assert told["covariance_m2"] == list(found.last.covariance)


def test_the_regions_of_the_geojson_are_closed_run_counter_clockwise_and_hold_the_source(
    found: Findings,
) -> None:
    for kind in ("region_95_ellipse", "region_95_contour", "area"):
        [region] = features(found, kind)
        shape = region["geometry"]
        polygons = [shape["coordinates"]] if shape["type"] == "Polygon" else shape["coordinates"]
        outer = [[local(found, position) for position in rings[0]] for rings in polygons]
        for places in outer:
            assert places[0] == places[-1]
            twice = math.fsum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise(places))
            assert twice > 0
        x, y = found.last.mean
        xs, ys = zip(*max(outer, key=len), strict=True)
        assert min(xs) < x < max(xs)
        assert min(ys) < y < max(ys)


def test_every_reading_is_in_geojson_kml_and_csv_with_its_time_in_utc(found: Findings) -> None:
    beliefs = [entry for entry in read(FOUND).entries if entry.key == "belief"]
    rows = list(csv.DictReader(io.StringIO(readings_csv(found))))
    points = features(found, "reading")
    marks = [
        mark
        for mark in ElementTree.fromstring(kml(found)).iter(f"{KML}Placemark")
        if (mark.findtext(f"{KML}name") or "").startswith("Reading")
    ]
    assert len(rows) == len(points) == len(marks) == len(beliefs)
    for row, point, mark, entry in zip(rows, points, marks, beliefs, strict=True):
        said = json.loads(entry.payload)
        assert float(row["gas"]) == pytest.approx(said["gas"], rel=1e-6)
        assert row["vehicle"] == "1"
        assert row["gas_unit"] == point["properties"]["unit"] == "g/m³"
        assert (float(row["x_m"]), float(row["y_m"])) == pytest.approx(said["position"], rel=1e-6)
        assert local(found, point["geometry"]["coordinates"]) == pytest.approx(said["position"], abs=0.005)
        at = mark.findtext(f"{KML}TimeStamp/{KML}when")
        assert at == row["time_utc"] == point["properties"]["time_utc"]
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", at)


def test_the_kml_has_longitude_first_and_the_same_places(found: Findings) -> None:
    document = ElementTree.fromstring(kml(found))
    source = next(
        mark
        for mark in document.iter(f"{KML}Placemark")
        if (mark.findtext(f"{KML}name") or "").startswith("Source")
    )
    lon, lat = map(float, (source.findtext(f"{KML}Point/{KML}coordinates") or "").split(","))
    assert [lon, lat] == features(found, "source")[0]["geometry"]["coordinates"]
    styles = {style.get("id") for style in document.iter(f"{KML}Style")}
    assert {(url.text or "").lstrip("#") for url in document.iter(f"{KML}styleUrl")} <= styles


def test_the_figures_are_the_same_in_json_and_csv(found: Findings) -> None:
    figures = as_json(found)
    rows = {(row["figure"], row["unit"]): row for row in csv.DictReader(io.StringIO(figures_csv(found)))}
    rate = rows["rate", "g/s"]
    assert float(rate["value"]) == pytest.approx(figures["rate_gs"], rel=1e-6)
    assert [float(rate["low_95"]), float(rate["high_95"])] == pytest.approx(
        figures["rate_interval_gs"], rel=1e-6
    )
    assert float(rows["latitude", "deg"]["value"]) == pytest.approx(figures["latitude_deg"], abs=1e-6)
    assert rows["record SHA-256", ""]["value"] == figures["record"]["sha256"] == sha256_of(FOUND)


def test_the_page_says_what_was_found_and_what_it_rests_on(found: Findings) -> None:
    text = page(found)
    for words in (
        "found",
        "(WGS84)",
        "g/s",
        "kg/h",
        "95% region",
        "gaussian:0.3,0.2",
        "noise in clean air 0.2",
        "spread of the belief is below",
        "log-normal, median",
        found.flight.sha256,
        "(UTC)",
        "NumPy",
        "diffusivity d =",
        "seed",
    ):
        assert words in text, words
    assert len(re.findall("<svg ", text)) == 2
    assert ">N</text>" in text  # the north arrow


def test_of_readings_that_are_all_the_same_the_page_does_not_say_how_much_they_need_a_plume(
    found: Findings,
) -> None:
    same = [sample._replace(gas=2.0) for sample in found.flight.samples]
    said = text_of(page(replace(found, flight=found.flight._replace(samples=same))))
    assert "A plume is needed no: all readings are the same" in said
    assert re.search(r"A plume is needed by [\d.]+ nats", text_of(page(found)))


def test_the_page_needs_nothing_from_elsewhere(found: Findings) -> None:
    text = page(found)
    assert "<script" not in text
    addresses = re.findall(r"""(?:src|href)\s*=\s*["']([^"']+)|url\(([^)]+)\)|@import""", text)
    assert all(a.startswith("data:") or b.startswith("#") for a, b in addresses)
    assert "default-src 'none'" in text


def test_all_documents_are_written_whole_and_the_same_twice(found: Findings, tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        write(replace(found, made_ns=0), folder)
    assert sorted(path.name for path in one.iterdir()) == sorted(DOCUMENTS)
    assert all((one / name).read_bytes() == (two / name).read_bytes() for name in DOCUMENTS)


def test_where_nothing_was_found_no_document_calls_a_place_the_source(tmp_path: Path) -> None:
    def cut_short(entry: Entry) -> Entry | None:
        return None if entry.key == "belief" and json.loads(entry.payload)["step"] > 3 else entry

    it = findings(rewritten(tmp_path / "short.mcap", cut_short))
    assert it.verdict.kind == "not found"
    assert it.smallest
    names = [each.text for each in ElementTree.fromstring(kml(it)).iter(f"{KML}name")]
    assert "Centre of the belief, no find" in names
    assert not [name for name in names if name and name.startswith("Source")]
    assert "Release rate if there is a source: " in kml(it)
    rows = {row["figure"]: row["value"] for row in csv.DictReader(io.StringIO(figures_csv(it)))}
    share = np.isfinite(it.smallest.rates_gs).mean()
    assert float(rows["smallest rate, share of the area that has one"]) == pytest.approx(share)


def test_a_stop_outside_is_not_told_as_that_of_the_criterion(found: Findings) -> None:
    outside = replace(found, verdict=Judgement(OUTSIDE, "It is outside."), smallest=None)
    assert "m; the search stopped because the source is outside the area<" in page(outside)
    assert "m; met<" in page(found)


# ---- records of all kinds ----


@pytest.mark.parametrize(
    "record",
    [
        pytest.param(path, id=path.stem, marks=() if path.stem == "ppo-hits" else pytest.mark.full)
        for path in sorted(GOLDEN.glob("*.mcap"))
    ],
)
def test_every_golden_record_gives_findings_that_other_programs_read(record: Path) -> None:
    it = findings(record)
    it = replace(it, smallest=None)  # which takes long
    collection(it)
    ElementTree.fromstring(kml(it))
    json.loads(DOCUMENTS["findings.json"](it))
    assert it.verdict.kind in page(it)
    if it.last.assume == "paper":
        assert it.rate.low is None
        assert "as told" in page(it)


@pytest.mark.parametrize("written", [None, 1])
def test_a_record_of_an_older_format_gives_the_same_findings(tmp_path: Path, written: int | None) -> None:
    older = findings(of_format(tmp_path / "older.mcap", written))
    today = findings()
    told = [as_json(it) for it in (older, today)]
    for each in told:
        del each["made_by"]
        del each["record"]["sha256"], each["record"]["file"]
    assert told[0] == told[1]


def test_beliefs_of_older_versions_lack_fields_and_still_give_findings(tmp_path: Path) -> None:
    later = ("assume", "stop", "evidence", "outside", "wind_p_value", "intermittency", "advised_dwell")

    def older(entry: Any) -> Any:
        if entry.key != "belief":
            return entry
        said = {name: value for name, value in json.loads(entry.payload).items() if name not in later}
        return entry._replace(payload=json.dumps(said).encode())

    it = findings(rewritten(tmp_path / "old.mcap", older))
    assert it.last.assume == "paper"
    assert "spread of the belief" in page(it)
    collection(it)


def test_a_record_without_particles_has_the_ellipse_and_an_interval_by_mean_and_deviation(
    tmp_path: Path,
) -> None:
    it = findings(rewritten(tmp_path / "bare.mcap", lambda entry: entry._replace(attachment=b"")))
    assert it.contour is None
    assert features(it, "region_95_contour") == []
    std = it.last.stds[it.last.unknowns.index("q")]
    assert it.rate.high == pytest.approx(it.last.rate + 1.96 * std, rel=1e-3)


def test_without_a_home_positions_are_null_and_the_page_says_so(found: Findings) -> None:
    it = replace(found, flight=found.flight._replace(home=None, home_by="nobody"))
    assert all(each["geometry"] is None for each in collection(it)["features"])
    assert list(ElementTree.fromstring(kml(it)).iter(f"{KML}Placemark")) == []
    assert "nobody said where that is on earth" in page(it)
    assert as_json(it)["latitude_deg"] is None


def test_a_second_mission_in_a_record_is_the_one_that_is_told(tmp_path: Path) -> None:
    """As a vehicle leaves it that was started again under the same recorder."""
    recording = read(FOUND)
    late_ns = 10**12

    def twice(entry: Any) -> Any:
        return entry

    path = rewritten(tmp_path / "one.mcap", twice)
    recording = read(path)
    both = tmp_path / "both.mcap"
    writer = Writer(both, dict(recording.about))
    for entry in recording.entries:
        writer.write(entry, entry.published_ns)
    for entry in recording.entries:
        if entry.key == "belief":
            said = json.loads(entry.payload)
            said["time_boot_ms"] += 1_000_000
            if said["step"] > 5:
                continue
            entry = entry._replace(payload=json.dumps(said).encode())
        writer.write(entry._replace(published_ns=entry.published_ns + late_ns), entry.published_ns + late_ns)
    writer.close()
    it = findings(both)
    assert len(it.flight.samples) == 6
    assert not it.last.ceased


# ---- hostile records ----

EVIL = "<script>alert(1)</script>\"'&\x00\x1b[31m\u202e=cmd|' /C calc'!A0"


def evil(found: Findings) -> Findings:
    said = found.flight.warnings[:1] or []
    return replace(
        found,
        flight=found.flight._replace(
            path=Path("=2+5<b>.mcap"),
            about={
                "seed": EVIL,
                "policy": EVIL,
                "git": EVIL,
                "versions": {EVIL: EVIL},
                "parts": {"estimator": ["--prior", f"q={EVIL}", EVIL]},
                "mission": {"world": EVIL},
            },
            warnings=[*said, Remark(0, EVIL, EVIL), Remark(0, "uav", "=HYPERLINK(1)")],
            remark=EVIL,
        ),
    )


def test_nothing_of_a_record_is_markup_on_the_page(found: Findings) -> None:
    text = page(evil(found))
    assert "<script" not in text
    assert "\x1b" not in text
    assert "\u202e" not in text
    assert "<b>.mcap" not in text
    assert "&lt;script&gt;" in text


def test_nothing_of_a_record_is_markup_in_kml(found: Findings) -> None:
    document = ElementTree.fromstring(kml(evil(found)))
    assert document.find(f".//{KML}script") is None
    assert document.find(f".//{KML}b") is None


def test_nothing_of_a_record_is_markup_in_a_description_which_viewers_show_as_html(found: Findings) -> None:
    warned = found.flight._replace(estimator_warned=[Remark(0, "estimator", "<img src=x> a & b")])
    document = ElementTree.fromstring(kml(findings_of(warned)))
    told = [each.text or "" for each in document.iter(f"{KML}description")]
    assert sum("&lt;img src=x&gt; a &amp; b" in text for text in told) == 2  # the document's, the source's
    assert not [text for text in told if "<" in text]


def test_nothing_of_a_record_is_a_formula_in_csv(found: Findings) -> None:
    rows = list(csv.reader(io.StringIO(figures_csv(evil(found)))))
    texts = [value for row in rows for value in row]
    assert not [text for text in texts if text[:1] in "=+@\t\r" and text]
    assert not [text for text in texts if text.startswith("-") and not re.fullmatch(r"-[\d.e+-]+", text)]
    assert any(text.startswith("'=2+5") for text in texts)


@pytest.mark.parametrize("text", ["=1+1", "+1+1", "-1+1", "@SUM(A1)", "  =1", "-cmd"])
def test_a_text_that_begins_like_a_formula_gets_an_apostrophe(text: str) -> None:
    assert cell(text) == f"'{text}"


@pytest.mark.parametrize("value", [-1.5, 3, "plain", "-1.5", ""])
def test_numbers_and_plain_texts_stay_as_they_are(value: object) -> None:
    assert cell(value) == (f"{value:.9g}" if isinstance(value, float) else value)


@pytest.mark.parametrize(
    "change",
    [
        {"mean": (1e300, -1e300)},
        {"covariance": (0.0, 0.0, 0.0), "spread": 0.0},
        {"covariance": (1e200, 0.0, 1e200), "spread": 1e100},
        {"sensor": "<b>"},
        {"stop": "spread:"},
        {"stop": "within:x,y"},
        {"assume": "<i>"},
        {"intermittency": {"<u>": (0.0, 1.0, 2.0)}},
        {"z": 1e30},
    ],
    ids=str,
)
def test_absurd_beliefs_give_documents_all_the_same(tmp_path: Path, change: dict[str, Any]) -> None:
    it = findings(
        rewritten(tmp_path / "x.mcap", believing(lambda said: msgspec.structs.replace(said, **change)))
    )
    it = replace(it, smallest=None)
    text = page(it)
    assert "<b>" not in text.replace(f"<b>{it.verdict.kind}</b>", "")
    assert "<i>" not in text
    assert "<u>" not in text
    assert "nan" not in text.lower().replace("nanosecond", "")
    collection(it)
    ElementTree.fromstring(kml(it))
    json.loads(DOCUMENTS["findings.json"](it))


@pytest.mark.parametrize(
    "about",
    [
        {},
        {"parts": 3, "mission": "x", "versions": [], "budget": "many", "scenario": {"source": 1}},
        {"parts": {"estimator": "--rate"}, "mission": {"vehicle": {"home_lat_deg": "x"}, "world": 3}},
        {"parts": {"estimator": ["--area", "nan", "--margin", "x", 3]}},
    ],
    ids=str,
)
def test_a_description_that_is_not_as_expected_gives_documents_all_the_same(
    tmp_path: Path, about: dict[str, Any]
) -> None:
    it = findings(rewritten(tmp_path / "x.mcap", about=about))
    assert "SHA-256" in page(it)
    collection(it)


def test_the_findings_of_a_replayed_log_have_the_times_of_its_flight(tmp_path: Path) -> None:
    """Its record was written later: only the vehicle's SYSTEM_TIME has the time of the flight."""
    noon_us = 1_790_000_000_000_000
    codec = Codec(1, 1)

    def dated(entry: Entry) -> Entry:
        if entry.key != "mavlink/out":
            return entry
        time = mavlink.MAVLink_system_time_message(noon_us, 40_000)  # 40 s after the vehicle's start
        return entry._replace(payload=codec.pack(time))

    about = {**read(FOUND).about, "log": {"file": "flight.csv", "notes": []}}
    it = findings(rewritten(tmp_path / "replayed.mcap", dated, about))
    [at_ms] = [
        said["time_boot_ms"]
        for entry in read(FOUND).entries
        if entry.key == "belief" and (said := json.loads(entry.payload))["step"] == 3
    ]
    assert it.flight.samples[3].utc_ns == 1000 * noon_us + 1_000_000 * (at_ms - 40_000)
    assert findings().flight.samples[3].utc_ns != it.flight.samples[3].utc_ns


def test_where_one_document_cannot_be_written_none_is_and_older_ones_stay(tmp_path: Path) -> None:
    (tmp_path / "readings.csv").mkdir()  # the last one
    (tmp_path / "findings.html").write_text("older")
    with pytest.raises(IsADirectoryError):
        write(findings(), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"readings.csv", "findings.html"}
    assert (tmp_path / "findings.html").read_text() == "older"


def test_a_date_of_a_clock_that_nobody_has_set_is_told_as_none() -> None:
    it = findings()
    words = "by a clock that was not set: no date is known"
    assert words not in page(it)
    since_1970 = it.flight.began_ns  # a log without a date counts from 1970
    samples = [each._replace(utc_ns=each.utc_ns - since_1970) for each in it.flight.samples]
    undated = page(replace(it, flight=it.flight._replace(samples=samples)))
    last_ms = samples[-1].utc_ns // 1_000_000
    assert 0 < last_ms < 1000
    assert undated.count(f"1970-01-01T00:00:00.{last_ms:03}Z (UTC), {words}") == 2
