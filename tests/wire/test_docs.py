"""docs/wire.md says what the code does: its tables are the code's, its program runs."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import msgspec

from team.wire import channels as c
from team.wire import messages as m
from team.wire import views as v
from team.wire.bus import Outgoing
from team.wire.codec import encoded
from team.wire.zenoh.bus import ZenohBus
from team.wire.zenoh.router import router
from tests.support import ROOT, submap

PAGE = ROOT / "docs" / "wire.md"


def channel_table() -> str:
    """The table of channels as Markdown; `python -m tests.wire.test_docs` prints it."""
    rows = ["| key | message | rate | delivery | recorded | meaning |", "|---|---|---|---|---|---|"]
    rows += [
        f"| `{channel.template}` | {_carried(channel)} | {channel.rate} | "
        f"{'query' if channel in c.QUERIES else channel.delivery} | "
        f"{'yes' if channel.recorded else 'no'} | {channel.meaning} |"
        for channel in c.CHANNELS
    ]
    return "\n".join(rows)


def _carried(channel: c.Channel) -> str:
    if channel is c.VIEW:
        return "see Views"
    return ", ".join(f"`{m.tag_of(each)}`" for each in channel.kinds)


def view_table() -> str:
    """The table of views as Markdown."""
    rows = ["| key | schema | rate | meaning |", "|---|---|---|---|"]
    for view in v.VIEWS:
        schema = view.schema if isinstance(view.schema, str) else f"teamslam.{view.schema.__name__}"
        rows.append(f"| `{view.template}` | `{schema}` | {view.rate} | {view.meaning} |")
    return "\n".join(rows)


def message_table() -> str:
    """Every message's fields by position, with the types that `team.wire.messages` spells."""
    spelt = _annotations()
    rows = ["| message | fields after the tag |", "|---|---|"]
    for tag, message in sorted(m.BY_TAG.items()):
        rows.append(f"| `{tag}` | {_fields(message, spelt)} |")
    parts = [cls for _, cls in inspect.getmembers(m, inspect.isclass) if _is_part(cls)]
    rows += [
        f"| *{part.__name__}* | {_fields(part, spelt)} |"
        for part in sorted(parts, key=lambda part: part.__name__)
    ]
    return "\n".join(rows)


def _is_part(cls: type) -> bool:
    return (
        issubclass(cls, msgspec.Struct)
        and cls.__module__.startswith(m.__name__)
        and not issubclass(cls, m.Message)
    )


def _fields(cls: type[msgspec.Struct], spelt: dict[str, dict[str, str]]) -> str:
    types = {name: of for base in cls.__mro__ for name, of in spelt.get(base.__name__, {}).items()}
    return ", ".join(f"{name}: {types[name]}" for name in cls.__struct_fields__)


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
    return (
        annotation.partition(",")[0].removeprefix("Annotated[")
        if "Meta" in annotation
        else annotation
    )


def code_of(page: str, language: str) -> str:
    return page.partition(f"```{language}\n")[2].partition("```")[0]


def test_the_page_has_the_table_of_channels() -> None:
    assert channel_table() in PAGE.read_text()


def test_the_page_has_the_table_of_views() -> None:
    assert view_table() in PAGE.read_text()


def test_the_page_has_the_fields_of_every_message() -> None:
    assert message_table() in PAGE.read_text()


def test_the_pages_program_reads_a_submap_from_a_live_team() -> None:
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


def test_the_pages_example_bytes_are_those_of_the_code() -> None:
    assert encoded(
        m.Odometry(
            stamp_ns=1_000,
            robot="alpha",
            incarnation=1,
            number=2,
            duration_ns=100_000_000,
            forward=0.25,
            yaw_rate=-0.125,
        )
    ).hex(" ") in (PAGE.read_text().replace("\n", " "))


if __name__ == "__main__":
    sys.stdout.write(f"{channel_table()}\n\n{message_table()}\n\n{view_table()}\n")
