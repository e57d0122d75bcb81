"""Recompute a robot of a log under a feedback rule."""

from collections.abc import Iterator

from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.desk.verification.robot import NewRobot
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import Outgoing


def in_lockstep(log: Recorded, robot: str, new: NewRobot) -> Iterator[Outgoing]:
    """Recompute messages, waiting for recorded maps."""
    fused = {f.exchange: f for f in log.of(ch.FUSED_MAP) if isinstance(f, m.FusedMap)}
    node = new()
    incarnations = log.incarnations(robot)
    inputs: list[m.Message] = [
        log.measurements[(robot, incarnation)][counter]
        for incarnation in incarnations
        for counter in sorted(log.measurements[(robot, incarnation)])
    ]
    if any(isinstance(d, m.Done) and d.robot == robot for d in log.of(ch.ROBOT_DONE)):
        end = m.StreamEnd(
            robot=robot,
            incarnation=incarnations[-1],
            measurements=len(log.measurements[(robot, incarnations[-1])]),
        )
        inputs.append(m.End(stamp_ns=0, streams=(end,)))
    inputs.reverse()
    while inputs:
        out = node.given(inputs.pop())
        yield from out
        for each in out:
            if isinstance(each.message, m.MapEstimate):
                centre = m.Liveliness(
                    stamp_ns=0, node="central", alive=each.message.exchange in fused
                )
                inputs += [fused[each.message.exchange], centre] if centre.alive else [centre]
