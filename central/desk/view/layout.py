"""Foxglove and Lichtblick layout: `layout.json`, with the team's topics."""

import json
from collections.abc import Sequence
from importlib.resources import files

from teamslam.central.desk.drawing import colour_of
from teamslam.central.desk.names import in_order
from teamslam.team.wire import views


def layout(team: str, robots: Sequence[str]) -> str:
    """JSON layout for a team's log or run."""
    template = files("teamslam.central.desk.view").joinpath("layout.json").read_text("utf-8")
    whole = json.loads(template.replace("{team}", json.dumps(f"team/{team}")[1:-1]))
    panels = whole["configById"]
    for number, robot in enumerate(in_order(robots)):
        colour = colour_of(number)
        cloud = {"visible": True, "pointSize": 3, "colorMode": "flat", "flatColor": colour}
        panels["3D!scene"]["topics"][f"team/{team}/{views.PARTICLES.key(robot)}"] = cloud
        topic = f"team/{team}/{views.ROBOT.key(robot)}"
        for panel, figure in (("x", "x_m"), ("y", "y_m"), ("heading", "heading_rad")):
            lines = [(f"{topic}.error_{figure}", robot)]
            if number == 0:
                bound = f"{topic}.three_sigma_{figure}"
                lines += [(bound, f"3σ of {robot}"), (f"{bound}.@negative", "")]
            panels[f"Plot!{panel}"]["paths"] += [
                {
                    "value": path, "label": label, "enabled": True,
                    "timestampMethod": "receiveTime", "color": colour,
                }
                for path, label in lines
            ]  # fmt: skip
    return json.dumps(whole, indent=2)
