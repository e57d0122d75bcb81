"""Build the native core: the backend that pyproject.toml names, and the build of a source tree.

    python team/core/building/backend.py             build into team/core, for every processor
    python team/core/building/backend.py --own       for this machine's processor, in half the time
    python team/core/building/backend.py --checked   with sanitizers (TEAMSLAM_CORE=checked)
    python team/core/building/backend.py --find compiler    name it; status 1: there is none
    python team/core/building/backend.py --find cmake

Wheels are scikit-build-core's. An editable install builds into the source tree and adds one
folder to the path, which holds a link to the package `teamslam` and nothing else: no import hook
stands before a second checkout on PYTHONPATH, and no other folder of the tree can be imported.

Without a C++20 compiler on the machine the build uses that of the `ziglang` wheel.
"""

import argparse
import base64
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
SOURCES = ROOT / "team" / "core"
MODULES = "_core_*"
ZIG = "ziglang>=0.13"
CMAKE = (3, 20)  # least version, that of CMakeLists.txt
COMPILERS = ("c++", "g++", "clang++")
C20 = "#include <bit>\n#include <concepts>\n#include <span>\nstd::span<const double> numbers;\n"
NO_COMPILER = """\
Building the core needs a C++20 compiler (g++ 11, clang 14 or newer), and none is on the PATH.
Install one (Debian and Ubuntu: apt install g++; Fedora: dnf install gcc-c++), name one by CXX, or
install that of a wheel (pip install ziglang), which takes about four minutes, once.\
"""
LEVELS = "cmake.define.TEAMSLAM_LEVELS"
"""The setting that names the levels of a wheel or an editable install."""
Settings = dict[str, str | list[str]] | None


def find_compiler() -> str | None:
    """Find the C++20 compiler of the machine: the one that CXX names, or the first that works."""
    if named := os.environ.get("CXX"):
        return named
    return next(
        (found for name in COMPILERS if (found := shutil.which(name)) and _works(found)), None
    )


def _works(compiler: str) -> bool:
    command = [compiler, "-std=c++20", "-fsyntax-only", "-x", "c++", "-"]
    tried = subprocess.run(command, input=C20.encode(), capture_output=True, check=False)  # noqa: S603
    return not tried.returncode


def compiler_options() -> list[str]:
    """Options of CMake for the compiler; Zig's, under names that CMake can call, is used if needed.

    Zig builds its C++ library anew for each target, so the options name one target for all levels
    and for CMake's trials.
    """
    if os.environ.get("CXX"):
        return []
    if compiler := find_compiler():
        return [f"-DCMAKE_CXX_COMPILER={compiler}"]
    if find_spec("ziglang") is None:
        sys.exit(NO_COMPILER)
    print(
        "No C++20 compiler (c++, g++, clang++) is on the PATH: building with the one of the ziglang"
        " wheel, which takes about four minutes, once.",
        file=sys.stderr,
        flush=True,
    )
    # At a lasting place: CMake begins anew where the compiler is another one.
    folder = ROOT / "build" / "zig"
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("c++", "ar", "ranlib"):
        path = folder / f"zig-{name}"
        path.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ziglang {name} "$@"\n', "utf-8")
        path.chmod(0o755)
    target = "-O2 -mcpu=x86_64_v2" if platform.machine() in ("x86_64", "AMD64") else "-O2"
    return [
        f"-DCMAKE_CXX_COMPILER={folder}/zig-c++",
        f"-DCMAKE_AR={folder}/zig-ar",
        f"-DCMAKE_RANLIB={folder}/zig-ranlib",
        f"-DCMAKE_CXX_FLAGS={target}",
        "-DCMAKE_TRY_COMPILE_TARGET_TYPE=STATIC_LIBRARY",
        "-DTEAMSLAM_ZIG=ON",
    ]


def own_level() -> str:
    """Name the level that this machine's processor imports, as `teamslam.team.core` chooses it."""
    try:
        flags = Path("/proc/cpuinfo").read_text("utf-8").partition("flags")[2].partition("\n")[0]
    except OSError:
        flags = ""
    return "avx2" if "avx2" in flags.split() else "base"


def known_levels() -> tuple[str, ...]:
    """Levels that CMakeLists.txt has for this kind of processor."""
    return ("base", "avx2") if platform.machine() in ("x86_64", "AMD64") else ("base",)


def chosen_levels(settings: Settings) -> list[str] | None:
    """Return the levels that the settings name, `own` resolved; None: all. An unknown one ends the
    build.
    """
    named = (settings or {}).get(LEVELS)
    if named is None:
        return None
    names = [name for name in (named.split(";") if isinstance(named, str) else named) if name]
    if unknown := [name for name in names if name not in (*known_levels(), "own")]:
        known = ", ".join(known_levels())
        sys.exit(
            f"{LEVELS}: {platform.machine()} has no level {', '.join(unknown)}; choose of {known},"
            f" or own: that of this machine ({own_level()})"
        )
    return [own_level() if name == "own" else name for name in names]


