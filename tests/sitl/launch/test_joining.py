"""Protects the wait for services that run elsewhere: it ends, and says who was missing."""

from typing import Any

import pytest

from sitl.launch.heard import await_services
from sitl.launch.processes import MissionFailed


class EmptyBus:
    """A bus on which nobody is."""

    def services(self) -> set[str]:
        return set()

    def watch_services(self) -> None:
        """Nobody comes."""

    def receive(self, _timeout_s: float) -> Any:
        return None


def test_services_that_do_not_come_are_waited_for_no_longer_than_was_said() -> None:
    with pytest.raises(MissionFailed, match=r"no agent and estimator on uav/1 in 0\.01 s \(--wait\)"):
        await_services(EmptyBus(), "uav/1", 1, lambda _: None, 0.01)  # type: ignore[arg-type]
