"""A robot's status, for people."""

from typing import TYPE_CHECKING

from team.robot.warnings import driver_away, unexpected
from team.wire import channels as ch
from team.wire import messages as m

if TYPE_CHECKING:
    from team.robot.node import RobotNode


def status_of(node: "RobotNode") -> m.Status:
    """The status of a robot's node: figures, state and the newest warnings."""
    mapper, config, poses = node.mapper, node.config, node.mapper.poses
    measurements, outliers = node.next_measurement, config.front_end.outlier_share
    nis, submaps = mapper.innovation, mapper.submaps
    figures = {
        "steps": float(node.steps_before + node.steps),
        "measurements": float(measurements),
        "submaps": float(submaps.sent),
        "particles": float(config.front_end.particles),
        "landmarks": float(len(mapper.own_landmarks().ids)),
        "pose_sigma_m": poses.sigma_m,
        "withheld": float(node.withheld),
    }
    if submaps.buffers:
        figures["held_submaps"] = float(len(submaps) - submaps.sent)
    if nis.per_dof is not None:
        figures |= {"nis_per_dof": nis.per_dof, "nis_dof": float(nis.dof)}
    if poses.has_prior:
        figures["landmarks_refused"] = float(poses.team_map.refused)
    if outliers:
        figures["gated"] = float(mapper.gated)
    state = "done" if node.done else "mapping" if measurements else "waiting"
    warnings = ["no measurements of this team yet"] if state == "waiting" else []
    if node.stream_end.waits_for_driver and not node.done:
        warnings = [driver_away(measurements - 1)]
    if poses.team_map.doubt:
        warnings.append(poses.team_map.doubt)
    return m.Status(
        stamp_ns=mapper.now_ns,
        node=ch.robot_node(node.robot),
        state=state,
        figures={name: value for name, value in figures.items() if abs(value) <= 1e300},
        warnings=(
            *warnings,
            *unexpected(nis, outliers, config.estimator),
            *node.warnings[-3:],
        ),
    )
