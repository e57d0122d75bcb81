"""Small wrong changes of a source, each of which the tests of its module should notice.

A mutant changes one operator, comparison, number, truth value, condition or statement inside a
function, or a number that a module names. No line is added or taken away, so that every other
function keeps its place. Not touched: annotations, decorators, defaults, texts, what is raised.
"""

import ast
from collections.abc import Iterator
from typing import NamedTuple

ARITHMETIC = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Pow: ("**", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
}
COMPARISONS = {
    ast.Lt: ("<", "<=", ">="),
    ast.LtE: ("<=", "<", ">"),
    ast.Gt: (">", ">=", "<="),
    ast.GtE: (">=", ">", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}
NAMES = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "argmin": "argmax",
    "argmax": "argmin",
    "any": "all",
    "all": "any",
    "sin": "cos",
    "cos": "sin",
    "floor": "ceil",
    "zeros": "ones",
    "ones": "zeros",
}
REMOVABLE = (ast.Expr, ast.AugAssign, ast.Continue, ast.Break)


class Mutant(NamedTuple):
    """source[begin:end] becomes `new`, in bytes; where: the function, or the constant's name."""

    line: int
    where: str
    begin: int
    end: int
    old: str
    new: str

    def applied(self, source: bytes) -> bytes:
        """The changed source."""
        return source[: self.begin] + self.new.encode() + source[self.end :]

    def __str__(self) -> str:
        first = " ".join(self.old.split())
        return f"{self.line} {self.where}: {first[:60]!r} -> {self.new.strip()!r}"


def mutants(source: bytes) -> list[Mutant]:
    """All mutants of a module, in the order of its text."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    found = _Finder(source, starts)
    for node in ast.parse(source).body:
        found.statement(node, "")
    return sorted(set(found.mutants), key=lambda each: (each.begin, each.end, each.new))


def another(value: object) -> str | None:
    """Another truth value or number than this; None for what is neither."""
    if isinstance(value, bool):
        return str(not value)
    if isinstance(value, int):
        return str(value + 1)
    if isinstance(value, float):
        return repr(2.0 * value if value else 1.0)
    return None


class _Finder:
    def __init__(self, source: bytes, starts: list[int]) -> None:
        self._source = source
        self._starts = starts
        self.mutants: list[Mutant] = []

    def statement(self, node: ast.stmt, outer: str) -> None:
        """Functions of a module and of its classes; numbers that a module names."""
        if isinstance(node, ast.FunctionDef):
            self._body(node.body, f"{outer}{node.name}")
        elif isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef):
                    self.statement(inner, f"{outer}{node.name}.")
        elif not outer and isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if isinstance(node.value, ast.Constant) and (new := another(node.value.value)):
                self._change(node.value, new, name)

    def _body(self, body: list[ast.stmt], where: str) -> None:
        for node in body:
            documents = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
            if documents or isinstance(node, ast.Raise | ast.Import | ast.ImportFrom):
                continue
            if isinstance(node, REMOVABLE):
                lines = (node.end_lineno or node.lineno) - node.lineno
                self._change(node, "pass" + "\n" * lines, where)
            self._visit(node, where)

    def _visit(self, node: ast.AST, where: str) -> None:
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "args") and not isinstance(
                node, ast.Call
            ):
                continue
            if name in ("body", "orelse", "finalbody") and isinstance(value, list):
                self._body(value, where)
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr | ast.Raise):
                    self._visit(child, where)
        for change in self._changes(node):
            self.mutants.append(change._replace(where=where))

    def _changes(self, node: ast.AST) -> Iterator[Mutant]:
        match node:
            case ast.BinOp() if type(node.op) in ARITHMETIC:
                yield from self._between(node.left, node.right, *ARITHMETIC[type(node.op)])
            case ast.AugAssign() if type(node.op) in ARITHMETIC:
                old, new = ARITHMETIC[type(node.op)]
                yield from self._between(node.target, node.value, f"{old}=", f"{new}=")
            case ast.Compare():
                before = node.left
                for operator, after in zip(node.ops, node.comparators, strict=True):
                    yield from self._between(before, after, *COMPARISONS[type(operator)])
                    before = after
            case ast.BoolOp():
                old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
                for before, after in zip(node.values, node.values[1:], strict=False):
                    yield from self._between(before, after, old, new)
            case ast.Call(func=ast.Name(id=name)) if name in NAMES:
                yield self._at(node.func, NAMES[name])
            case ast.Call(func=ast.Attribute(attr=name)) if name in NAMES:
                owner = self._text(node.func.value)
                yield self._at(node.func, f"{owner}.{NAMES[name]}")
            case _:
                yield from self._further_changes(node)

    def _further_changes(self, node: ast.AST) -> Iterator[Mutant]:
        match node:
            case ast.UnaryOp(op=ast.Not()):
                yield self._prefix(node, node.operand, "")
            case ast.UnaryOp(op=ast.USub()):
                yield self._prefix(node, node.operand, "+")
            case ast.If(test=test) | ast.While(test=test) if not isinstance(
                test, ast.Compare | ast.UnaryOp
            ):
                yield self._at(test, f"not ({self._text(test)})")
            case ast.Constant(value=value) if (new := another(value)) is not None:
                yield self._at(node, new)

    def _change(self, node: ast.expr | ast.stmt, new: str, where: str) -> None:
        self.mutants.append(self._at(node, new)._replace(where=where))

    def _at(self, node: ast.expr | ast.stmt, new: str) -> Mutant:
        begin, end = self._span(node)
        old = self._source[begin:end].decode()
        return Mutant(node.lineno, "", begin, end, old, new)

    def _prefix(self, node: ast.UnaryOp, operand: ast.expr, new: str) -> Mutant:
        begin, end = self._span(node)[0], self._span(operand)[0]
        old = self._source[begin:end].decode()
        rest = old.removeprefix("not ") if old.startswith("not") else old[1:]
        return Mutant(node.lineno, "", begin, end, old, new + rest)

    def _between(
        self, before: ast.expr, after: ast.expr, old: str, *others: str
    ) -> Iterator[Mutant]:
        begin, end = self._span(before)[1], self._span(after)[0]
        at = self._source.find(old.encode(), begin, end)
        if at >= 0:
            line = (before.end_lineno or before.lineno) + self._source.count(b"\n", begin, at)
            for new in others:
                yield Mutant(line, "", at, at + len(old.encode()), old, new)

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        begin = self._starts[node.lineno - 1] + node.col_offset
        end = self._starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        return begin, end

    def _text(self, node: ast.expr) -> str:
        begin, end = self._span(node)
        return self._source[begin:end].decode()
