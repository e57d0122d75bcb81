"""The core has the same bits with any compiler, and no build contracts arithmetic."""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import pytest

from teamslam.team import core
from tests.support import ROOT

FOLDER = ROOT / "team" / "core"
LIBRARIES = Path(core.__file__).parent  # elsewhere than the sources where a wheel is tested
PROGRAMS = {
    "bits": (
        "8c51871c169fc457 238a4106659bd483",
        (
            *("window", "particles", "innovation", "along_path", "moments", "dense", "gaussian"),
            *("arrow", "consensus", "sensitivity", "motion"),
        ),
    ),
    "bits_algebra": ("1a4d2800e5776554", ("dense", "gaussian", "chi2")),
    "bits_maps": ("5b4d4dd12f244a66", ("own_map", "chain", "submap_factor", "dense", "gaussian")),
    "bits_sparse": ("f86e6c8d2c75a282", ("ordering", "sparse_pattern", "sparse", "dense")),
    "bits_odometry": ("fba0d664d0eb528d", ("motion", "segmenter", "measurements")),
}
"""Hashes of all results of a program in this folder, and the core's sources that it takes."""
EXACT = ("-std=c++20", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")
COMPILED = pytest.mark.skipif(
    core.level != "checked", reason="compiling these programs takes minutes: make check-core"
)
FUSED = re.compile(r"\s(?:vfn?m(?:add|sub)\w*|fn?m(?:add|sub)|fml[as])\s.*")


def hash_of(name: str, tmp_path: Path, *command: str, runs_by: Sequence[str] = ()) -> str:
    program = tmp_path / name
    sources = [FOLDER / "src" / f"{each}.cpp" for each in PROGRAMS[name][1]]
    words = [*command, *EXACT, "-I", FOLDER / "src", *sources, ROOT / f"tests/core/{name}.cpp"]
    subprocess.run([*words, "-o", program], check=True, capture_output=True, timeout=900)
    ran = subprocess.run([*runs_by, program], check=True, capture_output=True, text=True)
    return " ".join(ran.stdout.split())


COMPILERS = {
    "gcc -O1": ("g++", "-O1"),
    "gcc -O3": ("g++", "-O3"),
    "gcc avx2": ("g++", "-O3", "-mavx2"),
    "clang": (sys.executable, "-m", "ziglang", "c++", "-O3", "-mcpu=x86_64_v2"),
    "arm": ("aarch64-linux-gnu-g++", "-O3", "-static"),
}
"""clang comes from the ziglang wheel; Debian: apt install g++-aarch64-linux-gnu qemu-user, whose
base has fused multiply-add."""


@COMPILED
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", PROGRAMS)
def test_each_compiler_at_each_level_gives_the_same_bits(name, compiler, tmp_path):
    command, runs_by = COMPILERS[compiler], ["qemu-aarch64"] if compiler == "arm" else []
    if any(shutil.which(each) is None for each in (command[0], *runs_by)):
        pytest.skip(f"{' or '.join((command[0], *runs_by))} is not on the path")
    if compiler == "clang" and find_spec("ziglang") is None:
        pytest.skip("ziglang is not installed: pip install --no-deps -r hashes-zig.txt")
    if compiler == "gcc avx2" and "avx2" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("this processor has no AVX2")
    assert hash_of(name, tmp_path, *command, runs_by=runs_by) == PROGRAMS[name][0]


def test_no_library_holds_a_fused_multiply_add():
    if shutil.which("objdump") is None:
        pytest.skip("objdump is not on the path")
    built = sorted(LIBRARIES.glob("_core_*.so"))
    assert built
    for library in built:
        code = subprocess.run(
            ["objdump", "-d", "--no-show-raw-insn", library],
            check=True,
            capture_output=True,
            text=True,
        )
        assert FUSED.search(code.stdout) is None, library


def test_the_search_for_fused_instructions_finds_one(tmp_path):
    if shutil.which("g++") is None or shutil.which("objdump") is None:
        pytest.skip("g++ or objdump is not on the path")
    source, made = tmp_path / "fused.cpp", tmp_path / "fused.o"
    source.write_text("double f(double a, double b, double c) { return __builtin_fma(a, b, c); }\n")
    subprocess.run(["g++", "-O2", "-mfma", "-c", source, "-o", made], check=True)
    code = subprocess.run(["objdump", "-d", made], check=True, capture_output=True, text=True)
    assert FUSED.search(code.stdout)


def test_the_library_is_built_from_the_sources_that_are_here():
    """Otherwise run `make core`."""
    sources = [*(FOLDER / "src").glob("*.[ch]pp"), FOLDER / "CMakeLists.txt"]
    names = sorted(sources, key=lambda path: path.relative_to(FOLDER).as_posix())
    digests = "".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in names)
    assert core.digest == hashlib.sha256(digests.encode()).hexdigest()


def test_the_type_stub_is_that_of_the_library():
    if find_spec("nanobind") is None:
        pytest.skip("nanobind is not installed")
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); import stub; print(stub.made_stub(), end='')"
    )
    made = subprocess.run(
        [sys.executable, "-c", script, FOLDER / "building"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert made.stdout == (FOLDER / "_core.pyi").read_text()


def test_the_level_can_be_chosen():
    command = [sys.executable, "-c", "from teamslam.team import core; print(core.level)"]
    levels = {}
    for level in ("base", "absent"):
        ended = subprocess.run(
            command, env={**os.environ, "TEAMSLAM_CORE": level}, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        levels[level] = ended.returncode, ended.stdout.strip(), ended.stderr
    assert levels["base"][0] == 0
    assert "avx2" not in levels["base"][1]
    assert levels["absent"][0] == 1
    assert "is not built" in levels["absent"][2]
