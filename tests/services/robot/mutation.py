"""The mistakes that are made in a piece of Python: what else could stand in the place of a node of its syntax tree.

Comparisons: another operator, the boundary among them. ``and`` and ``or``: swapped, and each operand left out. ``not``
and signs: left out. Numbers: one more, one less, zero; truth values and None: turned round; texts: another, none.
Arithmetic: the opposite operation. Conditions: always, never; an ``else`` in place of its ``if``. Filters of
comprehensions: none, nothing passes. Returned values: None, and something in place of None. Statements, decorators,
keyword arguments: left out. ``min`` and ``max``: swapped. Arguments and elements of tuples: two neighbours swapped.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Callable
from typing import Any, Final

_COMPARISONS: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.GtE, ast.Eq),
    ast.LtE: (ast.Lt, ast.Gt, ast.Eq),
    ast.Gt: (ast.GtE, ast.LtE, ast.Eq),
    ast.GtE: (ast.Gt, ast.Lt, ast.Eq),
    ast.Eq: (ast.NotEq, ast.LtE, ast.GtE),
    ast.NotEq: (ast.Eq, ast.Lt, ast.Gt),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_OPERATIONS: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
_SWAPPED_NAMES: Final = {"min": "max", "max": "min"}


def mutations_of(node: ast.AST) -> list[ast.AST]:
    """Return what else could stand in the place of a node."""
    found = [mutation for kind, make in _MAKERS if isinstance(node, kind) for mutation in make(node)]
    if isinstance(node, ast.stmt) and not isinstance(node, ast.Import | ast.ImportFrom | ast.ClassDef | ast.Pass):
        found.append(ast.Pass())
    return found


def _with(node: Any, **fields: Any) -> Any:
    changed = copy.deepcopy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _without_each(items: list[Any]) -> list[list[Any]]:
    return [items[:at] + items[at + 1 :] for at in range(len(items))]


def _neighbours_swapped(items: list[Any]) -> list[list[Any]]:
    return [[*items[:at], items[at + 1], items[at], *items[at + 2 :]] for at in range(len(items) - 1)]


def _compare(node: ast.Compare) -> list[Any]:
    return [
        _with(node, ops=[*node.ops[:at], other(), *node.ops[at + 1 :]])
        for at, operator in enumerate(node.ops)
        for other in _COMPARISONS[type(operator)]
    ]


def _bool_op(node: ast.BoolOp) -> list[Any]:
    other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    rest = _without_each(node.values)
    return [_with(node, op=other), *(_with(node, values=values) if len(values) > 1 else values[0] for values in rest)]


def _constant(node: ast.Constant) -> list[Any]:
    value = node.value
    match value:
        case bool():
            others: list[Any] = [not value]
        case int() | float():
            others = [value + 1, value - 1, *([type(value)(0)] if value else [])]
        case str():
            others = [f"{value}x", *([""] if value else [])]
        case None:
            others = [0]
        case _:
            others = []
    return [_with(node, value=other) for other in others]


def _condition(node: ast.If | ast.IfExp) -> list[Any]:
    return [_with(node, test=ast.Constant(value)) for value in (True, False)]


def _comprehension(node: ast.comprehension) -> list[Any]:
    if not node.ifs:
        return []
    return [*(_with(node, ifs=ifs) for ifs in _without_each(node.ifs)), _with(node, ifs=[ast.Constant(False)])]


def _return(node: ast.Return) -> list[Any]:
    is_none = node.value is None or (isinstance(node.value, ast.Constant) and node.value.value is None)
    return [_with(node, value=ast.Constant("something" if is_none else None))]


def _call(node: ast.Call) -> list[Any]:
    found = [_with(node, keywords=keywords) for keywords in _without_each(node.keywords)]
    return found + [_with(node, args=args) for args in _neighbours_swapped(node.args)]


def _slice(node: ast.Slice) -> list[Any]:
    return [_with(node, **{end: None}) for end in ("lower", "upper") if getattr(node, end) is not None]


_MAKERS: Final[tuple[tuple[Any, Callable[[Any], list[Any]]], ...]] = (
    (ast.Compare, _compare),
    (ast.BoolOp, _bool_op),
    (ast.UnaryOp, lambda node: [node.operand]),
    (ast.Constant, _constant),
    (ast.BinOp, lambda node: [_with(node, op=_OPERATIONS[type(node.op)]())] if type(node.op) in _OPERATIONS else []),
    (ast.AugAssign, lambda node: [_with(node, op=_OPERATIONS[type(node.op)]())]),
    (ast.If | ast.IfExp, _condition),
    (ast.comprehension, _comprehension),
    (ast.Return, _return),
    (ast.Call, _call),
    (ast.Slice, _slice),
    (ast.Tuple, lambda node: [_with(node, elts=elements) for elements in _neighbours_swapped(node.elts)]),
    (ast.Name, lambda node: [_with(node, id=_SWAPPED_NAMES[node.id])] if node.id in _SWAPPED_NAMES else []),
    (
        ast.FunctionDef | ast.ClassDef,
        lambda node: [_with(node, decorator_list=rest) for rest in _without_each(node.decorator_list)],
    ),
)
