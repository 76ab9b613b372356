"""What the environments render: each mission as a scene with its truth.

It is drawn as `plumeward draw` draws it.
"""

import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agent.learn.missions import Missions
from plume.problem import Problem
from scene.animation import FRAMES_PER_S
from scene.scene import Backdrop, Craft, Ending, Measurement, Release, Scene, judged

# The metadata of an environment about its pictures.
RENDERING: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": FRAMES_PER_S}

Pixels = NDArray[np.uint8]  # (540, 960, 3)


class Onlooker:
    """Looks at missions and draws them. It knows the truth, and changes nothing."""

    def __init__(self, assume: str) -> None:
        self._assume = assume
        self._taken: list[list[Measurement]] = []
        # One of scene/drawing.py for each mission; None until it is drawn.
        self._drawings: list[Any] = []

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made of: it draws anew."""
        return self.__dict__ | {"_drawings": [None] * len(self._drawings)}

    def look(self, missions: Missions) -> None:
        """Note the newest reading of each mission. To be called after each reset and step."""
        count = len(missions.steps)
        if len(self._taken) != count:
            self._taken, self._drawings = [[] for _ in range(count)], [None] * count
        for i, taken in enumerate(self._taken):
            if missions.steps[i] == 0:
                taken.clear()
                self._drawings[i] = None
            taken.append(missions.measurement(i))

    def frame(self, missions: Missions, i: int) -> Pixels:
        """Return the picture of mission i, (540, 960, 3).

        Raises gymnasium's DependencyNotInstalled without matplotlib.
        """
        try:
            from scene.drawing import Drawing
        except ModuleNotFoundError as error:
            raise gymnasium.error.DependencyNotInstalled(
                f"render needs {error.name}: pip install 'plumeward[view]'"
            ) from None
        scene = self.scene(missions, i)
        if self._drawings[i] is None:
            self._drawings[i] = Drawing(scene, steps=min(int(missions.budgets[i]), 30))
        return np.asarray(self._drawings[i].show(scene).pixels())

    def scene(self, missions: Missions, i: int) -> Scene:
        """Return what there is to see of mission i."""
        taken, world = self._taken[i], missions.worlds[i]
        last = taken[-1]
        release = Release.of(world.truth)
        track = np.array([it.position for it in taken], np.float32)
        return Scene(
            backdrop=Backdrop("uav/1", missions.problems[i].area, f"seed {world.seed}", release),
            time_s=last.time_s,
            craft=Craft(last.time_s, last.position, heading=_heading(track)),
            track=track,
            measurements=tuple(taken),
            scatter=missions.scatter(i),
            wind=world.wind,
            stop=missions.criteria[i].text,
            assume=self._assume,
            ending=self._ending(last, float(missions.outside[i]), release, missions.problems[i]),
        )

    def _ending(
        self, last: Measurement, outside_share: float, release: Release, problem: Problem
    ) -> Ending | None:
        if last.ceased:
            return judged(last.step, last.estimate, last.spread_m, outside_share, release, problem.area)
        return (
            Ending("not ceased", f"the budget of {last.step} steps is spent")
            if last.step >= problem.budget
            else None
        )


def _heading(track: NDArray[np.float32]) -> float:
    """Return the direction of the last move, counter-clockwise from east; NaN where there is none."""
    x, y = (track[-1] - track[-2]).tolist() if len(track) > 1 else (0.0, 0.0)
    return math.atan2(y, x) if x or y else math.nan
