"""A recorded plume placed in the area of a mission: its source and its wind become those of the scenario."""

import math
import os
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from plume.elementary import Array, direction
from plume.randomness import keyed
from plume.recorded.footage import PPM, Footage, blend
from plume.recorded.opening import opened
from plume.scenario import Scenario

CALM = 1e-3  # m/s: a slower wind at the source tells no direction


def recorded(
    scenario: Scenario,
    seed: int,
    *,
    file: str = "",
    fps: str = "",
    scale: float = 1.0,
    gain: float = 1.0,
    skip: float = 0.0,
    gas: str = "",
    source_x: str = "",
    source_y: str = "",
    source_z: str = "",
    wind: str = "",
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """A plume that others have recorded: a movie, or results of GADEN.

    file: a .npy or .h5 movie, a folder of Zarr, or the folder of GADEN's iteration_0, iteration_1, …
    fps: frames a second, if the file does not say, or to play it faster.  scale: metres in the area for a
    unit of length in the file.  gain: g/m³ for a unit of concentration of a movie; a factor on GADEN's g/m³.
    skip: seconds at the beginning that are not played.  gas: GADEN's gas, if the file does not say.
    source_x, source_y, source_z: where the source is, in the file's coordinates, if it does not say.
    wind: where the wind comes from in the file, degrees counter-clockwise from +x; if there is a wind in the
    file, that at the source.

    Raises ValueError on a parameter, or a file, that is not allowed.
    """
    if not file:
        raise ValueError("file is missing; wanted recorded:file=PATH")
    for name, value, allowed in (
        ("scale", scale, scale > 0),
        ("gain", gain, gain > 0),
        ("skip", skip, skip >= 0),
    ):
        if not allowed:
            raise ValueError(
                f"{name} is {value:g}; wanted a number {'from' if name == 'skip' else 'above'} 0"
            )
    footage = _found(file, gas)
    facts = footage.facts
    axes = [f"source_{axis}" for axis in "xyz"[: len(facts.cells)]]
    if source_z and "source_z" not in axes:
        raise ValueError(
            f"source_z is {source_z!r}; wanted it of GADEN's results only: a movie has no heights"
        )
    known = dict(zip(axes, facts.source or (), strict=False)) | ({"fps": facts.fps} if facts.fps else {})
    texts = {"fps": fps, "source_x": source_x, "source_y": source_y, "source_z": source_z, "wind": wind}
    known |= {name: _number(name, text) for name, text in texts.items() if text}
    missing = [name for name in ("fps", *axes) if name not in known]
    missing += ["wind"] if "wind" not in known and not facts.windy else []
    missing += ["gas"] if facts.unit == PPM and facts.grams is None else []
    if missing:
        wanted = ",".join(f"{name}=…" for name in missing)
        raise ValueError(f"{file} does not say {' and '.join(missing)}; wanted {wanted}")
    rate = known["fps"]
    if not rate > 0:
        raise ValueError(f"fps is {rate:g}; wanted a number above 0")
    skipped = math.ceil(skip * rate)
    if skipped >= facts.frames:
        raise ValueError(
            f"skip is {skip:g}; wanted less than the {facts.frames / rate:g} s that are recorded"
        )
    for name, low, high in zip(axes, facts.low, facts.high, strict=True):
        if not low <= known[name] <= high:
            raise ValueError(f"{name} is {known[name]:g}; wanted {low:g} to {high:g}, the space of {file}")
    source = np.array([known["source_x"], known["source_y"], known.get("source_z", 0.0)])
    if "wind" in known:
        cosine, sine = direction(known["wind"] / 360.0)
        towards = -float(cosine), -float(sine)
    else:
        towards = _towards(footage, source, skipped, file)
    return PlacedFootage(
        (file, gas),
        scenario,
        seed,
        source,
        towards,
        fps=rate,
        skipped=skipped,
        scale=scale,
        factor=gain * (facts.grams or 1.0),
    )


class PlacedFootage:
    """A recorded plume in the area, as the air of a mission. It is played round and round."""

    def __init__(
        self,
        named: tuple[str, str],
        scenario: Scenario,
        seed: int,
        source: Array,
        towards: tuple[float, float],
        *,
        fps: float,
        skipped: int,
        scale: float,
        factor: float,
    ) -> None:
        """Take the file and its gas; where the source is in the file (3,), and where the wind blows to there.

        That is a unit vector.
        """
        self._named, self._footage, self._source = named, _found(*named), source
        self._fps, self._skipped, self._scale, self._factor = fps, skipped, scale, factor
        self._frames = self._footage.facts.frames - skipped
        self._start = float(keyed(seed, "recorded").random()) * self._frames
        self._at = np.array([*scenario.source, scenario.height])
        self._wind = np.array(scenario.wind)
        # Turned by the angle between both winds: of unit vectors the products are its cosine and its sine.
        cosine, sine = direction(scenario.phi / math.tau)
        x, y = -float(cosine), -float(sine)
        self._cosine = towards[0] * x + towards[1] * y
        self._sine = towards[0] * y - towards[1] * x

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made of: it opens the file, or shares it."""
        return {name: value for name, value in self.__dict__.items() if name != "_footage"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become a copy. Raises ValueError if the file is gone, or broken."""
        self.__dict__ |= state
        self._footage = _found(*self._named)

    def __call__(self, places: Array, times_s: Array) -> tuple[Array, Array]:
        """Return the gas (M,) in g/m³ and the wind (M, 2) in m/s, which points to where it comes from.

        places: (M, 3) m.  times_s: (M,) s of the mission.  Raises ValueError on a broken file.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # who asks refuses what no air can say
            return self._air(places, times_s)

    def _air(self, places: Array, times_s: Array) -> tuple[Array, Array]:
        moved = (places - self._at) / self._scale
        east, north = moved[:, 0], moved[:, 1]
        there = np.empty_like(moved)
        there[:, 0] = self._source[0] + (self._cosine * east + self._sine * north)
        there[:, 1] = self._source[1] + (self._cosine * north - self._sine * east)
        there[:, 2] = self._source[2] + moved[:, 2]
        # The last frame goes over into the first.
        playing = np.mod(self._start + times_s * self._fps, self._frames)
        whole = np.floor(playing)
        share, frame = playing - whole, whole.astype(np.int64)
        frames = self._skipped + np.concatenate([frame, (frame + 1) % self._frames])
        both, count = np.concatenate([there, there]), len(places)
        gas = self._footage.gas(both, frames)
        gas = self._factor * blend(gas[:count], gas[count:], share)
        if not self._footage.facts.windy:
            return gas, np.tile(self._wind, (count, 1))
        found, known = self._footage.wind(both, frames)
        air = blend(found[:count], found[count:], share[:, None]) * self._scale
        wind = np.empty((count, 2))
        wind[:, 0] = self._sine * air[:, 1] - self._cosine * air[:, 0]
        wind[:, 1] = -self._sine * air[:, 0] - self._cosine * air[:, 1]
        return gas, np.where(known[:count, None], wind, self._wind)


def _towards(footage: Footage, source: Array, frame: int, file: str) -> tuple[float, float]:
    """Return where the file's wind blows to at the source, a unit vector. Raises ValueError."""
    air, _ = footage.wind(source[None], np.array([frame]))
    x, y = air[0].tolist()
    speed = math.sqrt(x * x + y * y)
    if not speed > CALM:
        raise ValueError(f"the wind at the source of {file} is {speed:g} m/s; wanted wind=…, degrees from +x")
    return x / speed, y / speed


def _number(name: str, text: str) -> float:
    """Return what a text says. Raises ValueError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e9:
        raise ValueError(f"{name} is {text!r}; wanted a number")
    return value


def _found(file: str, gas: str) -> Footage:
    """Return the footage of a file. Raises ValueError."""
    return _opened(Path(file), gas, *_stamp(Path(file)))


def _stamp(path: Path) -> tuple[int, int]:
    """Return what changes with a file."""
    try:
        found = os.stat(path)
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size


@lru_cache(4)
def _opened(path: Path, gas: str, _changed_ns: int, _size: int) -> Footage:
    """Open a file once for the many missions that are flown in it."""
    return opened(path, gas)
