import ast
import inspect
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import msgspec
import pytest

from teamslam.team.wire import channels as c, messages as m, views as v
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.zenoh.bus import ZenohBus
from teamslam.team.wire.zenoh.router import router
from tests import build
from tests.support import ROOT, submap

PAGE = ROOT / "docs" / "wire.md"


def channel_table() -> str:
    """The table of channels as Markdown; `python -m tests.wire.test_docs` prints it."""
    rows = ["| key | message | rate | delivery | meaning |", "|---|---|---|---|---|"]
    rows += [
        f"| `{channel.template}` | {_carried(channel)} | {channel.rate} | "
        f"{channel.delivery}{'' if channel.recorded else ', not recorded'} | {channel.meaning} |"
        for channel in c.CHANNELS
        if channel not in c.QUERIES
    ]
    return "\n".join(rows)


def query_table() -> str:
    rows = ["| key | request | replies |", "|---|---|---|"]
    rows += [f"| `{q.template}` | {_carried(q)} | {q.meaning} |" for q in c.QUERIES]
    return "\n".join(rows)


def _carried(channel: c.Channel) -> str:
    if channel is c.VIEW:
        return "see Views"
    return ", ".join(f"`{m.tag_of(each)}`" for each in channel.kinds)


def view_table() -> str:
    rows = ["| key | schema | rate | meaning |", "|---|---|---|---|"]
    for view in v.VIEWS:
        schema = view.schema if isinstance(view.schema, str) else f"teamslam.{view.schema.__name__}"
        rows.append(f"| `{view.template}` | `{schema}` | {view.rate} | {view.meaning} |")
    return "\n".join(rows)


def message_list() -> str:
    """Fields of every message by position, with their types unless `usual_types` has them."""
    rows = [f"- `{tag}`: {_fields(message)}" for tag, message in sorted(m.BY_TAG.items())]
    rows += [f"- *{part.__name__}*: {_fields(part)}" for part in _parts()]
    return "\n".join(rows).replace(": \n", "\n")


def fields_by_type() -> dict[str, str]:
    common: dict[str, list[str]] = {}
    for name, of in usual_types().items():
        common.setdefault(of, []).append(f"`{name}`")
    return {of: ", ".join(sorted(names)) for of, names in sorted(common.items())}


def usual_types() -> dict[str, str]:
    types: dict[str, Counter[str]] = {}
    for cls in [*m.BY_TAG.values(), *_parts()]:
        for name, of in _types(cls):
            types.setdefault(name, Counter())[of] += 1
    most = {name: counted.most_common(1)[0] for name, counted in types.items()}
    return {name: of for name, (of, number) in most.items() if number >= 3}


def _parts() -> list[type[msgspec.Struct]]:
    found = [cls for _, cls in inspect.getmembers(m, inspect.isclass) if _is_part(cls)]
    return sorted(found, key=lambda part: part.__name__)


def _is_part(cls: type) -> bool:
    return (
        issubclass(cls, msgspec.Struct)
        and cls.__module__.startswith(m.__name__)
        and not issubclass(cls, m.Message)
    )


def _fields(cls: type[msgspec.Struct]) -> str:
    usual, fields = usual_types(), _types(cls)
    if issubclass(cls, m.Message):
        assert fields[0] == ("stamp_ns", "StampNs")
        fields = fields[1:]
    return ", ".join(name if usual.get(name) == of else f"{name}: {of}" for name, of in fields)


def _types(cls: type[msgspec.Struct]) -> list[tuple[str, str]]:
    spelt = _annotations()
    types = {name: of for base in cls.__mro__ for name, of in spelt.get(base.__name__, {}).items()}
    return [(name, types[name]) for name in cls.__struct_fields__]


@cache
def _annotations() -> dict[str, dict[str, str]]:
    nodes = [
        node
        for module in sorted(Path(m.__file__).parent.glob("*.py"))
        for node in ast.parse(module.read_text()).body
    ]
    return {
        node.name: {
            field.target.id: _plain(ast.unparse(field.annotation))
            for field in node.body
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        }
        for node in nodes
        if isinstance(node, ast.ClassDef)
    }


def _plain(annotation: str) -> str:
    if annotation == "Robot":  # a name that the codec checks
        return "Name"
    return (
        annotation.partition(",")[0].removeprefix("Annotated[")
        if "Meta" in annotation
        else annotation
    )


def code_of(page: str, language: str) -> str:
    return page.partition(f"```{language}\n")[2].partition("```")[0]


@pytest.mark.parametrize("table", [channel_table, query_table, view_table, message_list])
def test_the_page_has_the_tables_of_the_code(table):
    assert table() in PAGE.read_text()


def test_the_page_has_the_common_fields_of_each_type():
    rows = re.findall(r"^\| ([A-Za-z]+) \| [^|]+ \| (`.+) \|$", PAGE.read_text(), re.MULTILINE)
    assert dict(rows) == fields_by_type()


def test_the_pages_program_reads_a_submap_from_a_live_team():
    program = code_of(PAGE.read_text(), "python")
    assert len(program.splitlines()) <= 20
    with router() as endpoint, ZenohBus("demo", endpoint) as bus:
        bus.publish(Outgoing(c.SUBMAP, "alpha", submap(0)))
        done = subprocess.run(
            [sys.executable, "-c", program, endpoint, "demo"],
            capture_output=True, text=True, timeout=60, cwd="/",
        )  # fmt: skip
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "alpha submap 0 at 0.001 s, counter 0: 2 landmarks [0 1]",
        "end pose [0.    0.125 0.25 ], its sigmas [1.581 1.581 1.581]",
    ]


def test_the_pages_example_bytes_are_those_of_the_code():
    said = {"robot": "alpha", "number": 2, "forward": 0.25, "yaw_rate": -0.125}
    driven = build.odometry(stamp_ns=1_000, duration_ns=100_000_000, **said)
    assert encoded(driven).hex(" ") in PAGE.read_text().replace("\n", " ")


if __name__ == "__main__":
    for table in (channel_table, query_table, message_list, view_table):
        sys.stdout.write(f"{table()}\n\n")
