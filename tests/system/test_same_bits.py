"""Protects the one principle on every processor: with other BLAS kernels, SIMD extensions and code
generators, all bits are the same.

The environments pretend to be other processors; tests/system/arm64.sh is one. Every two settings meet in
one of them.
"""

import fcntl
import json
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

BLAS = ("Prescott", "Haswell", "Zen", "SkylakeX")
NUMPY = ("all", "without V4", "without V3 and V4")
"""What NumPy may use of the processor."""
NUMBA = ("native", "haswell", "x86-64")
NO_FMA = "glibc.cpu.hwcaps=-FMA,-AVX2,-FMA_Usable,-AVX2_Usable"
"""Lets the C library compute as on a processor without fused multiply-add."""
FAMILIES = ("homing", "infotaxis", "thompson", "ppo", "dqn", "ddpg")
SEED = "7"
ROWS = [
    (blas, numpy, NUMBA[(row + column) % 3])
    for row, blas in enumerate(BLAS)
    for column, numpy in enumerate(NUMPY)
]

FAMILIAR = ("Haswell", "without V3 and V4", "native")
"""What `make test` tries: of the processors that need no other compiled kernels the one that differs most."""
ANSWERS = ("golden", "flight/homing", "flight/ppo", "recovery", "batch", "prior")
"""What it computes there: what the services say and decide. `make test-all` computes the worlds, too."""


def disabled(numpy: str) -> str:
    """The extensions that NumPy is told not to use, by the names that it knows here."""
    extensions = np.show_config(mode="dicts")["SIMD Extensions"]  # type: ignore[call-overload, index]
    known: list[str] = extensions.get("found", [])  # there is no such entry where it found none
    newest = [name for name in known if "V4" in name or "AVX512" in name]
    return " ".join(
        {
            "all": [],
            "without V4": newest,
            "without V3 and V4": [name for name in known if "V3" in name] + newest,
        }[numpy]
    )


def environment(blas: str, numpy: str, numba: str) -> dict[str, str]:
    """The environment of a process on such a processor."""
    changed = {
        "OPENBLAS_CORETYPE": blas,
        "NPY_DISABLE_CPU_FEATURES": disabled(numpy),
        "NUMBA_CPU_NAME": numba,
    }
    if numpy == NUMPY[-1]:
        changed["GLIBC_TUNABLES"] = NO_FMA
    if numba == "native":
        del changed["NUMBA_CPU_NAME"]
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("OPENBLAS_", "NPY_", "NUMBA_CPU", "GLIBC_"))
    }
    return kept | changed


def said(env: dict[str, str], *words: str) -> list[str]:
    """The lines that a command prints in an environment."""
    ended = subprocess.run(
        [sys.executable, "-m", *words], env=env, capture_output=True, text=True, timeout=1800
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.splitlines()


def mission(env: dict[str, str], command: str, policy: str) -> dict[str, Any]:
    """What a mission prints, but for the time that it took."""
    flags = ("--seed", SEED, "--policy", policy, "--particles", "300", "--budget", "30", "--json", "--trace")
    package = "sitl" if command == "fly" else "agent"
    outcome = json.loads(
        said(env, package, command, *flags, *(("--speedup", "0", "--no-record") if command == "fly" else ()))[
            -1
        ]
    )
    return {name: value for name, value in outcome.items() if name not in ("search_time_s", "record")}


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[], list[str]]], list[str]]:
    """Return a function that gives the lines of a name, which the first process of this run to ask makes.

    The others wait meanwhile.
    """
    folder = tmp_path_factory.getbasetemp()
    shared = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder

    def lines_of(name: str, make: Callable[[], list[str]]) -> list[str]:
        with (shared / f"{name}.txt").open("a+") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            file.seek(0)
            lines = file.read().splitlines()
            if not lines:
                lines = make()
                file.write("\n".join(lines))
        return lines

    return lines_of


@pytest.mark.full
@pytest.mark.parametrize(("blas", "numpy", "numba"), ROWS)
@pytest.mark.timeout(3600)  # kernels are compiled once for each processor, the others wait
def test_every_bit_is_the_same_on_another_processor(
    once: Callable[[str, Callable[[], list[str]]], list[str]], blas: str, numpy: str, numba: str
) -> None:
    env = environment(blas, numpy, numba)
    once(f"kernels-{numba}", lambda: said(env, "tests.kernels"))  # several at once would each compile all
    there = said(env, "tests.system.bits")
    assert len(there) > 100
    assert [line for line in there if "DIFFERS" in line] == []
    assert there == once("bits", lambda: said(dict(os.environ), "tests.system.bits"))


def test_services_answer_with_the_same_bits_on_another_processor() -> None:
    there = said(environment(*FAMILIAR), "tests.system.bits", *ANSWERS)
    assert len(there) > 40
    assert [line for line in there if "DIFFERS" in line] == []
    assert there == said(dict(os.environ), "tests.system.bits", *ANSWERS)


@pytest.mark.full
@pytest.mark.parametrize(("row", "policy"), list(zip(ROWS[::2], FAMILIES, strict=True)), ids=str)
@pytest.mark.timeout(3600)
def test_a_mission_of_processes_on_one_processor_is_the_in_process_mission_of_another(
    row: tuple[str, str, str], policy: str
) -> None:
    assert mission(environment(*row), "fly", policy) == mission(dict(os.environ), "rollout", policy)


def test_the_environments_are_other_processors() -> None:
    """BLAS and NumPy's own functions do give other bits in one of them; else the tests above would show
    nothing.
    """
    code = (
        "import numpy as np; r = np.random.default_rng(0).normal(size=(2, 999)); print((r[0] @ "
        "r[1]).hex(), np.exp(r).tobytes().hex())"
    )
    outputs = {
        subprocess.run(
            [sys.executable, "-c", code], env=environment(*row), capture_output=True, text=True, check=True
        ).stdout
        for row in ROWS[:3]
    }
    assert len(outputs) > 1 or not disabled(NUMPY[-1])  # NumPy knows none that it could leave out here
