"""The README's figures from the rows in results/.

    python -m benchmarks.readme            # writes them into README.md
    python -m benchmarks.readme --check    # says which lines of README.md differ, with exit status 1

A line of the table is known by its first cell.
"""

import csv
import sys
from pathlib import Path

from agent.trials.evaluate import read_csv
from agent.trials.figures import cell, figures
from agent.trials.report.results import USUAL
from link import cli

ROOT = Path(__file__).parents[1]
PAGE, RESULTS = ROOT / "README.md", ROOT / "results"
POLICIES = (
    ("`ppo`, learned", "learned-particles", "ppo", "results"),
    ("`homing`, the default", "particles", "homing", "results"),
    ("`infotaxis`", "particles", "infotaxis", "results"),
    ("`random`", "particles", "random", "results"),
)
"""(first cell, file of rows, policy, page)."""
WORLDS = (("`homing`, true wind 30° off", "wind-30"), ("`homing`, gas with cv = 1", "cv-1"))
"""(first cell, world): false stops of homing with the usual stop under both assumptions."""


def with_unit(figure: str, unit: str) -> str:
    """Put a unit behind the value of `VALUE [LOW, HIGH]`."""
    value, _, interval = figure.partition(" ")
    return f"{value}{unit} {interval}"


def lines() -> dict[str, str]:
    """Return the lines of the table by their beginnings."""
    said = {}
    rows = {name: read_csv(RESULTS / f"{name}.csv.gz") for name in dict.fromkeys(row[1] for row in POLICIES)}
    for first, name, policy, page in POLICIES:
        usual = figures(
            [row for row in rows[name] if (row.policy, row.particles, row.threshold_m) == (policy, *USUAL)]
        )
        parts = (
            f"located {with_unit(cell(usual, 'located'), '%')}",
            f"false stops {with_unit(cell(usual, 'false_stop'), '%')}",
            f"MTD {with_unit(cell(usual, 'mtd_m'), ' m')}",
            with_unit(cell(usual, "mtd_floors"), " floors"),
        )
        said[f"| {first} |"] = f" {', '.join(parts)} | `make results` | [{page}](docs/{page}.md) |"
    with (RESULTS / "trust" / "figures.csv").open(newline="") as file:
        trust = {
            tuple(row[key] for key in ("assume", "policy", "world", "stop")): row
            for row in csv.DictReader(file)
        }
    for first, world in WORLDS:
        rates, missions = {}, {}
        for assume in ("field", "paper"):
            row = trust[assume, "homing", world, "spread:0.5"]
            rate, low, high = (100 * float(row[f"false_stop{end}"]) for end in ("", "_low", "_high"))
            rates[assume], missions[assume] = (
                f"{rate:.1f}% [{low:.1f}, {high:.1f}]",
                f"{int(row['missions']):,}",
            )
        said[f"| {first} |"] = (
            f" false stops {rates['field']} by default ({missions['field']} missions), {rates['paper']} with "
            f"`--assume paper` ({missions['paper']}) | `make mismatch` | [trust](docs/trust.md) |"
        )
    return said


def main() -> int:
    """Write the figures, or check them."""
    parser = cli.Parser(prog="python -m benchmarks.readme", description="The README's figures from results/.")
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a line differs")
    args = parser.parse_args()
    before = PAGE.read_text().splitlines()
    made = lines()
    missing = [first for first in made if not any(line.startswith(first) for line in before)]
    after = [
        next((first + rest for first, rest in made.items() if line.startswith(first)), line)
        for line in before
    ]
    for line in (*missing, *(new for old, new in zip(before, after, strict=True) if old != new)):
        print(f"README.md: wanted a line {line}", file=sys.stderr)
    if not args.check:
        PAGE.write_text("\n".join(after) + "\n")
    return 1 if missing or (args.check and before != after) else 0


if __name__ == "__main__":
    sys.exit(main())
