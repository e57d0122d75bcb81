import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import jaxtyping
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.baseline import baselines
from teamslam.sim.cli.main import load_all
from teamslam.team import extras, shapes
from tests.support import ROOT

BUILDING = ("cmake", "nanobind", "ninja", "scikit-build-core")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def closure(*roots: str) -> set[str]:
    found: set[str] = set()
    pending = [Requirement(root) for root in roots]
    seen = set()
    while pending:
        requirement = pending.pop()
        name = canonicalize_name(requirement.name)
        wanted = (name, frozenset(requirement.extras))
        if wanted in seen:
            continue
        seen.add(wanted)
        found.add(name)
        for text in metadata.distribution(name).requires or []:
            needed = Requirement(text)
            extras = {"", *requirement.extras}
            if needed.marker is None or any(needed.marker.evaluate({"extra": e}) for e in extras):
                pending.append(needed)
    return found - {"teamslam"}


def python(code: str, **options: object) -> str:
    command = [sys.executable, "-c", code]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, **options)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def tracked() -> list[Path]:
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: nothing is tracked")
    listed = subprocess.run([git, "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    files = [ROOT / name for name in listed.stdout.decode().split("\0") if name]
    return [file for file in files if file.is_file()]


def test_the_changelog_tells_of_this_version():
    assert f"## [{PROJECT['version']}]" in (ROOT / "CHANGELOG.md").read_text()


def test_constraints_pin_every_distribution_by_version_alone():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if not line.startswith("#")]
    assert [pin for pin in pins if not re.fullmatch(r"[\w.-]+==[\w.]+", pin)] == []
    pinned = {canonicalize_name(pin.partition("==")[0]) for pin in pins}
    assert closure("teamslam[dev]") - pinned == set()
    assert {"pip", "scikit-build-core"} <= pinned


def test_every_pinned_distribution_has_its_hashes():
    """`make setup` and the image install only distributions with a listed hash."""
    pin = re.compile(
        r"^([\w.-]+==[\w.]+)(?: ;.*)? \\\n((?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", re.M
    )

    def pins(name: str) -> set[str]:
        text = (ROOT / name).read_text()
        assert pin.sub("", text) == "", f"{name}: a line that is no pin with hashes"
        names = (found[1].split("==") for found in pin.finditer(text))
        return {f"{canonicalize_name(project)}=={version}" for project, version in names}

    lines = (ROOT / "constraints.txt").read_text().splitlines()
    parts = (line.split("==") for line in lines if not line.startswith("#"))
    wanted = {f"{canonicalize_name(project)}=={version}" for project, version in parts}
    assert pins("hashes.txt") == wanted
    runtime = {each.partition("==")[0] for each in pins("hashes-run.txt") & wanted}
    assert {"pip", *BUILDING, *closure(*PROJECT["dependencies"])} <= runtime


def test_no_path_of_a_machine_is_committed():
    machine = re.compile(
        rf"(?<![\w.}}])/(?:{'|'.join(['work', 'root', 'farm', 'home', 'Users'])})/"
    )
    found = [
        f"{file.relative_to(ROOT)}: {line.strip()[:80]}"
        for file in tracked()
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines()
        if machine.search(line)
    ]
    assert found == []


def test_no_data_set_and_no_log_is_committed():
    data = {".dat", ".zip", ".gz", ".mcap", ".npy", ".npz"}
    assert [file for file in tracked() if file.suffix in data] == []
    film = ROOT / "docs/team.gif"
    assert film.stat().st_size <= 3_000_000
    assert [file for file in tracked() if file.stat().st_size > 1_000_000 and file != film] == []


def commands(page: Path, program: str) -> set[str]:
    found = re.findall(rf"^\s*(?:\$ )?{program} ([a-z][\w-]*)", page.read_text(), re.MULTILINE)
    return set(found)


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_make_target_that_a_page_names_exists(page):
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    spoken = set(re.findall(r"`make (\w+)`", (ROOT / page).read_text()))
    named = commands(ROOT / page, "make") | spoken
    assert named
    assert named <= targets


@pytest.mark.parametrize(
    ("words", "unused"),
    [
        ("router --listen nowhere", {"numpy", "mcap"}),
        ("record waypoints --output log.mcap", {"numpy"}),
        (
            "robot waypoints r1",
            {"numpy.random", "mcap", "teamslam.team.estimation.map_joining.submap_graph"},
        ),
    ],
)
def test_a_process_loads_nothing_that_it_does_not_use_until_it_connects(words, unused, tmp_path):
    code = (
        f"import sys; sys.argv = ['teamslam', *{words.split()!r}]\n"
        "from teamslam.sim.cli import main, options\n"
        "def connect_bus(*_):\n"
        "    import teamslam.team.wire.zenoh.bus\n"
        "    sys.exit()\n"
        "options.connect_bus = connect_bus\n"
        "try: main.main()\n"
        "except SystemExit: pass\n"
        "finally: print(*(name for name, module in sys.modules.items() if module))"
    )
    loaded = set(python(code, cwd=tmp_path).splitlines()[-1].split())
    assert any(each.startswith("teamslam.team.wire.zenoh.") for each in loaded)
    unused |= {"jaxtyping", "scipy", "matplotlib", "rich", "teamslam.sim.cli.log"}
    assert loaded.isdisjoint(unused)


@pytest.mark.parametrize(
    ("imported", "unused"),
    [
        (
            "teamslam.sim.cli.launch, teamslam.sim.launch.launch, teamslam.sim.launch.live",
            {"numpy", "teamslam.sim.cli.main"},
        ),
        ("teamslam.team.driver.driver", {"click", "_ssl", "jaxtyping"}),
    ],
)
def test_a_launch_and_a_driver_begin_without_what_they_need_later_or_never(imported, unused):
    loaded = python(f"import sys, {imported}; print(*sys.modules)").split()
    assert set(loaded).isdisjoint(unused | {"cryptography.x509", "mcap"})


def test_the_commands_alone_load_no_numpy():
    code = "import sys; from teamslam.sim.cli.main import load_all; load_all(); print(*sys.modules)"
    loaded = python(code).split()
    assert "teamslam.sim.studies.experiment_command" in loaded
    assert {"numpy", "rich.progress"}.isdisjoint(loaded)


def test_a_launch_and_its_report_need_no_scipy():
    parts = (
        "sim.launch.launch", "sim.cli.main", "sim.in_memory.team", "central.main",
        "central.peers.main", "team.robot.main", "team.recording.shell", "central.desk.report.page",
        "central.desk.view.server", "central.desk.verification.verification",
        "team.estimation.map_joining.relaxation",
    )  # fmt: skip
    code = "import sys; sys.modules['scipy'] = None\n"
    code += "".join(f"import teamslam.{part}\n" for part in parts)
    python(code)
    assert "scipy" not in closure(*PROJECT["dependencies"])


def test_shapes_are_checked_in_tests():
    """They would not be if a plugin loaded `teamslam` before the import hook of conftest.py."""
    assert shapes.Float is jaxtyping.Float


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lists a process's threads")
def test_the_linear_algebra_of_a_command_has_one_thread():
    code = (
        "import os, teamslam.sim.cli.main, numpy, scipy.linalg\n"
        "for library in numpy, scipy: library.linalg.inv(numpy.eye(64))\n"
        "print(len(os.listdir('/proc/self/task')))"
    )
    bare = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    assert python(code, env=bare) == "1\n"


def test_an_extra_is_installed_by_its_packages_wherever_we_come_from(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/opt/a b/python")
    studies = extras.install_command("studies")
    assert studies.startswith("'/opt/a b/python' -m pip install 'scipy>=")
    assert "'joblib>=1.5'" in studies
    assert "teamslam" not in studies

    def unknown(_: str) -> None:
        raise PackageNotFoundError

    monkeypatch.setattr(extras, "requires", unknown)
    assert extras.install_command("studies").endswith("pip install '.[studies]'")


def test_the_settings_of_make_s_installation_are_known_to_the_build(tmp_path):
    named = re.findall(r"--config-settings (\S+)=(\S+)", (ROOT / "Makefile").read_text())
    assert named
    code = "import sys; from scikit_build_core import build; "
    code += f"build.prepare_metadata_for_build_editable({str(tmp_path)!r}, {dict(named)!r})"
    python(code, cwd=ROOT)
    assert list(tmp_path.glob("teamslam-*.dist-info"))


COMPOSE = ROOT / "docker-compose.yml"


@pytest.fixture(scope="module")
def compose():
    return yaml.safe_load(COMPOSE.read_text())


def test_the_compose_file_is_valid_by_the_compose_specification():
    """The schema is in check-jsonschema: nothing is fetched."""
    schema = ["--builtin-schema", "vendor.compose-spec"]
    command = [sys.executable, "-m", "check_jsonschema", *schema, str(COMPOSE)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout


def test_every_service_runs_a_command_with_options_that_exist(compose):
    commands = load_all().commands
    for name, service in compose["services"].items():
        command, *words = service["command"]
        commands[command].make_context(command, [*words])  # raises for an unknown option
        assert ("tcp/router:7447" in words) == (name != "router")


def test_nothing_is_published_beyond_the_host_itself(compose):
    ports = [port for service in compose["services"].values() for port in service.get("ports", [])]
    assert ports == ["127.0.0.1:7447:7447"]


def test_each_baseline_says_how_it_is_measured_and_what_may_be_worse():
    known = baselines()
    assert {"growth", "in_memory", "ratios", "recorder", "start"} <= set(known)
    for name, told in known.items():
        program = name.partition("-")[0]  # one program may have a second baseline: growth-large
        assert shlex.split(told["command"])[:3] == ["python", "-m", f"benchmarks.{program}"]
        assert (ROOT / "benchmarks" / f"{program}.py").is_file()
        assert told["measured"]
        for of in told["figures"].values():
            assert set(of) == {"value", "better", "tolerance"}
            assert of["better"] in ("less", "more")


def test_commands_are_there_without_the_packages_of_extras(tmp_path):
    """As after `pip install teamslam`: `dev` has more, which could hide an import."""
    own = closure(*PROJECT["dependencies"]) | {"teamslam"}
    lent = [
        module
        for module, of in metadata.packages_distributions().items()
        if own.isdisjoint(map(canonicalize_name, of))
    ]
    assert {"joblib", "scipy", "gtsam"} <= set(lent)
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({lent!r}))\n"
        "import teamslam.sim.in_memory.team, teamslam.central.desk.report.page\n"
        "import teamslam.sim.recorded.changed_run\n"
        "sys.argv = ['teamslam', 'experiment', '--help']\n"
        "from teamslam.sim.cli.main import main; main()"
    )
    assert "accuracy" in python(code, cwd=tmp_path)
