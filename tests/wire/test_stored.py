"""What a router keeps of a team, without a network."""

from team.wire import channels as ch
from team.wire.bus import replied
from team.wire.codec import encoded
from team.wire.zenoh.stored import MOST_ORDERS, StoredMessages
from tests.support import examples


def test_orders_hold_until_the_final_map_is_out_or_the_team_has_gone() -> None:
    stored = StoredMessages()
    stored.token("robot/r1", alive=True)
    stored.token("world", alive=True)
    for order in (b"order", b"another", b"order"):
        stored.order(order)
    stored.token("robot/r1", alive=False)
    assert stored.orders() == [b"order", b"another"]
    stored.end(b"final", 1.0)
    assert stored.orders() == []
    stored.order(b"order")
    stored.token("world", alive=False)
    assert stored.orders() == []


def test_who_never_said_a_last_word_has_missed_the_end_and_is_told_so_once() -> None:
    stored = StoredMessages()
    for node in ("killed", "well", "late"):
        assert not stored.token(node, alive=True)
    stored.last_word("well")
    gone = [node for node in ("killed", "well", "late") if stored.token(node, alive=False)]
    assert gone == ["killed", "late"]
    assert stored.answer("killed", 0.0) is None
    stored.end(b"final", 10.0)
    stored.last_word("late")
    found = stored.answer("killed", 13.0)
    assert found is not None
    assert (found.missed, found.age_ns, found.final) == (True, 3 * 10**9, b"final")
    for node in ("killed", "well", "late", "stranger", ""):
        again = stored.answer(node, 13.0)
        assert again is not None
        assert not again.missed, node


def test_of_more_orders_than_anyone_gives_the_first_are_kept() -> None:
    stored = StoredMessages()
    for number in range(MOST_ORDERS + 1):
        stored.order(b"%d" % number)
    assert (len(stored.orders()), stored.orders()[0]) == (MOST_ORDERS, b"0")


def test_every_order_of_an_operator_comes_back_on_its_own_key() -> None:
    """Withdrawals, verdicts and the end of a live team, as `given_up`."""
    said = {c for c in ch.CHANNELS if c.template.startswith("operator/")}
    assert said - {ch.ORDER_SIGNATURE} == set(ch.REPLIES[ch.ORDERS_KEPT])
    for channel in ch.REPLIES[ch.ORDERS_KEPT]:
        message = next(e for e in examples() if isinstance(e, channel.message))
        found = ch.channel_of(replied(ch.ORDERS_KEPT, "", encoded(message), 0).key)
        assert found is not None
        assert found[0] is channel
