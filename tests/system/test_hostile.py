import time
from itertools import islice
from random import Random

from teamslam.sim.scenarios.scenario import load
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests.hostile.drawing import OF_THE_RUN, mutated, payloads
from tests.system.processes import until
from tests.system.scenarios import short

MESSAGES = 500


async def test_what_no_honest_node_says_ends_no_process_and_is_no_fault(team):
    scenario = short(team.folder)
    endpoint = await team.router()
    there = ["--connect", endpoint]
    started = [
        await team.start("central", scenario, *there),
        await team.start("robot", scenario, "r1", *there),
    ]
    for process in started:
        await process.says("connected to team")
    rng = Random(11)
    unsaid = (*OF_THE_RUN, m.Fault, m.Status)  # only the last two are compared
    storm = (each for each in payloads(rng) if each[0].message not in unsaid)
    with ZenohBus(load(scenario).team, endpoint) as stranger:
        for count, (channel, name, payload) in enumerate(islice(storm, MESSAGES)):
            data = mutated(rng, payload) if count % 10 == 9 else payload
            key = channel.key(name)
            stranger.publish_raw(Sample(key, data, 0, time.time_ns(), count))
        stranger.subscribe(ch.STATUS)
        stranger.subscribe(ch.FAULT)
        after: dict[str, int] = {}
        faults: list[m.Message] = []

        def all_speak() -> bool:
            for sample in stranger.receive(0.1):
                _, name, message = opened(sample)
                if isinstance(message, m.Fault):
                    faults.append(message)
                after[name] = after.get(name, 0) + 1
            return all(after.get(name, 0) >= 3 for name in ("central", "robot/r1"))

        await until(all_speak, "every process says again how it is")
    assert faults == []
    assert [process.exit for process in started] == [None, None]
