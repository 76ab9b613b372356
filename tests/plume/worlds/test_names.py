"""Protects the names of worlds: what they combine, and what is said of those that are none."""

import pytest

from plume.scenario import draw
from plume.worlds.air import Steady
from plume.worlds.errors import Errors
from plume.worlds.names import check, named, separate, worlds
from plume.worlds.puffs import Puffs
from plume.worlds.world import World


def test_a_name_is_a_gas_with_parameters_and_wrong_assumptions_in_any_order() -> None:
    for name in ("puffs:share=0.3,rate=5+wind-30", "wind-30+puffs:rate=5,share=0.3"):
        world = named(name)
        assert world.parameters == {"share": 0.3, "rate": 5.0}
        assert abs(world.errors(4).direction_deg) == 30.0
        assert isinstance(world.air(draw(4), 4), Puffs)
    assert isinstance(named("as-modelled").air(draw(4), 4), Steady)
    assert named("as-modelled").errors(4) == Errors()


def test_directions_add_and_factors_multiply() -> None:
    both = named("wind-10+wind-30+rate-halved+rate-halved+gain-doubled").errors(3)
    assert abs(both.direction_deg) == 40.0
    assert (both.q, both.gain, both.tau) == (0.25, 2.0, 1.0)
    told, world = draw(3), World(draw(3), 3, name="d-doubled+tau-halved")
    assert (world.truth.d, world.truth.tau) == (2 * told.d, told.tau / 2)


def test_a_list_of_worlds_keeps_the_commas_of_parameters() -> None:
    assert separate("cv-1,puffs:share=0.1,rate=5,wind-10+puffs:size=1,gusts=0.1,stuck") == [
        "cv-1",
        "puffs:share=0.1,rate=5",
        "wind-10+puffs:size=1,gusts=0.1",
        "stuck",
    ]
    assert separate("a,b") == ["a", "b"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("breeze", "no world 'breeze'; wanted as-modelled, puffs, walls, recorded, wind-10, "),
        ("", "no world ''; wanted as-modelled, "),
        ("wind-3", "no world 'wind-3'; did you mean 'wind-30'? Wanted as-modelled, "),
        ("wind-30+pufs:share=0.1", "no world 'pufs'; did you mean 'puffs'? Wanted as-modelled, "),
        (
            "wind-30+puffs:share=2",
            "world 'wind-30+puffs:share=2' is not allowed: share is 2; wanted a number from 0 to 1",
        ),
        ("puffs+", "no world ''; wanted as-modelled, "),
        ("puffs:share=0.2+wind-3", "no world 'wind-3'; did you mean 'wind-30'? Wanted as-modelled, "),
        ("puffs+puffs", "world 'puffs+puffs' is not allowed: puffs and puffs are both a gas; wanted one"),
        ("puffs:shape=1", "'shape=1' of world 'puffs' is not allowed; wanted some of puffs:share=…,rate=…"),
        ("puffs:share", "'share' of world 'puffs' is not allowed; wanted some of puffs:share=…,rate=…"),
        ("puffs:rate=1,rate=2", "'rate=2' of world 'puffs' is not allowed; wanted some of "),
        ("puffs:share=much", "share of world 'puffs' is 'much'; wanted a number"),
        ("puffs:share=nan", "share of world 'puffs' is 'nan'; wanted a number"),
        (
            "puffs:share=2",
            "world 'puffs:share=2' is not allowed: share is 2; wanted a number from 0 to 1",
        ),
        ("wind-30:side=1", "world 'wind-30:side=1' is not allowed; wind-30 has no parameters"),
        ("cv-1+cv-2", "world 'cv-1+cv-2' is not allowed: cv-1 and cv-2 say more than once what the inter"),
        ("x" * 501, "a world of 501 characters is not allowed; wanted 500 at most"),
    ],
)
def test_a_name_that_is_none_is_told_in_one_line(name: str, reason: str) -> None:
    with pytest.raises(ValueError, match=r"\A.+\Z") as refused:
        check(name)
    assert str(refused.value).startswith(reason)


def test_the_list_shows_each_gas_with_its_parameters() -> None:
    assert worlds()["puffs"].endswith("; share=0.2, rate=10, size=0.1, meander=0, gusts=0, wander=20")