def build_in_place(*, checked: bool = False, own: bool = False) -> None:
    """Build the core of this source tree into team/core.

    checked: a build with sanitizers, beside it. own: for this machine's processor alone.
    """
    kind = "checked" if checked else "own" if find_compiler() else "zig"
    folder = ROOT / "build" / f"core-{sys.version_info[1]}-{kind}"
    _cmake(
        *("-S", str(SOURCES), "-B", str(folder), "-G", "Ninja"),
        f"-DPython_EXECUTABLE={sys.executable}",
        f"-DTEAMSLAM_CHECKED={'ON' if checked else 'OFF'}",
        *compiler_options(),
    )
    _cmake("--build", str(folder), *(["--target", f"_core_{own_level()}"] if own else []))
    for built in sorted(folder.glob(f"{MODULES}.so")):
        # Replaced, not rewritten: a process may have the old one in memory.
        new = SOURCES / f"{built.name}.new"
        shutil.copy2(built, new)
        new.replace(SOURCES / built.name)


def find_cmake() -> str | None:
    """Find a CMake that is new enough: of this environment, or of the machine."""
    for place in (str(Path(sys.executable).parent), os.environ["PATH"]):
        if command := shutil.which("cmake", path=place):
            asked = [command, "--version"]
            said = subprocess.run(asked, capture_output=True, text=True, check=False)  # noqa: S603
            version = re.search(r"(\d+)\.(\d+)", said.stdout)
            if version and (int(version[1]), int(version[2])) >= CMAKE:
                return command
    return None


def _cmake(*arguments: str) -> None:
    command = find_cmake()
    if command is None:
        sys.exit("Building the core needs CMake 3.20 and ninja: pip install cmake ninja")
    # Ninja of the same environment comes before the machine's.
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run([command, *arguments], env={**os.environ, "PATH": path}, check=False)  # noqa: S603
    if done.returncode:
        sys.exit(f"Building the core failed, for the reason above: cmake {' '.join(arguments)}")


# The hooks of PEP 517 and PEP 660.


def get_requires_for_build_sdist(config_settings: Settings = None) -> list[str]:
    """Name what a source distribution needs beside the requirements of pyproject.toml."""
    from scikit_build_core import build

    return build.get_requires_for_build_sdist(config_settings)


def build_sdist(directory: str, config_settings: Settings = None) -> str:
    """Build the source distribution."""
    from scikit_build_core import build

    return build.build_sdist(directory, config_settings)


def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    """Name what a wheel needs: cmake and ninja where they are missing, and a compiler."""
    from scikit_build_core import build

    needed = build.get_requires_for_build_wheel(config_settings)
    return needed if find_compiler() else [*needed, ZIG]


get_requires_for_build_editable = get_requires_for_build_wheel


def build_wheel(
    directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    """Build the wheel, with all levels of the core or those that the settings name."""
    from scikit_build_core import build

    settings = dict(config_settings or {})
    if (levels := chosen_levels(config_settings)) is not None:
        settings[LEVELS] = ";".join(levels)
    for option in compiler_options():
        name, _, value = option.removeprefix("-D").partition("=")
        settings[f"cmake.define.{name}"] = value
    return build.build_wheel(directory, settings, metadata_directory)


def build_editable(
    directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    """Build the core in place; the wheel holds the path of the source tree and the metadata.

    The setting `cmake.define.TEAMSLAM_LEVELS=own` builds for this machine's processor alone.
    """
    from scikit_build_core import build

    build_in_place(own=chosen_levels(config_settings) == [own_level()])
    link = ROOT / "build" / "editable" / "teamslam"
    if not link.is_symlink():
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(ROOT / "teamslam")
    with tempfile.TemporaryDirectory() as folder:
        info = build.prepare_metadata_for_build_editable(folder, config_settings)
        name = info.removesuffix(".dist-info")
        files = {f"{name.partition('-')[0]}.pth": f"{link.parent}\n".encode()}
        for path in sorted(Path(folder, info).rglob("*")):
            if path.is_file() and path.name != "RECORD":
                files[path.relative_to(folder).as_posix()] = path.read_bytes()
    tag = "py3-none-any"
    files[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: teamslam\nRoot-Is-Purelib: true\nTag: {tag}\n".encode()
    )
    record = [f"{each},sha256={_digest(data)},{len(data)}" for each, data in files.items()]
    files[f"{info}/RECORD"] = "\n".join([*record, f"{info}/RECORD,,", ""]).encode()
    wheel = f"{name}-{tag}.whl"
    with zipfile.ZipFile(Path(directory, wheel), "w", zipfile.ZIP_DEFLATED) as archive:
        for each, data in files.items():
            archive.writestr(each, data)
    return wheel


def _digest(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Build the native core of this source tree.")
    parser.add_argument("--checked", action="store_true", help="with sanitizers and bounds checks")
    parser.add_argument("--own", action="store_true", help="for this machine's processor alone")
    parser.add_argument("--find", choices=("compiler", "cmake"), help="name the program")
    options = parser.parse_args()
    if options.find:
        found = find_compiler() if options.find == "compiler" else find_cmake()
        print(found or f"no {options.find} that is new enough")
        sys.exit(found is None)
    build_in_place(checked=options.checked, own=options.own)
