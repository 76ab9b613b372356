"""The findings as one self-contained HTML page, light, for screens and for paper."""

from collections.abc import Iterable, Sequence
from html import escape

from ground.findings.assumed import calibration, stop_text
from ground.findings.background import Background
from ground.findings.chart import near_map, rates_map, whole_map
from ground.findings.figures import Findings, as_json, simulated_source
from ground.findings.flight import Flight
from ground.findings.numbers import degree_decimals, rounded, significant, utc
from ground.findings.unseen import METHOD
from ground.findings.verdict import CLEAR, DOUBTFUL, FOUND, INCOMPATIBLE, NOT_FOUND, OUTSIDE
from ground.findings.words import (
    believed_from_text,
    compass,
    ellipse_text,
    place_name,
    place_text,
    quantile_text,
    ranged_text,
    rate_name,
    rate_text,
    smallest_text,
)
from link.terminal import printable
from plume.outcome import gas_lines

MOST_WARNINGS = 200
EARLIEST_NS = 946_684_800 * 10**9  # 2000 in UTC: no flight was earlier
NEAR = 0.2  # a region that is smaller than this share of the area has a map of its own
COLOURS = {FOUND: "#dff5ec", DOUBTFUL: "#fdf3da", OUTSIDE: "#e4eef6", NOT_FOUND: "#eef0f2"}
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # of the page: nothing from elsewhere
CSS = """
:root { color-scheme: light; --ink: #1a2129; --faint: #56616d; --rule: #d5dbe1; --band: #f6f8fa; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.25rem 3rem; max-width: 60rem; color: var(--ink); background: #fff;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; } h2 { font-size: 1.1rem; margin: 1.8rem 0 .5rem; }
p { margin: .4rem 0; max-width: 50rem; } .faint { color: var(--faint); font-size: .87rem; }
.verdict { border: 1px solid var(--rule); border-radius: 8px; padding: .8rem 1rem; margin: 1rem 0;
  font-size: 1.05rem; }
.verdict b { text-transform: uppercase; letter-spacing: .03em; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { text-align: left; vertical-align: top; padding: .28rem .6rem .28rem 0;
  border-bottom: 1px solid var(--rule); overflow-wrap: anywhere; }
th { font-weight: 600; } table.pairs th { width: 14rem; color: var(--faint); font-weight: 500; }
svg { display: block; width: 100%; height: auto; } figure { margin: .5rem 0; break-inside: avoid; }
figcaption { color: var(--faint); font-size: .87rem; } code { font-size: .88em; overflow-wrap: anywhere; }
.priors td:first-child, .priors td:last-child, .said td:first-child, .said td:nth-child(2) {
  white-space: nowrap; overflow-wrap: normal; }
.maps { display: grid; gap: 1rem; } .near { max-width: 44rem; }
@page { size: A4; margin: 14mm; }
@media (max-width: 40rem) { table.pairs th { width: 8rem; } .maps figure { min-width: 0; overflow-x: auto; }
  .maps svg { min-width: 36rem; } table:not(.pairs) { display: block; overflow-x: auto; }
  table:not(.pairs) td { min-width: 7rem; overflow-wrap: break-word; } }
@media print { body { padding: 0; max-width: none; font-size: 10.5pt; } h2 { break-after: avoid; }
  tr { break-inside: avoid; } .verdict { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  .maps { max-width: 165mm; } svg { -webkit-print-color-adjust: exact; print-color-adjust: exact; } }
"""


