"""What the campaign `mutants` changes: one comparison, operator, sign, condition, number or value at a time."""

import ast
import copy
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

SWAPS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.Pow: (ast.Mult,),
    ast.RShift: (ast.LShift,),
    ast.LShift: (ast.RShift,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
}
CALLS = {"max": "min", "min": "max", "ceil": "floor", "floor": "ceil", "round": "int", "int": "round"}


def edits(node: ast.AST) -> Iterator[tuple[str, Callable[[ast.AST], ast.AST]]]:
    """What can be changed in one node: description and the change, which returns the node or another in its place."""

    def put(field: str, value: object) -> Callable[[ast.AST], ast.AST]:
        def change(target: ast.AST) -> ast.AST:
            setattr(target, field, value)
            return target

        return change

    if isinstance(node, ast.Compare):
        for place, op in enumerate(node.ops):
            for other in SWAPS.get(type(op), ()):
                ops = [*node.ops[:place], other(), *node.ops[place + 1 :]]
                yield f"{type(op).__name__} becomes {other.__name__}", put("ops", ops)
    elif isinstance(node, ast.BinOp | ast.BoolOp):
        for other in SWAPS.get(type(node.op), ()):
            yield f"{type(node.op).__name__} becomes {other.__name__}", put("op", other())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield f"{type(node.op).__name__} left out", lambda target: target.operand  # type: ignore[attr-defined]
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        yield f"{node.value} becomes {node.value + 1}", put("value", node.value + 1)
    elif isinstance(node, ast.Constant) and node.value == "":
        yield "empty text becomes another", put("value", "mutant")
    elif isinstance(node, ast.Call):
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        if name in CALLS:
            field = "id" if isinstance(node.func, ast.Name) else "attr"
            yield f"{name} becomes {CALLS[name]}", lambda t: setattr(t.func, field, CALLS[name]) or t  # type: ignore[attr-defined,func-returns-value]
        if name == "abs":
            yield "abs left out", lambda target: target.args[0]  # type: ignore[attr-defined]
    elif isinstance(node, ast.If | ast.IfExp):
        yield "condition negated", put("test", ast.UnaryOp(ast.Not(), node.test))
        yield "condition always true", put("test", ast.Constant(True))
        yield "condition always false", put("test", ast.Constant(False))
    elif isinstance(node, ast.Return) and node.value is not None:
        yield "returns None", put("value", ast.Constant(None))
    elif isinstance(node, ast.Assign):
        yield "assigns None", put("value", ast.Constant(None))


class Changed(ast.NodeTransformer):
    """Puts one change at one place."""

    def __init__(self, place: int, change: Callable[[ast.AST], ast.AST]) -> None:
        self.place, self.change, self.at = place, change, -1

    def visit(self, node: ast.AST) -> ast.AST:
        """Count nodes in the order of visit; change the one."""
        self.at += 1
        if self.at == self.place:
            self.at += 10**6
            return self.change(node)
        return _visit_but_annotations(self, node)


def _visit_but_annotations(visitor: ast.NodeTransformer, node: ast.AST) -> ast.AST:
    """Visit what a node consists of, without its annotation."""
    kept = {
        field: getattr(node, field) for field in ("annotation", "returns") if getattr(node, field, None) is not None
    }
    for field in kept:
        setattr(node, field, None)
    visitor.generic_visit(node)
    for field, value in kept.items():
        setattr(node, field, value)
    return node


def ordered(tree: ast.AST) -> list[ast.AST]:
    """Nodes in the order in which Changed visits them."""
    seen: list[ast.AST] = []

    class Seen(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            seen.append(node)
            return _visit_but_annotations(self, node)

    Seen().visit(copy.deepcopy(tree))
    return seen


class Mutant(NamedTuple):
    """A change of one module."""

    what: str
    """Where, and which."""
    source: Callable[[], str | None]
    """Makes the module's source with it; None where nothing but the way of writing would change."""
    lines: range
    """Of the statement that it is in, a compound one's head."""


def mutants(path: Path) -> Iterator[Mutant]:
    """Every mutant of a module; docstrings and annotations stay."""
    text = path.read_text(encoding="utf-8")
    tree, lines = ast.parse(text), text.splitlines()
    statements = [_lines_of(node) for node in ast.walk(tree) if isinstance(node, ast.stmt)]
    original = ast.unparse(tree)

    def made(place: int, change: Callable[[ast.AST], ast.AST]) -> str | None:
        source = ast.unparse(ast.fix_missing_locations(Changed(place, change).visit(copy.deepcopy(tree))))
        return None if source == original else source

    for place, node in enumerate(ordered(tree)):
        for what, change in edits(node):
            line = getattr(node, "lineno", 0)
            around = [each for each in statements if line in each] or [range(line, line + 1)]
            said = f"{path.name}:{line}: {lines[line - 1].strip()!r}: {what}"
            yield Mutant(said, functools.partial(made, place, change), min(around, key=len))


def _lines_of(statement: ast.stmt) -> range:
    body = getattr(statement, "body", None)
    end = body[0].lineno if isinstance(body, list) and body else (statement.end_lineno or statement.lineno) + 1
    return range(statement.lineno, max(end, statement.lineno + 1))
