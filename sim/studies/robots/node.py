"""Node of a comparison robot, whose centre fuses whole maps or raw measurements.

Under a rule with feedback the robot waits for the fused map of each exchange and absorbs it.
"""

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.desk.verification.robot import NewRobot
from teamslam.sim.studies.robots.mappers import ExchangingMapper, StreamMapper
from teamslam.team import translate
from teamslam.team.config import Exchange, RobotConfig
from teamslam.team.estimation.gaussian import LandmarkGaussian, NotACovarianceError
from teamslam.team.robot import node as product
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing


class ExchangingRobot(RobotNode):
    """A Hybrid-SLAM robot whose centre gives no credit for submaps."""

    listens = (*RobotNode.listens, ch.KNOWN_MAP, ch.FUSED_MAP)
    makes = ExchangingMapper
    mapper: ExchangingMapper

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._centre_is_away = False
        self._reported: tuple[int, int] = 0, 0
        """An incarnation, and its number of measurements reported before their use."""

    def receive(self, message: m.Message) -> None:
        """Handle a message that is no measurement."""
        match message:
            case m.KnownMap():
                self.mapper.know(message)
            case m.FusedMap() if not message.final:
                self._absorb(message)
            case m.Liveliness() if message.node == "central":
                self._centre_is_away = not message.alive
            case _:
                super().receive(message)

    def _absorb(self, fused: m.FusedMap) -> None:
        if not self.mapper.take_answer(fused.exchange):
            return
        ids, means = translate.landmarks_of(fused)
        joint = translate.landmark_covariance_of(fused)
        try:
            self.mapper.absorb(LandmarkGaussian(ids, means, joint))
        except (NotACovarianceError, np.linalg.LinAlgError) as error:
            self.warnings.append(f"the fused map can not be absorbed: {error}")

    @property
    def is_held(self) -> bool:
        """Whether it waits for a known map, or for a centre, which may still answer if it was never
        present.
        """
        waits = self.mapper.waits_for_answer and not self._centre_is_away
        return self.mapper.waits_for_map or waits

    def consume(self) -> None:
        """Consume in order; a waiting robot reports what it received."""
        super().consume()
        if not self.mapper.lockstep or not self.is_held:
            return
        received = self.inbox.received
        if received - self.progress().measurements >= product.PROGRESS_MEASUREMENTS:
            self._reported = self.account.incarnation, received
            self.report_progress()

    def progress(self) -> m.Progress:
        """Number of measurements consumed or reported ahead, and the time."""
        progress = super().progress()
        incarnation, reported = self._reported
        ahead = reported if incarnation == progress.incarnation else 0
        count = max(progress.measurements, ahead)
        return msgspec.structs.replace(progress, measurements=count)

    def statement(self) -> m.Done:
        """The account of the incarnation, with its last map's sequence."""
        return msgspec.structs.replace(super().statement(), last_map=self.mapper.last_map)

    def _close_incarnation(self) -> None:
        super()._close_incarnation()
        if self.done:
            self.mapper.publish_last_map()


class StreamRobot(ExchangingRobot):
    """A robot with one state over its whole stream."""

    makes = StreamMapper


def comparison_robot(
    config: RobotConfig, exchange: Exchange = "continuous", **options: Any
) -> ExchangingRobot:
    """Make a configuration's comparison robot."""
    made = ExchangingRobot if config.estimator == "hybrid" else StreamRobot
    return made(config, exchange, **options)


def in_lockstep(log: Recorded, robot: str, new: NewRobot) -> Iterator[Outgoing]:
    """Recompute messages, waiting for recorded maps."""
    fused = {each.exchange: each for each in log.of(m.FusedMap, ch.FUSED_MAP)}
    node = new()
    incarnations = log.incarnations(robot)
    inputs: list[m.Message] = [
        log.measurements[(robot, incarnation)][counter]
        for incarnation in incarnations
        for counter in sorted(log.measurements[(robot, incarnation)])
    ]
    if any(each.robot == robot for each in log.of(m.Done, ch.ROBOT_DONE)):
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
