"""The table of views, which a viewer node publishes in the schemas of other tools.

No estimate depends on a view, and verification skips it. Frames: `map` is the team's,
`robot/<name>` a robot's; metres, radians, counter-clockwise; z = 0.
"""

from dataclasses import dataclass
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from teamslam.team.wire.channels import VIEW

MAP_FRAME = "map"


class TeamFigures(msgspec.Struct, frozen=True):
    """Figures of the team for plots; unknown ones are left out.

    map_rmse_m: without alignment to the truth. landmark_nees_per_dof: the report's map NEES; 1 is
    consistent; not of a running map without cross-covariances. status: the centre's figures, with
    those of the consistency monitor.
    """

    team_time_s: float
    landmarks: int
    robots: int
    map_rmse_m: float | UnsetType = UNSET
    landmark_nees_per_dof: float | UnsetType = UNSET
    status: dict[str, float] = msgspec.field(default_factory=dict)


class RobotFigures(msgspec.Struct, frozen=True):
    """Running pose of a robot for plots, and its errors with their 3σ bounds.

    Without truth the errors are left out. nees_per_dof: eᵀ P⁻¹ e / 3, whose expectation is 1.
    status: the robot's own figures.
    """

    team_time_s: float
    x_m: float
    y_m: float
    heading_rad: float
    three_sigma_x_m: float
    three_sigma_y_m: float
    three_sigma_heading_rad: float
    error_x_m: float | UnsetType = UNSET
    error_y_m: float | UnsetType = UNSET
    error_heading_rad: float | UnsetType = UNSET
    nees_per_dof: float | UnsetType = UNSET
    status: dict[str, float] = msgspec.field(default_factory=dict)


@dataclass(frozen=True)
class View:
    """One row: key, schema (Foxglove's by name, ours by its fields), rate, meaning."""

    template: str
    schema: str | type[msgspec.Struct]
    rate: str
    meaning: str

    def key(self, robot: str = "") -> str:
        """Return the relative key, of one robot if it has a place for it."""
        return self.template.replace("{robot}", robot)


MAP = View("view/map", "foxglove.SceneUpdate", "1 Hz, when it has changed",
           "landmarks with 95 % ellipses, and the true ones")  # fmt: skip
ROBOTS = View("view/robots", "foxglove.SceneUpdate", "1 Hz",
              "robots with 95 % ellipses and recent paths")  # fmt: skip
PATHS = View("view/paths", "foxglove.SceneUpdate", "0.1 Hz",
             "thinned paths: running, true, finally smoothed")  # fmt: skip
TRANSFORMS = View("view/transforms", "foxglove.FrameTransforms", "1 Hz",
                  "robots' frames in the map's")  # fmt: skip
POSE = View("view/pose/{robot}", "foxglove.PoseInFrame", "1 Hz", "a robot's running pose")
LANDMARKS = View("view/landmarks", "foxglove.PointCloud", "as view/map",
                 "landmarks as points, with numbers")  # fmt: skip
PARTICLES = View("view/particles/{robot}", "foxglove.PointCloud", "1 Hz, when it has changed",
                 "a robot's particles with weights")  # fmt: skip
LOG = View("view/log", "foxglove.Log", "on change",
           "robots that joined, were lost or refused; warnings")  # fmt: skip
TEAM = View("view/team", TeamFigures, "1 Hz", "figures of the team")
ROBOT = View("view/robot/{robot}", RobotFigures, "1 Hz", "figures of a robot")

VIEWS: tuple[View, ...] = tuple(v for v in list(globals().values()) if isinstance(v, View))


def view_of(key: str) -> View | None:
    """Return the view of a relative key; None if there is none."""
    if VIEW.owner(key) is None:
        return None
    templates = key, key.rpartition("/")[0] + "/{robot}"
    return next((view for view in VIEWS if view.template in templates), None)


def json_schema(of: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON Schema of figures, without references, which some tools do not resolve."""
    (_,), components = msgspec.json.schema_components((of,), ref_template="#/$defs/{name}")
    schema = components[of.__name__]
    return {"title": of.__name__, **schema}
