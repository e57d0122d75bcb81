"""What a router keeps of a team, without a network."""

from team.wire.zenoh.kept import Kept


def test_orders_hold_until_the_final_map_is_out_or_the_team_has_gone() -> None:
    kept = Kept()
    kept.token("robot/r1", alive=True)
    kept.token("world", alive=True)
    kept.order("robot/r2", b"order")
    kept.token("robot/r1", alive=False)
    assert kept.orders() == [b"order"]
    kept.end(b"final", 1.0)
    assert kept.orders() == []
    kept.order("robot/r2", b"order")
    kept.token("world", alive=False)
    assert kept.orders() == []


def test_who_never_said_a_last_word_has_missed_the_end_and_is_told_so_once() -> None:
    kept = Kept()
    for node in ("killed", "well", "late"):
        assert not kept.token(node, alive=True)
    kept.last_word("well")
    gone = [node for node in ("killed", "well", "late") if kept.token(node, alive=False)]
    assert gone == ["killed", "late"]
    assert kept.answer("killed", 0.0) is None
    kept.end(b"final", 10.0)
    kept.last_word("late")
    found = kept.answer("killed", 13.0)
    assert found is not None
    assert (found.missed, found.age_ns, found.final) == (True, 3 * 10**9, b"final")
    for node in ("killed", "well", "late", "stranger", ""):
        again = kept.answer(node, 13.0)
        assert again is not None
        assert not again.missed, node
