"""With keys a stranger or a captured robot publishes nothing in the names of others.

Each attack is made at a router with keys, where nothing arrives, and at an open one, where it
does.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from shutil import copytree

import msgspec
import pytest

from teamslam.team.end_query import EndQuery
from teamslam.team.keys.authority import make_keys
from teamslam.team.keys.credentials import credentials_of
from teamslam.team.keys.roster import load_roster, nodes_of
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import BusError, Outgoing, Sample, opened, read_reply
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh import session
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.keys.certificates import TEAM, Folders
from tests.support import example, examples, odometry, submap, wait_until

HUGE = 2**62
COUNTS = {"measurements": HUGE, "submaps": HUGE}
OF_RECORDER = build.progress(node="recorder", **COUNTS)
FINAL = example(m.FusedMap)
CONCLUDED = example(m.Concluded, robot="r1")
ATTACKS = {
    "ends the run": (ch.END, "", build.end()),
    "forges the final map": (ch.FINAL_MAP, "", FINAL),
    "begins one that nobody reaches": (ch.START, "r1", build.initial_pose(incarnation=HUGE)),
    "says that another is done": (ch.ROBOT_DONE, "r1", build.done(incarnation=HUGE)),
    "frees another's credit": (ch.ROBOT_PROGRESS, "r1", build.progress(**COUNTS)),
    "orders a withdrawal": (ch.ORDER, "r1", build.withdrawal()),
    "tells that the centre withdrew": (ch.WITHDRAWAL, "r1", build.withdrawal(by="central")),
    "lets another repeat it": (ch.WITHDRAWALS_HEARD, "r1", build.withdrawal_heard(withdrawn="r1")),
    "brings a robot of its own": (ch.SUBMAP, "r9", submap(0, "r9")),
    "replaces a measurement": (ch.ODOMETRY, "r1", odometry(0, "r1")),
    "replaces a teammate's submap": (ch.SUBMAP, "r1", submap(0, "r1")),
    "takes the recorder's place": (ch.RECORDER_PROGRESS, "r1", OF_RECORDER),
    "gives the truth": (ch.TRUTH, "r1", example(m.Truth)),
}
"""Messages of r2 in the names of others."""


def on_every_row() -> Iterator[Outgoing]:
    said = {type(each): each for each in examples()}
    names = {"robot": "r1", "node": "robot/r1"}
    for channel in ch.CHANNELS:
        if channel not in (*ch.UNOPENED, ch.ALIVE):
            name = next((n for place, n in names.items() if f"{{{place}}}" in channel.template), "")
            yield Outgoing(channel, name, said[channel.message])


OWN = Outgoing(ch.ROBOT_PROGRESS, "r2", build.progress(robot="r2"))


@contextmanager
def door(keys: Folders | None) -> Iterator[Callable[[str], ZenohBus]]:
    opened: list[ZenohBus] = []
    folder = None if keys is None else keys.own
    own = folder and (credentials_of(folder, "router"), load_roster(folder))
    with router("tls/127.0.0.1:0" if folder else "tcp/127.0.0.1:0", own or None) as endpoint:

        def enter(node: str) -> ZenohBus:
            shown = credentials_of(folder, node, TEAM) if folder else None
            opened.append(ZenohBus(TEAM, endpoint, keys=shown))
            return opened[-1]

        try:
            yield enter
        finally:
            for bus in opened:
                bus.close()


def arriving(bus: ZenohBus, last: str) -> list[str]:
    found: list[str] = []

    def look() -> bool:
        found.extend(sample.key for sample in bus.receive(0.05))
        return last in found

    wait_until(look, what=last)
    return [key for key in found if key != last]


@pytest.mark.parametrize("locked", [True, False], ids=["keys", "open"])
def test_a_robot_that_was_taken_over_says_nothing_for_others(keys, *, locked):
    with door(keys if locked else None) as enter:
        victim, robot = enter("recorder"), enter("robot-r2")
        said = [*(Outgoing(*attack) for attack in ATTACKS.values()), *on_every_row()]
        for out in said:
            victim.subscribe(out.channel)
        probe = Outgoing(ch.STATUS, "robot/r2", build.status(node="robot/r2"))

        def there() -> bool:
            robot.publish(probe)
            return bool(victim.receive(0.02))

        wait_until(there, what="the link")
        for out in said:
            robot.publish(out)
        robot.publish(OWN)
        heard = set(arriving(victim, OWN.key)) - {probe.key}
        assert heard == (set() if locked else {out.key for out in said})


ENDS = {
    "ends the team in the centre's name": (ch.FINAL_MAP, "", FINAL),
    "ends the team as r1": (ch.TEAM_FINAL, "r1", FINAL),
    "concludes as r1": (ch.CONCLUDED, "r1", CONCLUDED),
    "gives r1 up": (ch.GIVEN_UP, "robot/r1", build.given_up(reason="so")),
    "orders the end": (ch.END_ORDER, "", build.team_end(reason="so")),
}
"""Messages that the router would store, if r2 could publish them."""
OWN_END = Outgoing(ch.TEAM_FINAL, "r2", FINAL)


@pytest.mark.parametrize("locked", [True, False], ids=["keys", "open"])
def test_the_router_stores_a_robots_own_end_as_its_own_and_serves_it_as_nobody_elses(
    keys, *, locked
):
    true = msgspec.structs.replace(FINAL, dof=99)
    order = Outgoing(ch.ORDER, "r2", build.withdrawal(robot="r2", reason=""))
    with door(keys if locked else None) as enter:
        robot, victim, centre = enter("robot-r2"), enter("robot-r1"), enter("central")
        operator = enter("operator")
        centre.declare_alive("central")

        def stored() -> list[str]:
            names = tuple(channel.name for channel in ch.REPLIES[ch.KEPT])
            request = build.kept_request(channels=names, run_ns=3600 * 10**9)
            replies = victim.ask(ch.KEPT, "", request, 5.0)
            return [read_reply(ch.KEPT, "", each, 0).key for each in replies]

        def ends(bus: ZenohBus, *channels: ch.Channel) -> list[Sample]:
            end = EndQuery(bus, "robot/r1", channels or (ch.FINAL_MAP,))
            end._before_s = 3600.0
            return end.find_missed()

        operator.publish(order)
        wait_until(lambda: order.key in stored(), what="the order")
        for out in (*(Outgoing(*attack) for attack in ENDS.values()), OWN_END):
            robot.publish(out)
        wait_until(lambda: OWN_END.key in stored(), what="its own end")
        forged = {Outgoing(*attack).key for attack in ENDS.values()}
        assert {*stored()} == ({order.key} if locked else forged) | {OWN_END.key}
        if not locked:
            return
        assert ends(victim) == ends(centre) == [], "no team with a centre has ended"
        assert [each.key for each in ends(victim, *ch.ENDS)] == [OWN_END.key], "its author remains"
        centre.publish(Outgoing(ch.FINAL_MAP, "", true))
        wait_until(lambda: bool(ends(victim)), what="the true end")
        robot.publish_raw(Sample(OWN_END.key, b"garbage", 0, 0, 1))
        robot.publish(OWN_END)
        wait_until(lambda: len(ends(victim, *ch.ENDS)) == 2, what="both ends")
        (found,) = ends(victim)
        assert (found.key, opened(found)[2]) == (ch.FINAL_MAP.key(), true)


def answers(asker: ZenohBus, channel: ch.Channel, name: str, request: m.Message) -> list[bytes]:
    with suppress(BusError):
        return asker.ask(channel, name, request, 2.0)
    return []


@pytest.mark.parametrize("locked", [True, False], ids=["keys", "open"])
def test_a_robot_that_was_taken_over_answers_no_query_of_another(keys, *, locked):
    forged = [encoded(odometry(5, "r1"))]
    end = build.kept(key="central/final", payload=encoded(FINAL))
    wanted = build.measurements_request()
    with door(keys if locked else None) as enter:
        robot, attacker = enter("robot-r1"), enter("robot-r2")
        attacker.answer(ch.MEASUREMENTS, "r1", lambda _: forged)
        attacker.answer(ch.SUBMAPS, "", lambda _: forged)
        attacker.answer(ch.KEPT, "", lambda _: [encoded(end)])
        attacker.declare_alive("robot/r1")
        attacker.declare_alive("robot/r2")
        wait_until(lambda: robot.is_alive("robot/r2"), what="the attacker")
        assert robot.is_alive("robot/r1") != locked
        over = threading.Event()
        serving = threading.Thread(
            target=lambda: [attacker.receive(0.02) for _ in iter(over.is_set, True)]
        )
        serving.start()
        try:
            found = answers(robot, ch.MEASUREMENTS, "r1", wanted)
            found += answers(robot, ch.SUBMAPS, "", build.submaps_request())
            ended = EndQuery(robot).find_missed()
        finally:
            over.set()
            serving.join()
        assert found == ([] if locked else forged * 2)
        assert [each.key for each in ended] == ([] if locked else [ch.FINAL_MAP.key()])


def test_a_team_works_with_keys_late_joiners_caches_tokens_and_queries(keys):
    with door(keys) as enter:
        robot, source = enter("robot-r1"), enter("source-r1")
        for k in range(5):
            robot.publish(Outgoing(ch.SUBMAP, "r1", submap(k, "r1")))
        robot.declare_alive("robot/r1")
        centre = enter("central")
        centre.watch_alive()
        centre.subscribe(ch.SUBMAP)
        found: list[Sample] = []

        def look() -> int:
            found.extend(centre.receive(0.05))
            return len(found)

        wait_until(lambda: look() == 6, what="history and a token")
        assert {sample.key for sample in found} == {"robot/r1/submap", "robot/r1/alive"}
        robot.publish(Outgoing(ch.SUBMAP, "r1", submap(5, "r1")))
        wait_until(lambda: look() == 7, what="a live one")
        robot.subscribe(ch.ODOMETRY, "r1")

        def driven() -> bool:
            source.publish(Outgoing(ch.ODOMETRY, "r1", odometry(0, "r1")))
            return bool(robot.receive(0.05))

        wait_until(driven, what="a measurement")


def test_no_estimator_hears_the_truth(keys):
    truth = Outgoing(ch.TRUTH, "r1", example(m.Truth))
    with door(keys) as enter:
        world, robot, recorder = enter("world"), enter("robot-r1"), enter("recorder")
        for bus in (robot, recorder):
            bus.subscribe(ch.TRUTH)
            bus.subscribe(ch.END)
        world.publish(truth)
        wait_until(lambda: recorder.receive(0.05), what="the truth at the recorder")
        world.publish(Outgoing(ch.END, "", build.end()))
        assert arriving(robot, "world/end") == []


def test_a_token_with_an_endless_name_is_nobodys(keys):
    with door(keys) as enter:
        robot, centre = enter("robot-r2"), enter("central")
        centre.watch_alive()
        robot.declare_alive("robot/r2/" + "x" * 25_000)
        robot.declare_alive("robot/r2")
        found: list[Sample] = []
        wait_until(lambda: found.extend(centre.receive(0.05)) or found, what="its own token")
        assert [sample.key for sample in found] == ["robot/r2/alive"]


def refusal(endpoint: str, node: Path | None, **changed: object) -> tuple[str, float]:
    began = time.monotonic()
    shown = node and replace(credentials_of(node, "robot-r1"), **changed)
    with pytest.raises(BusError) as caught:
        ZenohBus(TEAM, endpoint, 4.0, shown or None)
    return str(caught.value), time.monotonic() - began


def test_each_side_names_a_certificate_that_it_refuses(keys, monkeypatch, capfd):
    monkeypatch.setattr(session, "FIRST_LOOK_S", 0.3)
    own = credentials_of(keys.own, "router"), load_roster(keys.own)
    with router("tls/127.0.0.1:0", own) as endpoint:
        told, took = refusal(endpoint, keys.strange)
        assert "the router's certificate is invalid" in told
        assert took < 30.0
        told, _ = refusal(endpoint, keys.strange, authority=keys.own / "ca.pem")
        assert "the router refuses" in told
        assert "of another authority" in told
        told, _ = refusal(endpoint, None)
        assert "give --keys DIR" in told
        pair = {"certificate": keys.ended / "robot-r1.pem", "key": keys.ended / "robot-r1.key"}
        told, _ = refusal(endpoint, keys.own, **pair)
        assert "it has expired by the router's clock" in told
        said = ""

        def logged(*reasons: str) -> bool:
            nonlocal said
            said += "".join(capfd.readouterr())
            return all(reason in said for reason in reasons)

        reasons = "UnknownCA", "BadSignature", "sent no certificates", "certificate expired"
        wait_until(lambda: logged(*reasons), what="the router's own words")
    told, _ = refusal(endpoint, keys.own)
    assert f"no router answers at {endpoint} (4 s)" in told
    with router() as plain:
        told, _ = refusal(plain.replace("tcp/", "tls/"), keys.own)
        assert "no router answers" in told


def shut_out(bus: ZenohBus) -> tuple[str, float]:
    """Error of a connected node that the router no longer accepts, and the time [s] until it."""
    began = time.monotonic()
    while time.monotonic() - began < 60.0:
        try:
            bus.receive(0.05)
        except BusError as error:
            return str(error), time.monotonic() - began
    return "nothing", time.monotonic() - began


def test_a_router_whose_certificate_ends_is_named_by_who_is_in(tmp_path, monkeypatch):
    monkeypatch.setattr(session, "FIRST_LOOK_S", 0.3)
    make_keys(tmp_path, TEAM, nodes_of(["r1"]))
    told, took = "", 0.0
    for life_s in (4.0, 12.0, 36.0):  # a busy machine may need more time to connect
        ended = datetime.now(UTC) - timedelta(days=1) + timedelta(seconds=life_s)
        make_keys(tmp_path, TEAM, [], renew=["router"], days=1.0, now=ended)
        own = credentials_of(tmp_path, "router"), load_roster(tmp_path)
        with router("tls/127.0.0.1:0", own) as endpoint:
            try:
                bus = ZenohBus(TEAM, endpoint, 20.0, credentials_of(tmp_path, "robot-r1", TEAM))
            except BusError:
                continue
            with bus:
                told, took = shut_out(bus)
            break
    assert "the router's certificate is invalid: certificate has expired" in told
    assert took < life_s + 20.0


def test_who_is_revoked_while_it_runs_learns_of_it_when_the_router_is_back(tmp_path, monkeypatch):
    monkeypatch.setattr(session, "LINK_S", 0.3)
    home, carried = tmp_path / "home", tmp_path / "carried"
    make_keys(home, TEAM, nodes_of(["r1", "r2"]))
    copytree(home, carried)
    own = credentials_of(carried, "router"), load_roster(carried)
    with router("tls/127.0.0.1:0", own) as endpoint:
        gone, kept = (
            ZenohBus(TEAM, endpoint, 20.0, credentials_of(carried, f"robot-{name}", TEAM))
            for name in ("r1", "r2")
        )
        for _ in range(20):
            assert gone.receive(0.05) == kept.receive(0.05) == []
    assert make_keys(home, TEAM, [], revoke=["robot-r1"]).revoked == ("robot-r1",)
    with router(endpoint, (credentials_of(carried, "router"), load_roster(home))):
        told, took = shut_out(gone)
        assert "does not accept" in told
        assert took < 30.0
        until = time.monotonic() + 3.0
        while time.monotonic() < until:
            kept.receive(0.05)
        for bus in (gone, kept):
            bus.close()
