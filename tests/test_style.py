"""Rules on the source that no linter has."""

import ast
import subprocess
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("smal", "schemas", "services", "tests", "deploy")


def _sources() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "--", *FOLDERS], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in listed.stdout.splitlines() if name.endswith(".py")]


@cache
def _trees() -> dict[str, ast.Module]:
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text()) for path in _sources()}


def _packed(tree: ast.Module) -> list[int]:
    """List the lines that assign several values at once, except where values change places."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
        and {*map(ast.unparse, node.targets[0].elts)} != {*map(ast.unparse, node.value.elts)}
    ]


@pytest.mark.parametrize(
    ("source", "lines"),
    [("a, b = b, a", []), ("a, b = pair", []), ("a = 1\nb, c = 2, 3", [2]), ("a, b = b, 1", [1])],
)
def test_packed_assignment_is_found(source: str, lines: list[int]) -> None:
    assert _packed(ast.parse(source)) == lines


def test_no_assignment_packs_values() -> None:
    assert [f"{path}:{line}" for path, tree in _trees().items() for line in _packed(tree)] == []


def test_no_public_class_name_stands_twice() -> None:
    names = Counter(
        node.name
        for path, tree in _trees().items()
        if path.startswith(("smal/", "schemas/", "services/"))
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []
