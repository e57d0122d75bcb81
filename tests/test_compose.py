"""docker-compose.yml: valid by the compose specification, and the team that `launch` starts."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
COMPOSE = ROOT / "docker-compose.yml"


def validation(path: Path) -> "subprocess.CompletedProcess[str]":
    """The compose-spec JSON schema that check-jsonschema carries, put to the file; offline."""
    schema = "vendor.compose-spec"
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema, str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def compose() -> Any:
    return yaml.safe_load(COMPOSE.read_text())


def test_the_compose_file_is_valid_by_the_compose_specification() -> None:
    result = validation(COMPOSE)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize(
    ("right", "wrong", "named"),
    [
        ("    init: true\n    # Open", "    innit: true\n    # Open", "innit"),
        ("condition: service_healthy", "condition: service_well", "service_well"),
        ("logs: {}", "logs: 3", "volumes.logs"),
    ],
)
def test_the_validator_names_a_mistake(right: str, wrong: str, named: str, tmp_path: Path) -> None:
    text = COMPOSE.read_text()
    assert right in text
    mistaken = tmp_path / "docker-compose.yml"
    mistaken.write_text(text.replace(right, wrong))
    result = validation(mistaken)
    assert result.returncode == 1
    assert named in result.stdout


def test_the_services_are_a_router_a_world_three_robots_a_centre_and_a_recorder(
    compose: Any,
) -> None:
    assert list(compose["services"]) == ["router", "world", "r1", "r2", "r3", "central", "recorder"]


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


def test_one_image_serves_all_and_is_built_once(compose: Any) -> None:
    services = compose["services"].values()
    assert {service["image"] for service in services} == {"teamslam"}
    assert [service["build"] for service in services if "build" in service] == ["."]


def test_every_process_waits_until_the_router_answers(compose: Any) -> None:
    waiting = {
        name for name, service in compose["services"].items()
        if service.get("depends_on") == {"router": {"condition": "service_healthy"}}
    }  # fmt: skip
    assert waiting == set(compose["services"]) - {"router"}
    assert "7447" in str(compose["services"]["router"]["healthcheck"]["test"])


def test_the_log_and_the_compiled_kernels_outlive_their_containers(compose: Any) -> None:
    mounted = {
        volume.split(":")[0]
        for service in compose["services"].values()
        for volume in service.get("volumes", [])
    }
    assert mounted == set(compose["volumes"]) == {"logs", "kernels"}
    assert "logs:/logs" in compose["services"]["recorder"]["volumes"]


def test_nothing_is_published_beyond_the_host_itself(compose: Any) -> None:
    ports = [port for service in compose["services"].values() for port in service.get("ports", [])]
    assert ports == ["127.0.0.1:7447:7447"]


def test_the_project_s_name_is_left_to_the_user(compose: Any) -> None:
    assert "name" not in compose
