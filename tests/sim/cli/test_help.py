"""Help of the commands: sections, examples, suggestions."""

import typer
from typer.testing import CliRunner

from teamslam.sim.cli.help import SECTIONS
from teamslam.sim.cli.main import app
from tests.test_architecture import unknown

RUN = CliRunner()
WHOLE = typer.main.get_command(app)
SHOWN = {name: each for name, each in WHOLE.commands.items() if not each.hidden}  # type: ignore[attr-defined]


def test_every_command_is_in_one_section_and_has_an_example_that_it_understands() -> None:
    named = [name for names in SECTIONS.values() for name in names]
    assert sorted(named) == sorted(SHOWN)
    assert len(SECTIONS) == 5
    commands = [(name, each) for name, each in SHOWN.items() if not hasattr(each, "commands")]
    for group in ("log", "experiment"):
        commands += [(f"{group} {name}", each) for name, each in SHOWN[group].commands.items()]
    for name, each in commands:
        for line in each.epilog.splitlines():
            assert line.startswith(f"teamslam {name} ")
            assert unknown(line.removeprefix("teamslam ")) is None


def test_help_has_the_sections_in_order_and_fits_80_columns() -> None:
    text = RUN.invoke(app, ["--help"], terminal_width=80).output
    places = [text.index(f"\n{title}:\n") for title in SECTIONS]
    assert places == sorted(places)
    launch = RUN.invoke(app, ["launch", "--help"], terminal_width=80).output
    assert launch.index("Options:") < launch.index("Rarely needed:") < launch.index("Network and")
    assert "teamslam launch waypoints --view\n" in launch
    assert max(map(len, (text + launch).splitlines())) <= 80


def test_a_misspelt_command_option_or_scenario_is_answered_by_the_closest_one() -> None:
    for words, meant in (
        (["lunch"], "'launch'"),
        (["log", "chek"], "'check'"),
        (["launch", "--sped", "3"], "`--speed`"),
        (["rerun", "LOG", "--no-center", "0-1"], "`--no-centre`"),
    ):
        result = RUN.invoke(app, words)
        assert result.exit_code == 2
        assert f"id you mean {meant}?" in result.output
    assert "did you mean `waypoints`?" in str(RUN.invoke(app, ["launch", "waypoint"]).exception)


def test_an_option_unlike_any_other_has_no_suggestion() -> None:
    output = RUN.invoke(app, ["launch", "--zzzz"]).output
    assert "No such option: --zzzz\n" in output
