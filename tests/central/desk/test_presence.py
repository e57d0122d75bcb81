"""Advice of `teamslam status` on clocks that differ."""

import pytest

from teamslam.central.desk.presence import Presence
from teamslam.team.wire import messages as m
from tests import build

S = 10**9
NOW_S = 1_763_800_000


def presence(*behind: tuple[float, float]) -> Presence:
    """A team's drivers, so many seconds behind the wall clock at two moments that are 2 s apart."""
    found = Presence()
    for node in ("central", "robot/r1", "robot/r2", "robot/r3"):
        found._take_message(m.Liveliness(stamp_ns=0, node=node, alive=True), 0)
    for k, each in enumerate(behind, 1):
        node = f"source/r{k}"
        found._take_message(m.Liveliness(stamp_ns=0, node=node, alive=True), 0)
        for wall_s, late_s in zip((NOW_S, NOW_S + 2), each, strict=True):
            stamp_ns = round((wall_s - late_s) * S)
            status = build.status(stamp_ns=stamp_ns, node=node, state="measuring", warnings=())
            found._take_message(status, wall_s * S)
    return found


IN_TIME, YEARS = (0.0, 0.0), (5e8, 5e8)


@pytest.mark.parametrize(
    ("clocks", "words"),
    [
        ((IN_TIME, IN_TIME, (7.0, 7.0)), "stamps 7.0 s behind the others: set its machine's clock"),
        (
            (IN_TIME, IN_TIME, (-7.0, -7.0)),
            "stamps 7.0 s ahead of the others: set its machine's clock",
        ),
        ((IN_TIME, IN_TIME, (9.0, 7.0)), "it lags and catches up: its program delivers old"),
        ((IN_TIME, IN_TIME, (6.0, 7.0)), "it lags and falls further behind"),
        ((YEARS, YEARS, (5e8 + 20, 5e8 + 20)), "began later or go slower: the map waits for them"),
        ((IN_TIME, IN_TIME, YEARS), "recorded data, which began later or go slower: the map"),
        ((YEARS, YEARS, (5e8 - 20, 5e8 - 20)), "of which the others began later or go slower"),
    ],
)
def test_who_lags_or_replays_is_not_told_to_set_its_clock(
    clocks: tuple[tuple[float, float], ...], words: str
) -> None:
    (advice,) = presence(*clocks).advice()
    assert advice.startswith("source/r3 stamps ")
    assert words in advice
    assert ("set its machine's clock" in advice) == ("set its machine's clock" in words)


def test_robots_of_one_clock_are_advised_nothing() -> None:
    assert presence(IN_TIME, IN_TIME, (0.4, 0.4)).advice() == []
