"""The final map names the landmark that was moved, or whose number two landmarks have."""

from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from tests.trials.stress_world import MovedLandmark, StressWorld, write

WORLD = StressWorld(robots=2, landmarks=12, half_m=10.0, seconds=120.0)
MOVED = replace(WORLD, moved=(MovedLandmark(7, (1.4, 1.4), 60.0),))
STRAY = replace(WORLD, moved=(MovedLandmark(9, (1.4, 1.4), 113.0),))
"""Two of a landmark's 23 submaps have it elsewhere, at 17 times the cost of a right one."""
TWICE = replace(WORLD, same_id=((3, 9),))


@pytest.mark.parametrize(
    ("world", "landmark"),
    [(WORLD, None), (STRAY, None), (MOVED, 7), (TWICE, 3)],
    ids=["right", "stray", "moved", "twice"],
)
def test_the_landmark_that_does_not_fit_is_named_and_no_other(
    tmp_path: Path, world: StressWorld, landmark: int | None
) -> None:
    place = write(world, tmp_path)
    scenario = with_options(load(str(place / "scenario.toml")), dataset=place)
    robust = msgspec.structs.replace(scenario.central, robust_c=1.0)  # else it enters the biases
    scenario = msgspec.structs.replace(scenario, central=robust)
    fused = final_map(list(run_team(scenario, streams_of(scenario))))
    named = [each for each in fused.reasons if "does not fit: cost" in each]
    wanted = [] if landmark is None else [f"landmark {landmark} does not fit"]
    assert [each.partition(":")[0] for each in named] == wanted
