"""Vehicles that keep apart: the moves that are free for one of a fleet, and where the others go."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from agent.planning.moves import Reach, T
from plume.elementary import Array
from plume.scenario import SEPARATION_M

NOWHERE: Array = np.empty((0, 2))
IMAGINING = 4  # vehicles that imagine as much as one alone
OF_REACH = tuple(each.name for each in fields(Reach))


@dataclass(frozen=True)
class Shared(Reach):
    """The moves of one vehicle of a fleet.

    A way is the straight line from a place to the next one. Ways keep their distance as lines, whenever each
    vehicle flies its own: a late vehicle is as safe as one on time. The ways of vehicles that have not chosen
    yet end where they begin, so everyone can always stay where it is. Those that have left may hover: who is
    near them goes away. Nobody comes near to another's stand: that one may come back, and who has to land
    where it is has not landed there.
    """

    chosen: Array = field(
        default_factory=lambda: np.empty((0, 2, 2)), compare=False
    )  # (F, 2, 2): from, to, m
    waiting: Array = field(default_factory=lambda: np.empty((0, 2)), compare=False)  # (W, 2) m, yet to choose
    separation_m: float = SEPARATION_M
    hovering: Array = field(default_factory=lambda: np.empty((0, 2)), compare=False)  # (H, 2) m, near these
    clear_m: float = 0.0  # least distance of ways from those, unless they begin nearer and lead away
    stands: Array = field(default_factory=lambda: np.empty((0, 2)), compare=False)  # (S, 2) m, of the others
    common: dict[str, Any] = field(default_factory=dict, compare=False)  # what `once` has computed, by name
    # Metres by which a way that begins too near leads away for each metre of it: no more than 45° aside.
    away: float = 0.7
    # A fleet saves rounds, not metres: with shorter moves it would need more of them (docs/fleet.md).
    FINE: ClassVar[float] = 1 / 30

    @classmethod
    def of(
        cls,
        reach: Reach,
        chosen: Array,
        waiting: Array,
        separation_m: float,
        hovering: Array = NOWHERE,
        stands: Array = NOWHERE,
        common: dict[str, Any] | None = None,
    ) -> "Shared":
        """Return `reach` for a vehicle whose turn it is.

        hovering: (H, 2) m where those have read that have left: each is at most a step from there.  stands:
        (S, 2) m, where the others come back to.  common: what vehicles before it have computed `once`.
        """
        given = {name: getattr(reach, name) for name in OF_REACH}
        clear_m = separation_m + reach.step
        return cls(
            **given,
            chosen=chosen,
            waiting=waiting,
            separation_m=separation_m,
            hovering=hovering,
            clear_m=clear_m,
            stands=stands,
            common={} if common is None else common,
        )

    def moves(self, position: tuple[float, float]) -> Array:
        """Return the waypoints (A, 2) m that one step reaches by free ways; if none, the place itself."""
        places = super().moves(position)
        free = places[self.are_free(position, places)]
        return free if len(free) else np.array([position], np.float64)

    def are_free(self, position: tuple[float, float], places: Array) -> NDArray[np.bool_]:
        """Whether the ways from a position to places (A, 2) m are free and keep the separation: (A,)."""
        from agent.planning.kernels import are_apart  # compiled: naming a policy does not need it

        here = np.array(position, np.float64)
        apart = are_apart(here, np.ascontiguousarray(places), *self._others)
        return np.asarray(super().are_free(position, places) & apart)

    @cached_property
    def _others(self) -> tuple[Array, Array, Array]:
        """The ways of the others (F, 2, 2) m, and of each way what `are_apart` wants to know (F,).

        Who is yet to choose may stay. Only near those that hover, and near stands, ways may begin.
        """
        places = np.concatenate([self.waiting, self.hovering, self.stands])
        ways = np.concatenate([self.chosen, np.repeat(places[:, None], 2, axis=1)])
        flying, hover = len(self.chosen) + len(self.waiting), len(self.hovering)
        clear_m, away = np.full(len(ways), self.separation_m), np.full(len(ways), self.away)
        clear_m[flying : flying + hover] = self.clear_m
        away[:flying] = np.inf
        return ways, clear_m, away

    def fewer(self, number: int) -> int:
        """Return how many of a number of draws each vehicle has: more than IMAGINING share those of so many.

        A round of eight is planned sooner, and its search is about as short (docs/fleet.md).
        """
        return math.ceil(number * min(1.0, IMAGINING / (1 + len(self.chosen) + len(self.waiting))))

    def once(self, name: str, compute: Callable[[], T]) -> T:
        """Return what a planner computes from the belief alone; the next vehicles have it from the first."""
        if name not in self.common:
            self.common[name] = compute()
        found: T = self.common[name]
        return found

    def foreseen(self, steps: float = 1.0) -> Array:
        """Return where those who have chosen will be so many steps on, if they go straight on: (F, 2) m."""
        start, end = self.chosen[:, 0], self.chosen[:, 1]
        return self.area.clipped(start + steps * (end - start))
