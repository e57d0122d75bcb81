"""Export a log as a data set in the UTIAS MRCLAM format."""

from collections.abc import Iterator
from pathlib import Path

from teamslam.sim.datasets.utias_writer import beyond_utias, write_utias
from teamslam.sim.recorded.streams import recorded_streams
from teamslam.team.driver.source import FIRST_INCARNATION
from teamslam.team.recording.reader import Log, LogError
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m
from teamslam.team.wire.bus import opened
from teamslam.team.wire.codec import WireError

CHANNELS = (*ch.SENSORS, ch.TRUTH, ch.TRUTH_LANDMARKS)


def export_utias(log: Log, folder: Path) -> list[str]:
    """Write the data set into `folder`, robots in the order of their numbers 1, 2, …

    The format has one stream per robot: the first incarnation. Raises LogError for missing
    measurements.
    """
    messages = list(_sound(log))
    measurements = [each for each in messages if isinstance(each, m.Measurement)]
    robots = {each.robot for each in measurements if each.incarnation == FIRST_INCARNATION}
    if not robots:
        raise LogError(
            log.path, "no sensor measurements in it", "`--format csv` writes what there is"
        )
    sighted = {n for each in measurements if isinstance(each, m.Sightings) for n in each.teammates}
    if sighted - robots:
        what = (
            f"it has sightings of {', '.join(sorted(sighted - robots))} but not their measurements"
        )
        raise LogError(log.path, what, "`teamslam log merge` puts the robots' logs together")
    try:
        world = recorded_streams(messages, log.path.name)
    except ValueError as error:
        remedy = "the format needs measurements without gaps: `teamslam log cut` to a part without"
        raise LogError(log.path, str(error), remedy) from None
    lost = beyond_utias(world)
    if lost:
        what = f"it has {', '.join(lost)}, which the format does not have"
        raise LogError(
            log.path, what, f"`teamslam import {log.path} -o FOLDER` writes tables of it"
        )
    write_utias(world, folder)
    return [stream.robot for stream in world.streams]


def _sound(log: Log) -> Iterator[m.Message]:
    for sample in log.samples(CHANNELS):
        try:
            yield opened(sample)[2]
        except WireError:
            continue  # every node rejects it, too; `teamslam log check` counts it