def page(it: Findings, background: Background | None = None) -> str:
    """Return the whole page."""
    title = f"Findings: {it.flight.path.name}"
    sections = [
        _section("Findings", _pairs(_glance(it))),
        _section("Map", _maps(it, background)),
        _not_found(it),
        _section("Wind and gas", _pairs(_air(it))),
        _section("What was assumed", _assumed(it)),
        _section("Checks", _pairs(_checks(it))),
        _section("Warnings of the mission", _warnings(it)),
        _section("Flight and record", _pairs(_provenance(it))),
        _section("How to read this", "".join(f"<p>{_e(text)}</p>\n" for text in READ)),
    ]
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{_e(title)}</title>
<style>{CSS}</style>
</head>
<body>
<h1>{_e(title)}</h1>
<p class="faint">Flown {_e(_flown(it))}</p>
<p class="verdict" style="background: {COLOURS[it.verdict.kind]}"><b>{_e(it.verdict.kind)}</b><br>
{_e(sentence(it))}</p>
{"".join(sections)}
</body>
</html>
"""


def _e(text: object) -> str:
    return escape(printable(str(text)))


def _flown(it: Findings) -> str:
    simulated = ". A simulated flight: the gas is a simulator's." if simulated_source(it) else ""
    return f"{_times(it.flight)}{simulated}"


def _times(flight: Flight) -> str:
    told = f"{utc(flight.began_ns)} to {utc(flight.ended_ns)} (UTC)"
    return (
        told if flight.began_ns >= EARLIEST_NS else f"{told}, by a clock that was not set: no date is known"
    )


def sentence(it: Findings) -> str:
    """Return the verdict, and of a find where it is and how much it releases."""
    if it.verdict.kind in (NOT_FOUND, OUTSIDE):
        return " ".join([it.verdict.sentence, *smallest_text(it)[:2]])
    return (
        f"{it.verdict.sentence} It is at {place_text(it)}, within the 95% region below, and releases "
        f"{rate_text(it)}."
    )


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{_e(title)}</h2>\n{content}\n</section>\n" if content else ""


def _pairs(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of names and values."""
    told = "".join(f"<tr><th scope=row>{_e(name)}</th><td>{_e(value)}</td></tr>\n" for name, value in rows)
    return f'<table class="pairs">\n{told}</table>'


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    told = "".join(f"<tr>{''.join(f'<td>{_e(value)}</td>' for value in row)}</tr>\n" for row in rows)
    head = "".join(f"<th scope=col>{_e(name)}</th>" for name in heads)
    return f'<table class="{kind}">\n<thead><tr>{head}</tr></thead>\n<tbody>\n{told}</tbody>\n</table>'


def _glance(it: Findings) -> list[tuple[str, str]]:
    x, y = it.last.mean
    half = it.ellipse.shorter_m
    height = "as told"
    if it.last.z == it.last.altitude_m:
        height = f"taken to be that of the {'end of the path' if it.path_m else 'flight'}"
    return [
        (place_name(it), place_text(it)),
        (
            "From home",
            f"{_metres(x, half)} m east, {_metres(y, half)} m north",
        ),
        ("95% region", ellipse_text(it) + _scale_text(it) + (_contour_text(it) if it.contour else "")),
        (
            "Height above home",
            f"{ranged_text(it.height, 'm')}" if it.height else f"{significant(it.height_m)} m, {height}",
        ),
        (rate_name(it), rate_text(it)),
        (
            "The rate is relative to",
            f"the effective diffusivity d = {significant(it.last.diffusivity)} m²/s, which was told: twice "
            "the d is twice the rate",
        )
        if "d" not in it.last.unknowns
        else ("Diffusivity", f"{significant(it.last.diffusivity)} m²/s, estimated"),
    ]


def _metres(value: float, half_m: float) -> str:
    return rounded(value, 2 if half_m < 1 else 1)


def _scale_text(it: Findings) -> str:
    told = significant(it.scale, 2)
    return "" if told == "1.0" else f", {told} times as wide as the belief's own"


def _contour_text(it: Findings) -> str:
    assert it.contour
    count = len(it.contour.rings)
    parts = "" if count == 1 else f", {count} outlines"
    return f"; the particles' own contour is on the map and in the GeoJSON{parts}"


def _maps(it: Findings, background: Background | None) -> str:
    whole = whole_map(it, background)
    near = ""
    if it.ellipse.longer_m < NEAR * it.area.side_m:
        near = (
            f'<figure class="near">{near_map(it)}<figcaption>The estimate (cross), the belief\'s particles '
            "(dots) and the 95% region: ellipse (dashed) and contour (filled).</figcaption></figure>"
        )
    return f"""<div class="maps">
<figure>{whole}<figcaption>Track (line) and readings (dots){_vehicles_text(it)}. Dashed rectangle: the search
area{_grounds_text(it)}. Cross: the estimate; dashed ellipse and filled contour: its 95% region. North is up.
</figcaption></figure>
{near}
</div>"""


