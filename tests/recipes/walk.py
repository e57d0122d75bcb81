"""Add a fusion rule and an estimator by their rows alone, run teams with them, and verify.

python -m tests.recipes.walk FOLDER
"""

import sys
from pathlib import Path
from types import ModuleType

import teamslam.team

ROWS = {
    "ESTIMATORS: Mapping[str, EstimatorRow] = MappingProxyType(\n    {\n": (
        '"standing": EstimatorRow("tests.recipes.standing:Standing", ("alone",)),\n'
    ),
    "RULES: Mapping[str, RuleRow] = MappingProxyType(\n    {\n": (
        '"first-submaps": RuleRow("tests.recipes.first_submaps:FirstSubmapsCentre", "submap"),\n'
    ),
}
"""What a user writes into team/pairs.py, by what it is written behind."""


def add_rows() -> None:
    path = Path(teamslam.team.__file__).parent / "pairs.py"
    source = path.read_text()
    for before, row in ROWS.items():
        assert source.count(before) == 1, before
        source = source.replace(before, before + row)
    module = ModuleType("teamslam.team.pairs")
    sys.modules["teamslam.team.pairs"] = module
    exec(compile(source, str(path), "exec"), vars(module))
    teamslam.team.pairs = module


def main(folder: Path) -> None:
    add_rows()
    from teamslam.central.desk.verification.verification import verify
    from teamslam.sim.in_memory.team import final_map
    from tests.sim.reruns import team_samples, thesis, written

    ours = thesis(24, fusion="first-submaps"), thesis(24, estimator="standing", fusion="alone")
    for scenario in ours:
        samples = team_samples(scenario)
        final = final_map(samples)
        found = verify(written(folder / f"{final.rule}.mcap", samples))
        compared = {c.channel: (c.messages, c.equal) for c in found.channels}
        assert found.first is None, str(found.first)
        print(final.rule, len(final.ids) // 4, final.final, compared)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
