from click.testing import CliRunner, Result

from teamslam.sim.cli.main import app


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def output_of(*words: object, status: int = 0) -> str:
    result = run(*words)
    assert result.exit_code == status, result.output
    return result.output
