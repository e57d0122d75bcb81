import json
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from teamslam.team.recording.reader import open_log
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.delivery import Attachment, pack
from tests.system.conftest import Launched
from tests.system.processes import until

Arrived = list[tuple[str, bytes, bytes]]  # (key, payload, attachment) in the order of arrival


@contextmanager
def plain_subscriber(endpoint: str) -> Iterator[Arrived]:
    config = zenoh.Config.from_json5(
        f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, '
        "scouting: {multicast: {enabled: false}}, "
        "transport: {shared_memory: {enabled: false}}}"
    )
    arrived: Arrived = []

    def take(sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        arrived.append((str(sample.key_expr), sample.payload.to_bytes(), attachment))

    with zenoh.open(config) as session:
        session.declare_subscriber("team/**", zenoh.handlers.Callback(take, indirect=False))
        yield arrived


def recorded(launched: Launched) -> Arrived:
    return [
        (
            (key := f"team/short/{sample.key}"),
            sample.payload,
            pack(key, Attachment(sample.stamp_ns, sample.wall_ns, sample.counter)),
        )
        for sample in open_log(launched.log).samples()
    ]


async def test_a_replay_arrives_byte_by_byte_in_the_order_of_the_log(launched, team):
    endpoint = await team.router()
    expected = recorded(launched)
    with plain_subscriber(endpoint) as arrived, ZenohBus("probe", endpoint) as probe:

        def heard() -> bool:
            probe.publish_raw(Sample("source/probe/sightings", b"", 0, 0, 0))
            return bool(arrived)

        await until(heard, "the subscriber hears")
        replay = await team.start("replay", launched.log, "--speed", "max", "--connect", endpoint)
        assert await replay.ended() == 0, replay.said()
        assert f"replayed {len(expected)} messages" in replay.said()

        def played() -> Arrived:
            return [one for one in arrived if not one[0].startswith("team/probe/")]

        await until(lambda: len(played()) >= len(expected), "all has arrived")
        assert played() == expected


async def test_a_replay_can_be_its_own_router_and_waits_for_who_listens(launched, team):
    replay = await team.start(
        *("replay", launched.log, "--speed", "max"), *("--listen", "tcp/127.0.0.1:0", "--wait", "8")
    )
    await replay.says("listening at tcp/")
    await replay.says("\n")
    endpoint = replay.said().partition("listening at ")[2].split()[0]  # a note may come first
    expected = recorded(launched)
    with plain_subscriber(endpoint) as arrived:
        assert await replay.ended() == 0, replay.said()
        await until(lambda: len(arrived) >= len(expected), "all has arrived")
    assert arrived == expected


async def test_a_log_that_is_cut_is_replayed_and_reported_with_a_hint_and_completed_by_repair(
    team, launched
):
    cut = team.folder / "cut.mcap"
    whole = launched.log.read_bytes()
    cut.write_bytes(whole[: len(whole) * 3 // 4])
    hint = f"{cut} is cut: `teamslam repair {cut}"
    replay = await team.start(
        *("replay", cut, "--speed", "max", "--listen", "tcp/127.0.0.1:0", "--wait", "0")
    )
    assert await replay.ended() == 0, replay.said()
    assert hint in replay.said()
    report = await team.start("report", cut, "--output", "out", "--json", "figures.json")
    assert await report.ended() == 1, report.said()
    assert f"{cut} is cut, so the report is of the part before the cut: `teamslam" in report.said()
    assert json.loads((team.folder / "figures.json").read_text())["complete"] is False
    repair = await team.start("repair", cut, "--output", "fixed.mcap")
    assert await repair.ended() == 0, repair.said()
    assert open_log(team.folder / "fixed.mcap").complete
