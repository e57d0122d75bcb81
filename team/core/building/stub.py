"""Write the type stub of the core, team/core/_core.pyi, from the built library.

    python team/core/building/stub.py

nanobind's own stub names the layout of every array; here an array is an `NDArray` of its type, and
its shape is in the docstring.
"""

import re
import sys
from importlib import import_module
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1]
STUB, LIBRARY = FOLDER / "_core.pyi", "_core_base"
ARRAY = re.compile(r"Annotated\[(NDArray\[numpy\.\w+\]), dict\([^\[\]]*?\)\]")

VALUE = re.compile(r"^(\w+: .*?) = .*$", re.M)


def made_stub() -> str:
    """Make the stub's text of the library in this tree."""
    from nanobind.stubgen import StubGen

    sys.path.insert(0, str(FOLDER))
    made = StubGen(module=import_module(LIBRARY), quiet=True)
    made.put(made.module)
    sys.path.remove(str(FOLDER))
    text = ARRAY.sub(r"\1", made.get()).replace("import Annotated, ", "import ")
    return VALUE.sub(r"\1", text).replace(": tuple\n", ": tuple[float, ...]\n")


if __name__ == "__main__":
    STUB.write_text(made_stub(), "utf-8")