def _vehicles_text(it: Findings) -> str:
    return " of each vehicle, its name where it began" if len(it.flight.tracks) > 1 else ""


def _grounds_text(it: Findings) -> str:
    walls = "; grey: buildings and what was kept out of" if it.flight.walls else ""
    return walls + ("; dash-dotted: what no way might leave" if it.flight.fence else "")


def _not_found(it: Findings) -> str:
    if it.smallest is None:
        return ""
    lines = "".join(f"<p>{_e(line)}</p>\n" for line in smallest_text(it))
    return _section(
        "The smallest rate that this flight would have seen",
        f'{lines}<div class="maps"><figure>{rates_map(it)}<figcaption>The smallest release rate that would '
        f"have been seen with 90% probability, by place; grey: none. {_e(METHOD[0].upper() + METHOD[1:])}; "
        "wind, lifetime, noise and intermittency are those of the last belief, "
        f"d = {significant(it.last.diffusivity)} m²/s as told.</figcaption></figure></div>",
    )


def _air(it: Findings) -> list[tuple[str, str]]:
    wind = it.wind
    rows = [
        (
            "Wind as measured",
            f"{wind.speed_mps:.2f} m/s from {compass(wind.from_deg)}; standard deviation over the readings "
            f"{wind.speed_std_mps:.2f} m/s and {wind.from_std_deg:.1f}°",
        ),
        (
            "Speed that was believed",
            "the measured one" if wind.believed_speed is None else ranged_text(wind.believed_speed, "m/s"),
        ),
        (
            "Direction that was believed",
            "the measured one"
            if wind.believed_from is None
            else f"from {believed_from_text(wind.believed_from)}",
        ),
        ("One wind at all readings", f"p = {significant(wind.one_wind_p, 2)}"),
    ]
    for line in gas_lines(it.gas, it.last.advised_dwell or None):
        name, _, words = line.partition(" ")
        if name != "puffs":  # they are below, with more digits
            rows.append((name.capitalize(), words.strip()))
    names = {
        "downwind": "cv 3 m downwind of the source",
        "cv": "cv everywhere",
        "puff-rate": "Puffs",
        "puff-share": "Share of d that widens a puff",
    }
    rows += [
        (
            f"{names.get(name, name)} (median, 90% interval)",
            quantile_text(values, "1/s" if name == "puff-rate" else ""),
        )
        for name, values in it.gas.items()
    ]
    if not it.gas:
        rows.append(("Gas", "taken to be steady, or as the sensor says: nothing was estimated of it"))
    if "tau" in it.last.unknowns:
        std = it.last.stds[it.last.unknowns.index("tau")]
        rows.append(("Lifetime of the gas", f"{significant(it.last.lifetime)} s ± {significant(std, 2)} s"))
    else:
        rows.append(("Lifetime of the gas", f"{significant(it.last.lifetime)} s, as told"))
    return rows


def _assumed(it: Findings) -> str:
    last, told = it.last, it.told
    stopped = "met" if last.ceased else "not met"
    if it.verdict.kind == OUTSIDE:
        stopped = "the search stopped because the source is outside the area"
    numbers = calibration(told.sensor) if told.sensor else {}
    rows = [
        ("Sensor", f"{last.sensor}, readings in {it.unit}"),
        ("Calibration", "; ".join(f"{name} {value:.6g}" for name, value in numbers.items()) or "unknown"),
        ("Assumption", last.assume),
        ("Stop", f"{last.stop}: {stop_text(last.stop)}; {stopped}"),
        (
            "Area",
            f"{it.area.text}, east by north of home; the source "
            + (f"may be up to {significant(told.margin_m)} m beyond" if told.margin_m else "is in it"),
        ),
        ("False readings", f"{100 * told.spikes:g}% of the readings are taken to say nothing of the source"),
    ]
    priors = _table(
        ("unknown", "meaning", "prior", "from"),
        [
            (row.name, f"{row.meaning}, {row.unit}", row.words, "given" if row.given else "assumption")
            for row in told.priors
        ],
        "priors",
    )
    return f"{_pairs(rows)}\n<h2>Priors</h2>\n{priors}"


