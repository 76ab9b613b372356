"""`python -m tests.autopilots ardupilot|px4`: an autopilot double as a process."""

import argparse
import contextlib
import sys

from tests.autopilots.faults import FAULTS
from tests.autopilots.settings import Settings
from tests.autopilots.wire import KINDS, Double


def numbers(text: str) -> tuple[float, ...]:
    """Numbers with commas between them."""
    return tuple(map(float, text.split(",")))


def parameter(text: str) -> tuple[str, float]:
    """NAME=VALUE."""
    name, value = text.split("=")
    return name, float(value)


def parser() -> argparse.ArgumentParser:
    """The arguments, with the table of faults below them."""
    rows = "\n".join(f"  {name:9} {kind.argument:8} {kind.does}" for name, kind in FAULTS.items())
    new = argparse.ArgumentParser(
        "python -m tests.autopilots",
        epilog=f"Faults, NAME[@WHEN][:ARGUMENT], WHEN 12 (s after boot), +12 (s after take-off) or #3 "
        f"(with the third target):\n{rows}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    new.add_argument("kind", choices=KINDS)
    new.add_argument(
        "--listen",
        help="tcp:HOST:PORT, udpin:HOST:PORT, udp:HOST:PORT (sends there) or udp (PX4: 14580+I to 14540+I)",
    )
    new.add_argument("-I", "--instance", type=int, default=0, help="system id minus 1")
    new.add_argument("--speedup", type=float, default=1.0)
    new.add_argument("--seed", type=int, default=0)
    new.add_argument("--ready", type=float, help="s after boot at which the EKF has a position")
    new.add_argument("--home", type=numbers, default=Settings.home, help="N,E,D in m from the EKF's origin")
    new.add_argument(
        "--wind",
        type=numbers,
        default=Settings.wind,
        help="what it says of the wind: degrees it comes from, m/s",
    )
    new.add_argument("--radio", action="store_true", help="a pilot with a radio is there")
    new.add_argument("--param", type=parameter, action="append", default=[], metavar="NAME=VALUE")
    new.add_argument("--fault", action="append", default=[], metavar="FAULT")
    return new


def main() -> None:
    """Run until interrupted; the first line on stdout is what a client connects to."""
    given = parser().parse_args()
    listen = given.listen or ("udp" if given.kind == "px4" else f"tcp:127.0.0.1:{5760 + 10 * given.instance}")
    try:
        settings = Settings(
            given.seed,
            given.instance,
            given.ready,
            given.home,
            given.wind,
            given.radio,
            tuple(given.param),
            tuple(given.fault),
        )
        double = Double(given.kind, listen, settings, given.speedup)
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
    with double, contextlib.suppress(KeyboardInterrupt):
        print(double.url, flush=True)
        double.wait()


if __name__ == "__main__":
    main()
