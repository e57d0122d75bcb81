"""What a router keeps of a team, without a network."""

from team.wire import channels as ch
from team.wire.bus import replied
from team.wire.codec import encoded
from team.wire.zenoh.kept import MOST_ORDERS, Kept
from tests.support import examples


def test_orders_hold_until_the_final_map_is_out_or_the_team_has_gone() -> None:
    kept = Kept()
    kept.token("robot/r1", alive=True)
    kept.token("world", alive=True)
    for order in (b"order", b"another", b"order"):
        kept.order(order)
    kept.token("robot/r1", alive=False)
    assert kept.orders() == [b"order", b"another"]
    kept.end(b"final", 1.0)
    assert kept.orders() == []
    kept.order(b"order")
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


def test_of_more_orders_than_anyone_gives_the_first_are_kept() -> None:
    kept = Kept()
    for number in range(MOST_ORDERS + 1):
        kept.order(b"%d" % number)
    assert (len(kept.orders()), kept.orders()[0]) == (MOST_ORDERS, b"0")


def test_every_order_of_an_operator_comes_back_on_its_own_key() -> None:
    """Withdrawals, verdicts and the end of a live team, as `given_up`."""
    said = {c for c in ch.CHANNELS if c.template.startswith("operator/")}
    assert said - {ch.ORDER_SIGNATURE} == set(ch.REPLIES[ch.ORDERS_KEPT])
    for channel in ch.REPLIES[ch.ORDERS_KEPT]:
        message = next(e for e in examples() if isinstance(e, channel.message))
        found = ch.channel_of(replied(ch.ORDERS_KEPT, "", encoded(message), 0).key)
        assert found is not None
        assert found[0] is channel
