"""Foxglove and Lichtblick layout."""

import json
from collections.abc import Sequence

from teamslam.central.desk.drawing import colour_of
from teamslam.central.desk.names import in_order
from teamslam.team.wire import views
from teamslam.team.wire.views import MAP_FRAME


def layout(team: str, robots: Sequence[str]) -> str:
    """JSON layout for a team's log or run."""
    prefix = f"team/{team}"
    ordered = in_order(robots)
    configs = {
        "3D!scene": _scene(prefix, ordered),
        "RosOut!events": {"topicToRender": f"{prefix}/{views.LOG.key()}", "minLogLevel": 1},
        "Plot!x": _errors(prefix, ordered, "x_m", "error in x [m]"),
        "Plot!y": _errors(prefix, ordered, "y_m", "error in y [m]"),
        "Plot!heading": _errors(prefix, ordered, "heading_rad", "error in heading [rad]"),
        "Plot!consistency": _plot(
            "per degree of freedom (1 is right)",
            [
                _line(f"{prefix}/{views.TEAM.key()}.{figure}", label, None)
                for figure, label in (
                    ("status.joint_cost_per_dof", "joint cost"),
                    ("status.covariance_scale", "covariance scale"),
                    ("landmark_nees_per_dof", "map NEES per dof"),
                )
            ],
        ),
    }
    plots: object = "Plot!consistency"
    for share, panel in ((50, "Plot!heading"), (33, "Plot!y"), (25, "Plot!x")):
        plots = _split("column", panel, plots, share)
    left = _split("column", "3D!scene", "RosOut!events", 78)
    return json.dumps(
        {
            "configById": configs,
            "globalVariables": {},
            "userNodes": {},
            "playbackConfig": {"speed": 5},
            "layout": _split("row", left, plots, 64),
        },
        indent=2,
    )


def _scene(prefix: str, robots: Sequence[str]) -> dict[str, object]:
    shown = [views.MAP, views.ROBOTS, views.PATHS]
    topics = {f"{prefix}/{view.key()}": {"visible": True} for view in shown}
    clouds = {
        f"{prefix}/{views.PARTICLES.key(robot)}": {
            "visible": True,
            "pointSize": 3,
            "colorMode": "flat",
            "flatColor": colour_of(number),
        }
        for number, robot in enumerate(robots)
    }
    return {
        "followTf": MAP_FRAME,
        "scene": {"backgroundColor": "#0d1219", "transforms": {"showLabel": False}},
        "cameraState": {
            "perspective": False, "distance": 120, "phi": 0, "thetaOffset": 0,
            "targetOffset": [0, 0, 0], "target": [0, 0, 0], "targetOrientation": [0, 0, 0, 1],
        },
        "layers": {"grid": {"layerId": "foxglove.Grid", "size": 200, "divisions": 20,
                            "color": "#263244ff", "visible": True, "instanceId": "grid"}},
        "topics": {**topics, **clouds},
    }  # fmt: skip


def _errors(prefix: str, robots: Sequence[str], of: str, title: str) -> dict[str, object]:
    lines = []
    for number, robot in enumerate(robots):
        topic = f"{prefix}/{views.ROBOT.key(robot)}"
        colour = colour_of(number)
        lines.append(_line(f"{topic}.error_{of}", robot, colour))
        if number == 0:
            lines.append(_line(f"{topic}.three_sigma_{of}", f"3σ of {robot}", colour))
            lines.append(_line(f"{topic}.three_sigma_{of}.@negative", "", colour))
    return _plot(title, lines)


def _plot(title: str, lines: list[dict[str, object]]) -> dict[str, object]:
    return {
        "foxglovePanelTitle": title, "paths": lines, "xAxisVal": "timestamp", "showLegend": True,
        "legendDisplay": "floating", "isSynced": True, "showXAxisLabels": True,
        "showYAxisLabels": True,
    }  # fmt: skip


def _line(path: str, label: str, colour: str | None) -> dict[str, object]:
    line: dict[str, object] = {
        "value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime",
    }  # fmt: skip
    return line if colour is None else {**line, "color": colour}


def _split(direction: str, first: object, second: object, percentage: int) -> dict[str, object]:
    return {
        "direction": direction, "first": first, "second": second, "splitPercentage": percentage,
    }  # fmt: skip
