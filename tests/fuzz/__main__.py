"""Fuzzes decoders, guided by which lines of our code an input reaches: `python -m tests.fuzz [NAME ...]
[--runs N]`.

Each decoder runs in a process of its own under Atheris (libFuzzer). An input that breaks a promise, takes
more than LONGEST_S or more memory than MOST_MIB, or hangs, ends the run of its decoder and is kept in
runs/fuzz/NAME. To see it again: `python -m tests.fuzz NAME FILE`. Once it is mended, move it into
tests/fuzz/finds/NAME, where a test looks at it.
"""

import argparse
import contextlib
import logging
import os
import random
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
RUNS = 100_000
LONGEST_S, HUNG_S = 20, 300
"""Most processor time of an input, and most time at all: on a busy machine a process may stand still for a
while.
"""
MOST_MIB, LONGEST_INPUT = 2048, 4_096
FOLLOWED = ("plume", "link", "scene", "sitl", "estimator", "agent", "mcap", "ruamel")
"""Packages whose branches guide the search, except modules with kernels: those are compiled from their
bytecode.
"""
FOUND = 77
"""libFuzzer's exit status after a find."""
ONE_THREAD = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def main() -> int:
    """Fuzz what is named, or everything; returns 1 if anything was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.partition("\n")[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="a decoder; or one and the file of an input to look at again"
    )
    parser.add_argument(
        "--runs", type=int, default=RUNS, metavar="N", help="inputs for each decoder (default: %(default)s)"
    )
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.inside:
        _inside(args.names[0], args.runs, [*map(Path, args.names[1:])])
    if len(args.names) == 2 and Path(args.names[1]).is_file():
        return subprocess.run([*_command(args.names[0], 1), args.names[1]], cwd=ROOT, check=False).returncode
    from tests.fuzz.decoders import DECODERS

    if unknown := [name for name in args.names if name not in DECODERS]:
        parser.error(f"{unknown[0]!r} is not a decoder; wanted some of {', '.join(DECODERS)}")
    print(
        f"{'decoder':<14}{'inputs':>10}{'seconds':>9}{'branches of seeds':>19}{'reached':>9}{'peak MiB':>10} "
        " finds",
        flush=True,
    )
    return int(any([not _fuzzed(name, args.runs) for name in args.names or DECODERS]))


def _command(name: str, runs: int) -> list[str]:
    return [sys.executable, "-m", "tests.fuzz", "--inside", "--runs", str(runs), name]


def _fuzzed(name: str, runs: int) -> bool:
    """Fuzz one decoder and print a line about it; returns whether nothing was found."""
    folder = ROOT / "runs" / "fuzz" / name
    folder.mkdir(parents=True, exist_ok=True)
    began_s = time.monotonic()
    with (folder / "log").open("w") as log:
        status = subprocess.run(
            _command(name, runs),
            cwd=ROOT,
            env={**os.environ, **ONE_THREAD},
            stdout=log,
            stderr=log,
            check=False,
        ).returncode
    said = (folder / "log").read_text(errors="replace")
    covered = re.findall(r"#\d+\s+(?:INITED|DONE|NEW|REDUCE|pulse).*? cov: (\d+)", said)
    inputs, peak = (
        re.findall(rf"stat::{what}:\s+(\d+)", said) or ["?"]
        for what in ("number_of_executed_units", "peak_rss_mb")
    )
    kept = re.findall(r"Test unit written to (\S+)", said)
    told = ", ".join(kept) or ("none" if status == 0 else f"it ended with status {status}: {folder / 'log'}")
    seen = covered or ["?"]
    print(
        f"{name:<14}{inputs[-1]:>10}{time.monotonic() - began_s:>9.0f}{seen[0]:>19}{seen[-1]:>9}{peak[-1]:>10}  {told}",
        flush=True,
    )
    return status == 0


def _inside(name: str, runs: int, inputs: list[Path]) -> None:
    """Fuzz one decoder in this process, or look at given inputs; never returns."""
    import atheris

    files = [
        path
        for package in FOLLOWED
        for path in (ROOT / package).rglob("*.py")
        if re.search("import numba|@kernel", path.read_text())
    ]
    kernels = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files]
    with atheris.instrument_imports(include=list(FOLLOWED), exclude=kernels, enable_loader_override=False):
        from tests.fuzz.decoders import DECODERS
    from tests.fuzz.mutants import EDIT, edited
    from tests.fuzz.services import QUIET

    for logger in QUIET:
        logger.setLevel(logging.CRITICAL)

    seeds, check = DECODERS[name]
    draws = random.Random(1)

    def mutated(data: bytes, most: int, _seed: int) -> bytes:
        if draws.random() < 0.5:
            return bytes(atheris.Mutate(data, most))
        return edited(
            draws.choice(seeds()) if draws.random() < 0.1 else data,
            draws.randbytes(EDIT * draws.randint(1, 6)),
        )[:most]

    def timed(data: bytes) -> None:
        began_s = time.process_time()
        check(bytes(data))
        if (took_s := time.process_time() - began_s) > LONGEST_S:
            raise TimeoutError(f"it took {took_s:.0f} s of processor time")

    folder = ROOT / "runs" / "fuzz" / name
    settings = [
        f"-timeout={HUNG_S}",
        f"-rss_limit_mb={MOST_MIB}",
        f"-artifact_prefix={folder}/",
        "-print_final_stats=1",
        "-seed=1",
    ]
    corpus: list[str] = [str(path) for path in inputs]
    if not inputs:
        begun = folder / "seeds"
        begun.mkdir(parents=True, exist_ok=True)
        for number, seed in enumerate(seeds()):
            (begun / f"{number:03}").write_bytes(seed)
        corpus = [str(begun)]
        settings += [f"-runs={runs}", f"-max_len={LONGEST_INPUT}"]
    for seed in seeds():  # compiles, and fills caches
        check(seed)
    options: dict[str, Any] = {} if inputs else {"custom_mutator": mutated}
    atheris.Setup([sys.argv[0], *settings, *corpus], timed, **options)
    with contextlib.suppress(KeyboardInterrupt):
        atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
