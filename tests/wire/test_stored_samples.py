import msgspec
import pytest

from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, read_reply
from teamslam.team.wire.codec import WireError, encoded
from teamslam.team.wire.zenoh.stored_samples import StoredMessages
from tests import build
from tests.support import example

S = 10**9
FINAL = example(m.FusedMap)
CONCLUDED = example(m.Concluded)
GIVEN_UP = build.given_up(reason="lost")


def sample(channel: ch.Channel, name: str, message: m.Message, counter: int = 7) -> Sample:
    return Sample(channel.key(name), encoded(message), 5, 6, counter)


def order(number: int) -> Sample:
    return sample(ch.GIVEN_UP, "robot/r1", msgspec.structs.replace(GIVEN_UP, reason=f"{number}"))


def of(stored, *channels, now_s=0.0, run_s=0.0, node=""):
    request = build.kept_request(
        channels=tuple(c.name for c in channels), node=node, run_ns=round(run_s * S)
    )
    return [read_reply(ch.KEPT, "", reply, 0) for reply in stored.answer(request, now_s)]


def test_orders_hold_until_the_final_map_is_out_or_the_team_has_gone():
    stored = StoredMessages()
    stored.token("robot/r1", alive=True)
    stored.token("world", alive=True)
    for number in (1, 2, 1):
        stored.take(order(number), 0.0)
    stored.token("robot/r1", alive=False)
    assert of(stored, *ch.ORDERS) == [order(1), order(2)]
    stored.take(sample(ch.FINAL_MAP, "", FINAL), 1.0)
    assert of(stored, *ch.ORDERS) == []
    stored.take(order(1), 2.0)
    stored.token("world", alive=False)
    assert of(stored, *ch.ORDERS) == []


def test_a_robots_own_end_takes_nothing_from_the_team():
    stored = StoredMessages()
    stored.token("robot/r2", alive=True)
    stored.take(order(1), 0.0)
    forged = sample(ch.TEAM_FINAL, "r1", FINAL, counter=0)
    stored.take(forged, 1.0)
    assert of(stored, *ch.ORDERS) == [order(1)]
    assert of(stored, ch.FINAL_MAP, now_s=1.0, run_s=9.0) == []
    assert of(stored, *ch.ENDS, now_s=1.0, run_s=9.0) == [forged]
    true = sample(ch.FINAL_MAP, "", msgspec.structs.replace(FINAL, dof=99))
    stored.take(true, 2.0)
    stored.take(forged, 3.0)
    assert of(stored, ch.FINAL_MAP, now_s=3.0, run_s=9.0) == [true]


@pytest.mark.parametrize(
    "wrong",
    [
        Sample(ch.FINAL_MAP.key(), b"garbage", 0, 0, 0),
        sample(ch.FINAL_MAP, "", msgspec.structs.replace(FINAL, final=False)),
        sample(ch.FINAL_MAP, "", CONCLUDED),
        sample(ch.FINAL_MAP, "", FINAL, counter=-1),
        sample(ch.CONCLUDED, "another", CONCLUDED),
    ],
    ids=["garbage", "not final", "another type", "no counter", "of another robot"],
)
def test_what_is_no_valid_end_does_not_hide_the_true_one(wrong):
    stored = StoredMessages()
    true = sample(ch.FINAL_MAP, "", FINAL), sample(ch.CONCLUDED, CONCLUDED.robot, CONCLUDED)
    for each in true:
        stored.take(each, 0.0)
    with pytest.raises(WireError):
        stored.take(wrong, 1.0)
    assert of(stored, *ch.ENDS, now_s=1.0, run_s=9.0) == [*true]


def test_who_never_announced_its_end_has_missed_the_teams_until_it_does():
    stored = StoredMessages()
    for node in ("killed", "well", "late"):
        assert not stored.token(node, alive=True)
    stored.last_word("well")
    gone = [node for node in ("killed", "well", "late") if stored.token(node, alive=False)]
    assert gone == ["killed", "late"]
    final = sample(ch.FINAL_MAP, "", FINAL)
    stored.take(final, 10.0)
    stored.last_word("late")
    for node, missed in (("killed", True), ("killed", True), ("well", False), ("late", False)):
        assert of(stored, *ch.ENDS, now_s=13.0, node=node) == [final] * missed, node
    assert of(stored, ch.FINAL_MAP, now_s=13.0, run_s=2.9) == []
    assert of(stored, ch.FINAL_MAP, now_s=13.0, run_s=3.1) == [final], "its run is older"
    stored.token("killed", alive=True)
    stored.last_word("killed")
    assert of(stored, *ch.ENDS, now_s=13.0, node="killed") == []


def test_every_order_of_an_operator_is_stored_with_its_signature():
    assert {c for c in ch.CHANNELS if c.template.startswith("operator/")} == set(ch.ORDERS)
    stored = StoredMessages()
    for channel in ch.ORDERS:
        message = example(channel.message)
        if isinstance(message, m.Withdrawal | m.TeamEnd):
            message = msgspec.structs.replace(message, by="operator")
        name = getattr(message, "robot", getattr(message, "node", ""))
        given = sample(channel, name, message)
        stored.take(given, 0.0)
        assert of(stored, channel) == [given]


def test_the_router_can_not_be_made_to_reply_with_another_channel():
    kept = build.kept(
        key="central/end", payload=encoded(build.team_end(reason="so"))
    )  # fmt: skip
    with pytest.raises(WireError, match="stores nothing on the key"):
        read_reply(ch.KEPT, "", encoded(kept), 0)
