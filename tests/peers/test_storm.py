"""Two hundred schedules of chance end with equal sets, whole, from which folds get the same."""

import pytest

from tests.peers.teams import Storm

SCHEDULES = 200
SHARE = 4


@pytest.mark.parametrize("part", range(SHARE))
def test_after_any_schedule_all_peers_have_the_whole_set(part: int) -> None:
    for seed in range(part, SCHEDULES, SHARE):
        storm = Storm(seed)
        storm.run()
        found = {storm.digest(name) for name in storm.names}
        assert len(found) == 1, f"schedule {seed}: {len(found)} sets"
        for node in storm.nodes.values():
            whole = [share.count for share in node.replica.streams.values()]
            assert whole == [4, 4, 4], f"schedule {seed}: a fold is given {whole} submaps"
        assert not any(node.refused for node in storm.nodes.values()), seed


def test_after_a_schedule_all_folds_are_handed_the_same_in_the_same_order() -> None:
    storm = Storm(7)
    storm.run()
    first, *others = [list(storm.fed(name)) for name in storm.names]
    assert len(first) == 3 * (1 + 4 + 1 + 1)
    assert all(other == first for other in others)


def test_without_questions_a_schedule_ends_with_different_sets() -> None:
    """The mutant: what is lost stays lost where nobody asks."""
    storm = Storm(7)
    storm.spread = lambda name, out: None  # type: ignore[method-assign]
    storm.run()
    assert len({storm.digest(name) for name in storm.names}) > 1
