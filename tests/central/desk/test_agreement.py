import hashlib
import json

import msgspec
import pytest

from teamslam.central.config import TeamConfig
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.evaluation.figures import to_json
from teamslam.central.desk.peers_as_centre import Agreement, PeersAsCentre
from teamslam.central.desk.view.server import Feed
from teamslam.sim.launch.watch import Watch
from teamslam.team.config import RobotConfig
from teamslam.team.recording.reader import Tail
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Sample
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import announce_configuration
from tests import build
from tests.support import example

ROBOTS = ("r1", "r2", "r3")
TRUE = example(m.FusedMap, final=True)
FORGED = msgspec.structs.replace(TRUE, dof=99)


def sample(channel: ch.Channel, name: str, message: m.Message) -> Sample:
    return Sample(channel.key(name), encoded(message), message.stamp_ns, 0, 0)


def final(robot: str, fused: m.FusedMap = TRUE) -> Sample:
    return sample(ch.TEAM_FINAL, robot, fused)


def concluded(robot: str, fused: m.FusedMap = TRUE, serial: int = 1) -> Sample:
    sha256 = hashlib.sha256(encoded(fused)).digest()
    message = build.concluded(
        robot=robot, serial=serial, digest=fused.digest, sha256=sha256, submaps=2
    )
    return sample(ch.CONCLUDED, robot, message)


def scenario(*, peers: bool) -> Sample:
    robots = tuple(RobotConfig(robot) for robot in ROBOTS)
    team = TeamConfig(name="t", team="t", robots=robots, peers=peers, centre=not peers)
    return sample(ch.WORLD_CONFIG, "", announce_configuration("world", 0, 0, team))


HONEST = [part for robot in ROBOTS for part in (final(robot), concluded(robot))]
WITHDRAWN = build.withdrawal(robot="r3", reason="broken")
GIVEN_UP = build.given_up(node="robot/r3", reason="lost")


def judged(*samples: Sample) -> Agreement:
    found = Agreement(ROBOTS)
    for each in samples:
        found.take(each)
    return found


def test_all_agree_whatever_one_has_published_before():
    found = judged(final("r1", FORGED), *HONEST)
    assert found.disagreement == ()
    assert found.agreed.payload == encoded(TRUE)


@pytest.mark.parametrize(
    ("behind", "told"),
    [
        ((final("r1", FORGED), concluded("r1", FORGED, 2)), "r1 has another final map"),
        ((final("r1", FORGED),), "r1 has published another final map"),
    ],
)
def test_who_differs_is_named_and_there_is_no_hash_of_the_teams_map(behind, told):
    evaluation = evaluate([scenario(peers=True), *HONEST, *behind])
    (why,) = evaluation.disagreement
    assert told in why
    assert why in evaluation.notes
    figures = to_json(evaluation)
    assert (figures["final_map_sha256"], figures["peers_that_differ"]) == (None, [why])
    assert evaluation.map.payload_sha256 == hashlib.sha256(encoded(TRUE)).hexdigest()


def test_who_has_no_final_map_is_named_unless_an_operator_has_given_it_up():
    two = HONEST[:4]
    (why,) = judged(*two).disagreement
    assert "r3 has announced no final map" in why
    for channel, name, order in ((ch.GIVEN_UP, "robot/r3", GIVEN_UP), (ch.ORDER, "r3", WITHDRAWN)):
        found = judged(*two, sample(channel, name, order))
        assert found.disagreement == ()
        assert found.agreed is not None


def test_a_map_that_calls_the_others_lost_excuses_nobody():
    alone = msgspec.structs.replace(FORGED, lost=("r2", "r3"))
    assert judged(final("r1", alone), concluded("r1", alone)).agreed is None


def test_a_robots_own_map_is_nothing_in_a_team_with_a_centre():
    attack = [final("r1", FORGED), concluded("r1", FORGED)]
    evaluation = evaluate([scenario(peers=False), *attack])
    assert evaluation.map is None
    assert evaluation.disagreement == ()
    centre = sample(ch.FINAL_MAP, "", TRUE)
    evaluation = evaluate([scenario(peers=False), *attack, centre, *attack])
    assert evaluation.map is not None
    assert to_json(evaluation)["final_map_sha256"] == hashlib.sha256(encoded(TRUE)).hexdigest()


def test_a_viewer_is_given_the_final_map_once_and_when_all_have_it():
    centre = PeersAsCentre(ROBOTS)
    given = [centre.of(each) for each in (final("r1", FORGED), *HONEST)]
    (found,) = [each for each in given if each is not None]
    assert given.index(found) == len(given) - 2, (
        "the last robot's map; its conclusion is nothing new"
    )
    assert (found.key, found.payload) == (ch.FINAL_MAP.key(), encoded(TRUE))


def test_the_page_shows_the_map_on_which_the_peers_agree(tmp_path):
    running = msgspec.structs.replace(TRUE, final=False)
    with Recorder(tmp_path / "log.mcap", "t", {}) as recorder:
        recorder.write([scenario(peers=True), sample(ch.TEAM_MAP, "r1", running), *HONEST])
    feed = Feed(Tail(tmp_path / "log.mcap"))
    while not feed.ended:
        feed.read_more(growing=False)
    told = [json.loads(frame) for frame in feed.frames]
    assert [each["final"] for each in told if each["k"] == "map"] == [False, True]
    sent = sum(messages for each in told if each["k"] == "bytes" for _, _, messages, _ in each["v"])
    assert sent == 2 + len(HONEST), "what the page derives is no traffic"


def test_a_launch_is_over_when_every_peer_has_a_final_map_of_its_own():
    network = MemoryNetwork()
    robot, own = MemoryBus(network), MemoryBus(network)
    watch = Watch(peers=frozenset(ROBOTS), centre=PeersAsCentre(ROBOTS))
    for channel in (ch.TEAM_FINAL, ch.CONCLUDED):
        own.subscribe(channel)
    for each in (final("r1", FORGED), concluded("r1", FORGED), *HONEST[2:]):
        assert not watch.is_over
        robot.publish_raw(each)
        watch.take(own)
    assert watch.is_over
    assert watch.fused is None, "they do not agree"
    robot.publish_raw(concluded("r1", serial=2))
    watch.take(own)
    assert watch.fused == TRUE