def _checks(it: Findings) -> list[tuple[str, str]]:
    last = it.last
    return [
        (
            "Readings fit the model",
            f"p = {significant(last.p_value, 2)} over the last 30; below {INCOMPATIBLE} there is no stop",
        ),
        (
            "A plume is needed",
            "no: all readings are the same"
            if it.flight.is_flat
            else f"by {last.evidence:.1f} nats; below {CLEAR:g} there is no stop",
        ),
        ("Belief outside the area", f"{100 * last.outside:.1f}%"),
        ("Effective particles", f"{last.effective_sample_size:.0f}"),
    ]


def _warnings(it: Findings) -> str:
    said = it.flight.warnings
    if not said and not it.flight.remark:
        return "<p>None.</p>"
    rows = [(utc(each.utc_ns), each.who, each.text) for each in said[:MOST_WARNINGS]]
    if it.flight.remark:
        rows.append(("", "record", it.flight.remark))
    more = len(said) - MOST_WARNINGS
    note = f"<p>{more:,} more are in the JSON.</p>" if more > 0 else ""
    return _table(("time (UTC)", "who", "what"), rows, "said") + note


def _provenance(it: Findings) -> list[tuple[str, str]]:
    figures = as_json(it)
    record, made, flight = figures["record"], figures["made_by"], it.flight
    rows = [
        (
            "Readings",
            f"{len(flight.samples):,} in {figures['distance_m']:.1f} m"
            + (f", of {len(flight.tracks)} vehicles" if len(flight.tracks) > 1 else ""),
        ),
        ("First and last reading", _times(flight)),
        (
            "Home",
            "unknown: nobody said where it is"
            if flight.home is None
            else f"latitude {flight.home[0]:.7f}°, longitude {flight.home[1]:.7f}° (WGS84), by "
            f"{flight.home_by}",
        ),
        ("Record", record["file"]),
        ("SHA-256 of the record", flight.sha256),
        ("Policy, seed", f"{_known(record['policy'])}, {_known(record['seed'])}"),
        (
            "Flown with",
            ", ".join(f"{name} {version}" for name, version in record["versions"].items()) or "unknown",
        ),
        ("Revision", _known(record["git"])),
        ("Estimator's flags", figures["estimator_flags"] or "unknown"),
        (
            "Findings made by",
            f"plumeward {made['plumeward']}, Python {made['python']}, NumPy {made['numpy']}, "
            f"{made['made_utc']}",
        ),
    ]
    if (source := simulated_source(it)) and (simulated := figures["simulated"]):
        places = degree_decimals(it.ellipse.shorter_m)
        there = it.on_earth(source)
        where = f" ({there[0]:.{places}f}°, {there[1]:.{places}f}°)" if there else ""
        rows.append(
            (
                "Simulated source",
                f"({source[0]:.2f}, {source[1]:.2f}) m{where}, {simulated['error_m']:.2f} m from the "
                f"estimate; world {_known(record['world'])}",
            )
        )
    return rows


def _known(value: object) -> str:
    return "unknown" if value is None or value == "" else str(value)


READ = (
    "Latitude and longitude are WGS84 degrees, lengths metres, times UTC, rates g/s and kg/h, directions "
    "degrees clockwise from north; of the wind it is where it comes from. Numbers have the digits that their "
    "interval supports.",
    "The intervals hold 95% of the belief, which is what the readings say under the assumption above. The "
    "region is the ellipse of the belief's covariance, and the smallest region that holds 95% of its "
    "particles, as contour. Where the search stopped, both are made wider or narrower, by how strongly the "
    "gas came and went: so they held the source of simulated leaks about as often as they say. Where puffs "
    "are few, the interval of the rate is wider, too. How often they hold the truth, also where the "
    "assumption is wrong, is measured: see docs/findings.md of Plumeward.",
)
