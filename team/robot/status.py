"""A robot's status, for people."""

from typing import Literal

from teamslam.team.robot.mapper import Mapper
from teamslam.team.robot.warnings import driver_away, unexpected
from teamslam.team.wire import channels as ch
from teamslam.team.wire import messages as m


def status_of(
    mapper: Mapper,
    state: Literal["waiting", "mapping", "done"],
    steps: int,
    measurements: int,
    withheld: int,
    *,
    waits_for_driver: bool,
) -> m.Status:
    """Make a robot's status from its counts of intervals and measurements.

    withheld: number of messages that no receiver would have accepted.
    """
    config, poses, submaps, nis = mapper.config, mapper.poses, mapper.submaps, mapper.innovation
    figures = {
        "steps": float(steps),
        "measurements": float(measurements),
        "submaps": float(submaps.sent),
        "particles": float(config.front_end.particles),
        "landmarks": float(len(mapper.own_landmarks().ids)),
        "pose_sigma_m": poses.sigma_m,
        "withheld": float(withheld),
    }
    if submaps.buffers:
        figures["held_submaps"] = float(len(submaps) - submaps.sent)
    if nis.per_dof is not None:
        figures |= {"nis_per_dof": nis.per_dof, "nis_dof": float(nis.dof)}
    if poses.has_prior:
        figures["landmarks_refused"] = float(poses.team_map.refused)
    if mapper.gated:
        figures["gated"] = float(mapper.gated)
    warnings = ["no measurements of this team yet"] if state == "waiting" else []
    if waits_for_driver and state != "done":
        warnings = [driver_away(measurements - 1)]
    if poses.team_map.doubt:
        warnings.append(poses.team_map.doubt)
    return m.Status(
        stamp_ns=mapper.now_ns,
        node=ch.robot_node(config.id),
        state=state,
        figures={name: value for name, value in figures.items() if abs(value) <= 1e300},
        warnings=(
            *warnings,
            *unexpected(nis, config.estimator),
            *[*mapper.warnings][-3:],
        ),
    )
