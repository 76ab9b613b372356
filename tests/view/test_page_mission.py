"""Protects the page beside real processes: a mission to its outcome, an operator's commands, a service
that dies and comes back.
"""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.view.conftest import Window

MISSION = """
seed: 7
scenario: {q: 300, d: 4.5, tau: 10}
expect: located
"""
MODEL = "plumeward.state.models['uav/1']"


@pytest.fixture
def mission(tmp_path: Path) -> Path:
    """A release with the estimator's default rate, diffusivity and lifetime."""
    (tmp_path / "mission.yaml").write_text(MISSION)
    return tmp_path / "mission.yaml"


@pytest.fixture
def viewed(start, router: str, mission: Path, wait_until: Callable) -> str:
    """The address of a page that knows the mission's truth."""
    view = start("sitl", "view", "--connect", router, "--port", "0", "--mission", str(mission))
    wait_until(lambda: view.out)
    return view.out[0].removeprefix("page at ").strip()


def verdict(service: str, is_: str) -> str:
    return (
        f"{MODEL}.scene.services.some(({{ name, verdict }}) => name === '{service}' && verdict === '{is_}')"
    )


def test_a_mission_from_the_ground_to_its_outcome_with_an_operators_commands(
    start, router: str, mission: Path, viewed: str, look: Callable[..., Window]
) -> None:
    window = look(viewed)
    window.until("plumeward.state.link === 'open'")
    assert "Waiting for a vehicle" in window.text("#empty")
    start("sitl", "uav", str(mission), "--connect", router, "--speedup", "20")
    window.until(f"{MODEL}?.scene?.craft?.armed === false && {verdict('uav', 'ok')}")
    window.drawn()

    back = window.page.get_by_role("button", name="Return")
    assert back.is_disabled()
    assert back.get_attribute("title").endswith("The vehicle is on the ground.")

    start("estimator", "--connect", router)
    start("agent", "--connect", router)
    window.until(f"{MODEL}.measurements.length >= 3")
    window.until("document.querySelector('[data-fact=mode]').textContent === 'OFFBOARD'")

    window.page.keyboard.press("h")
    window.until(f"plumeward.answers.length === 1 && {MODEL}.scene.craft.mode === 'HOLD'")
    assert "Pause accepted" in window.text(".answer")
    # At most one waypoint is reached after the command, and the belief after one reading is under way. From
    # then on time passes, and the vehicle stays and reads nothing.
    began_s, x, y, step = window.of(
        f"(({{ scene: {{ time_s, craft }}, measurements }}) => [time_s, craft.x, craft.y, "
        f"measurements.length])({MODEL})"
    )
    window.until(f"{MODEL}.scene.time_s > {began_s} + 5")
    assert window.model("measurements.length") <= step + 1
    assert window.model("scene.craft.x") == pytest.approx(x, abs=1.0)
    assert window.model("scene.craft.y") == pytest.approx(y, abs=1.0)
    window.drawn()
    assert window.page.locator("[data-fact=mode]").text_content() == "HOLD"
    assert window.text(".sentence").startswith("Paused by the operator")
    window.keep("held")
    window.page.get_by_role("button", name="Resume").click()
    window.until(f"{MODEL}.measurements.length > {step} + 1")

    window.until(f"{MODEL}.scene.ending", 120)
    window.drawn()
    assert window.model("scene.ending.verdict") == "located"
    assert window.text(".sentence").startswith("Found: 47.39")
    assert "kg/h" in window.text(".sentence")
    assert window.model("scene.threshold_m") == 0.5
    window.until(f"{MODEL}.measurements.at(-1)[5] < 0.5")  # its belief may come after the stop
    assert "source found" in window.page.locator("#aloud").text_content()
    window.page.keyboard.press("t")
    window.until(f"{MODEL}.scene.truth")
    window.drawn()
    x, y = window.model("scene.truth.sources[0]")
    assert window.count("truth", (x - 1, y - 1, x + 1, y + 1)) > 60
    window.keep("located")
    assert window.violations() == []


@pytest.mark.full
def test_a_service_that_dies_is_seen_and_seen_again_when_it_is_back(
    start, router: str, mission: Path, viewed: str, look: Callable[..., Window]
) -> None:
    window = look(viewed)
    start("sitl", "uav", str(mission), "--connect", router, "--speedup", "5", "--silence", "300")
    start("estimator", "--connect", router)
    agent = start("agent", "--connect", router)
    window.until(f"{MODEL}?.measurements.length >= 3")
    window.until(verdict("agent", "ok"), 30)
    agent.kill()
    window.until(verdict("agent", "missing"))
    window.drawn()
    assert "the agent is not there" in window.page.locator(".state").inner_text()
    window.page.locator(".more summary").click()
    assert window.page.locator(".services li[data-verdict=missing] strong").inner_text() == "agent"
    assert "agent" in window.page.locator("#aloud").text_content()
    assert window.violations() == []
    window.keep("service-missing")
    step = window.model("measurements.length")
    start("agent", "--connect", router)
    window.until(f"{verdict('agent', 'ok')} && {MODEL}.measurements.length > {step} + 1", 60)
    window.drawn()
    assert window.page.locator(".services li[data-verdict=missing]").count() == 0


@pytest.mark.full
def test_the_page_of_a_flight_stays_when_it_is_over_until_it_is_closed(
    start, mission: Path, look: Callable[..., Window], wait_until: Callable, tmp_path: Path
) -> None:
    flight = start("sitl", "fly", mission.name, "--view", "--speedup", "0", cwd=tmp_path)
    wait_until(lambda: any("page at http" in line for line in flight.err))
    (line,) = (line for line in flight.err if line.startswith("page at http"))
    window = look(line.removeprefix("page at ").strip())
    window.until("plumeward.state.link === 'over'", 60)
    window.drawn()
    assert "The last picture stays" in window.text("#notice")
    assert window.model("scene.ending.verdict") == "located"
    x, y = window.model("scene.estimate.x"), window.model("scene.estimate.y")
    assert window.count("estimate", (x - 0.5, y - 0.5, x + 0.5, y + 0.5)) > 15
    window.page.close()
    assert flight.ended() == 0
