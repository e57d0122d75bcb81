"""docker-compose.yml: valid by the compose specification, and the team that `launch` starts."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
COMPOSE = ROOT / "docker-compose.yml"


@pytest.fixture(scope="module")
def compose() -> Any:
    return yaml.safe_load(COMPOSE.read_text())


def test_the_compose_file_is_valid_by_the_compose_specification() -> None:
    """The schema is the one that check-jsonschema carries: nothing is fetched."""
    schema = ["--builtin-schema", "vendor.compose-spec"]
    command = [sys.executable, "-m", "check_jsonschema", *schema, str(COMPOSE)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout


def test_every_service_runs_the_command_that_its_name_says(compose: Any) -> None:
    commands = {name: service["command"] for name, service in compose["services"].items()}
    reach = ["--connect", "tcp/router:7447"]
    assert commands == {
        "router": ["router", "--listen", "tcp/0.0.0.0:7447", "--insecure"],
        "world": ["world", "waypoints", *reach],
        "r1": ["robot", "waypoints", "r1", *reach],
        "r2": ["robot", "waypoints", "r2", *reach],
        "r3": ["robot", "waypoints", "r3", *reach],
        "central": ["central", "waypoints", *reach],
        "recorder": ["record", "waypoints", *reach, "--output", "/logs/team.mcap"],
    }


def test_nothing_is_published_beyond_the_host_itself(compose: Any) -> None:
    ports = [port for service in compose["services"].values() for port in service.get("ports", [])]
    assert ports == ["127.0.0.1:7447:7447"]
