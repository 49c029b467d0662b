"""Every small mistake that could be made in the gate, one at a time, against the gate's tests.

``python -m tests.services.robot.gate_mutants`` makes all mutants of ``services/robot/gate.py``, runs
``test_gate.py`` against each up to the first failing test, and prints as JSON what became of them. Only the tests with
fixed examples take part: chance must not decide whether a mistake is noticed.
"""

from __future__ import annotations

import ast
import copy
import json
import sys
import types
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

from services.robot import gate
from tests.services.robot.mutation import mutations_of

SOURCE = Path(gate.__file__)
TESTS = Path(__file__).with_name("test_gate.py")


@dataclass(frozen=True)
class Mutant:
    """The gate with one mistake.

    Attributes
    ----------
    name
        Where it is, what stood there and what stands there now; the same in every run.
    tree
        The whole module.
    """

    name: str
    tree: ast.Module


def mutants(source: str) -> Iterator[Mutant]:
    """Make every mutant of a module, each once."""
    tree = ast.parse(source)
    seen = {ast.unparse(tree)}
    names: Counter[str] = Counter()
    places = [node for node, _ in _walk(tree, "")]
    for at, (original, where) in enumerate(_walk(tree, "")):
        for number in range(len(mutations_of(places[at]))):
            mutated = copy.deepcopy(tree)
            node, parent = _with_parent(mutated, at)
            replacement = mutations_of(node)[number]
            _replace(parent, node, replacement)
            text = ast.unparse(ast.fix_missing_locations(mutated))
            if text not in seen:
                seen.add(text)
                name = f"{where}: {_short(original)} -> {_short(replacement)}"
                names[name] += 1
                yield Mutant(name if names[name] == 1 else f"{name} ({names[name]})", mutated)


def _walk(node: ast.AST, where: str) -> Iterator[tuple[ast.AST, str]]:
    """Give all nodes that do something when the program runs, depth first, with the function that they are in."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        where = f"{where}.{node.name}".lstrip(".")
    yield node, where or "module"
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not _is_docstring(child) and not _names_type(child):
                yield from _walk(child, where)


def _is_type(node: ast.AST) -> bool:
    return isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) and node.value.id == "Literal"


def _names_type(node: ast.AST) -> bool:
    return isinstance(node, ast.Assign) and _is_type(node.value)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _with_parent(tree: ast.Module, at: int) -> tuple[ast.AST, ast.AST]:
    node = [node for node, _ in _walk(tree, "")][at]
    parent = next(p for p in ast.walk(tree) if any(child is node for child in ast.iter_child_nodes(p)))
    return node, parent


def _replace(parent: ast.AST, node: ast.AST, replacement: ast.AST) -> None:
    for field, value in ast.iter_fields(parent):
        if value is node:
            setattr(parent, field, replacement)
        elif isinstance(value, list):
            setattr(parent, field, [replacement if item is node else item for item in value])


def _short(node: ast.AST) -> str:
    return " ".join(ast.unparse(node).split())[:110]


class Trial:
    """A plugin of pytest: in place of one run of the tests, a run for every mutant."""

    def __init__(self) -> None:
        self.survivors: list[str] = []
        self.killed = 0

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        (test_module,) = {item.getparent(pytest.Module).obj for item in session.items}
        source = SOURCE.read_text()
        if not self._passes(session, test_module, ast.parse(source)):
            raise pytest.UsageError("the tests fail with the gate as it is")
        for mutant in mutants(source):
            if self._passes(session, test_module, mutant.tree):
                self.survivors.append(mutant.name)
            else:
                self.killed += 1
        return True

    def _passes(self, session: pytest.Session, test_module: types.ModuleType, tree: ast.Module) -> bool:
        """Whether every test passes with this gate.

        Both modules are executed anew in place: the collected tests look names up in them, so nothing is collected
        again (what stands in a ``parametrize`` must not come from the gate, therefore).
        """
        mutant, tests = compile(tree, str(SOURCE), "exec"), compile(TESTS.read_text(), str(TESTS), "exec")
        for name in [name for name in vars(gate) if not name.startswith("__")]:
            delattr(gate, name)
        try:
            exec(mutant, vars(gate))  # noqa: S102
            exec(tests, vars(test_module))  # noqa: S102
        except Exception:  # noqa: BLE001 - a gate that cannot be imported is noticed
            return False
        return all(report.passed for item in session.items for report in runtestprotocol(item, log=False))


def main() -> int:
    """Try all mutants; print how many were killed and the names of those that were not."""
    # Some mutants are odd Python (`x is not 0`).
    warnings.simplefilter("ignore", SyntaxWarning)
    trial = Trial()
    flags = ["--import-mode=importlib", "-qq", "--tb=no", "--no-summary", "-pno:cacheprovider", "-pno:logging"]
    status = pytest.main([*flags, "--override-ini=addopts=", "-k", "not Machine", str(TESTS)], plugins=[trial])
    sys.stdout.write(json.dumps({"killed": trial.killed, "survivors": trial.survivors}) + "\n")
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
