"""A robot's status and warnings, for operators."""

from typing import Literal

from teamslam.team.config import Estimator
from teamslam.team.estimation.hybrid_slam.window import Innovation
from teamslam.team.robot.mapper import Mapper
from teamslam.team.wire import channels as ch, messages as m

UNEXPECTED = 3.0
"""NIS per degree of freedom above which measurements contradict the models: 1 is right; 5 % of
outliers give 3 with a coarse sensor, 100 with an accurate one.
"""
UNEXPECTED_DOF = 60  # least degrees of freedom for this warning


def unexpected(nis: Innovation, estimator: Estimator) -> tuple[str, ...]:
    """Warn of measurements far from their predictions, with the settings to check."""
    ratio = nis.per_dof
    if ratio is None or ratio < UNEXPECTED or nis.dof < UNEXPECTED_DOF:
        return ()
    remedy = "is the sensor's or the odometry's noise larger than its sigmas?"
    if estimator != "hybrid":
        remedy = f"outliers, or {remedy.removeprefix('is ')} {estimator} uses every measurement"
    return (
        f"measurements lie far from their predictions, NIS {ratio:.0f} per degree of freedom "
        f"(1 is right): {remedy}",
    )


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

    withheld: number of messages that no receiver would accept.
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
        warnings = [
            f"its driver is away after measurement {measurements - 1}: start it again, or end the "
            "team by `teamslam end`"
        ]
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
