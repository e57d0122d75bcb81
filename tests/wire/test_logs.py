import logging

from teamslam.sim.launch.watch import Watch
from teamslam.team.wire import channels as ch, logs, messages as m
from teamslam.team.wire.bus import MemoryBus, MemoryNetwork, Outgoing, Sample, open_printable
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.logs import make_printable, one_line, printable_lines
from tests import build

HOSTILE = "\x1b]0;owned\x07\x1b[2J\u202etxet\x9b31m\r\n[  1.0 s] forged line"
PRINTABLE = r"\x1b]0;owned\x07\x1b[2J\u202etxet\x9b31m\x0d\x0a[  1.0 s] forged line"


def test_a_hostile_text_is_one_printable_line():
    assert one_line(HOSTILE) == PRINTABLE
    assert one_line("σ = 0.1 m, 12 %, “a” – b…") == "σ = 0.1 m, 12 %, “a” – b…"
    assert printable_lines("one\ntwo\x1b") == "one\ntwo\\x1b"


def test_one_place_logs_so_many_lines_at_once_and_counts_the_others(request, caplog):
    now, made = [1000.0], logging.getLogRecordFactory()

    def record(*arguments: object, **named: object) -> logging.LogRecord:
        found = made(*arguments, **named)
        found.created = now[0]
        return found

    request.addfinalizer(lambda: logging.setLogRecordFactory(made))
    logging.setLogRecordFactory(record)
    for k in range(30_000):
        if k == 29_999:
            now[0] += 1.0 / logs.PER_S
        logging.getLogger("teamslam").warning("flood %d", k)
    logging.getLogger("teamslam").warning("another place")
    assert len(caplog.messages) == logs.AT_ONCE + 2
    assert "some are left out" in caplog.messages[logs.AT_ONCE - 1]
    assert "flood 29999 (29949 more like this were left out)" in caplog.messages[-2]
    assert caplog.messages[-1] == "another place"


def hostile_status() -> m.Status:
    return build.status(state=HOSTILE, figures={HOSTILE: 1.0}, warnings=(HOSTILE,) * 2)


def hostile_fault() -> m.Fault:
    texts = dict.fromkeys(("origin", "message", "error", "text", "place"), HOSTILE)
    return build.fault(count=1, **texts)


def test_who_shows_a_message_to_people_gets_printable_texts_and_the_same_message_without():
    sample = Sample(ch.STATUS.key("robot/r1"), encoded(hostile_status()), 0, 0, 0)
    _, _, message = open_printable(sample)
    assert isinstance(message, m.Status)
    texts = [message.state, *message.figures, *message.warnings]
    assert texts == [PRINTABLE] * 4
    assert make_printable(message) is message
    json = '{\n  "a": 1}'
    configured = build.configuration(incarnation=0, configuration=json)
    key = ch.ROBOT_CONFIG.key("r1")
    assert open_printable(Sample(key, encoded(configured), 0, 0, 0))[2] == configured, "data"


def test_a_launch_keeps_no_control_character_of_others_for_its_terminal():
    network = MemoryNetwork()
    robot, bus, watch = MemoryBus(network), MemoryBus(network), Watch()
    bus.subscribe(ch.STATUS)
    bus.subscribe(ch.FAULT)
    robot.publish(Outgoing(ch.STATUS, "robot/r1", hostile_status()))
    robot.publish(Outgoing(ch.FAULT, "robot/r1", hostile_fault()))
    watch.take(bus)
    status = watch.statuses["robot/r1"]
    kept = [status.state, *status.figures, *status.warnings, *watch.failures]
    assert len(kept) == 5
    assert all(text.isprintable() for text in kept)
