"""Shell of the world node, which publishes as far as credit allows."""

import logging
import threading
import time

from teamslam.sim.publisher.node import Configurations, WorldNode, expected_nodes
from teamslam.sim.radio.bus import plan_of, reach_of
from teamslam.sim.scenarios.scenario import Scenario
from teamslam.sim.scenarios.source import tells_map
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.shell import Shell
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Bus, Outgoing
from teamslam.team.wire.digest import announce_configuration

PACE_S = 0.002  # wait [s] for the clock or credit
_LOG = logging.getLogger("teamslam")


def run_world(
    bus: Bus,
    scenario: Scenario,
    streams: WorldStreams,
    stop: threading.Event,
    *,
    speed: float,
    recorder: bool,
    cache: int | None = None,
) -> None:
    """Publish the world, then wait for the final map."""
    robots = [robot.id for robot in scenario.robots]
    announcement = announce_configuration("world", 0, 0, scenario)
    node = WorldNode(
        streams,
        expected_nodes(robots, recorder=recorder, centre=scenario.centre),
        announcement,
        speed,
        cache,
        Configurations(expected_configurations(scenario)),
        tells_map(scenario, streams),
        peers=frozenset(robots if scenario.peers else ()),
    )
    ends = (ch.FINAL_MAP, ch.CONCLUDED) if scenario.peers else (ch.FINAL_MAP,)
    shell = Shell(bus, node, "world", stop, ends)
    for channel in (*node.listens, *node.announcements):
        bus.subscribe(channel)
    bus.watch_alive()
    for robot in robots:
        shell.answer(ch.MEASUREMENTS, robot, node.measurements)
    shell.query_end()
    if shell.going:
        shell.begin()
    if scenario.peers and not scenario.radio.is_perfect:
        reach = reach_of(scenario.radio, streams.streams)
        shell.publish([Outgoing(ch.RADIO, "", plan_of(reach))])
    named: set[str] = set()
    while shell.going:
        out = node.publish(time.monotonic())
        shell.publish(out)
        shell.take(bus.receive(0.0 if out else PACE_S))
        for mismatch in node.configurations.mismatches:
            if mismatch not in named:
                named.add(mismatch)
                _LOG.warning("%s", mismatch)
        shell.query_end()
        shell.report()
    shell.report(last=True)
    shell.wait_for_recorder(lambda: node.unrecorded > 0, shell.take)
    _LOG.info("published %d measurements", int(node.status().figures["measurements"]))
    shell.end(node.final)


def expected_configurations(scenario: Scenario) -> dict[str, m.Configuration]:
    """Configurations that a scenario's nodes announce."""
    nodes = {ch.robot_node(robot.id): robot for robot in scenario.robots}
    robots = {node: announce_configuration(node, 0, 0, robot) for node, robot in nodes.items()}
    central = announce_configuration("central", 0, 0, scenario.central)
    return ({"central": central} if scenario.centre else {}) | robots
