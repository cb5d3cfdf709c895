"""What a newcomer may rely on: a name has one value, a function fits a page, a call a line."""

from __future__ import annotations

import ast
import functools
import gc
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINES, PARAMETERS, KERNEL_PARAMETERS, SAME_LINES = 60, 10, 14, 12
# Commands have a parameter an option. Every package that loads late has one table of that name.
COMMANDS, LOADED_LATE = ("amrepair/cli/", "gcode/cli/"), "HOMES"
# A table in the form of a function: a line each.
TABLES = {"amrepair/bench/tables.py": {"as_markdown"}}


@functools.cache
def modules() -> list[tuple[str, ast.Module]]:
    paths = [path for name in ("amrepair", "gcode") for path in sorted((ROOT / name).rglob("*.py"))]
    return [
        (str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))) for path in paths
    ]


@pytest.fixture(scope="module", autouse=True)
def _read_no_more() -> Iterator[None]:
    """A million nodes, which Python's collector of circles would look through time and again."""
    gc.disable()
    yield
    modules.cache_clear()
    shape.cache_clear()
    gc.enable()


def constants(module: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    """Names in capitals that a module sets, and those of a tuple."""
    for node in module.body:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            targets, value = [node.target], node.value
        elif isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        else:
            continue
        for target in targets:
            several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            pairs = zip(target.elts, value.elts, strict=True) if several else [(target, value)]
            for name, what in pairs:
                if isinstance(name, ast.Name) and name.id.lstrip("_").isupper():
                    yield name.id.lstrip("_"), what


def functions(module: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring."""
    count = (function.end_lineno or 0) - function.lineno + 1
    if ast.get_docstring(function) is not None:
        text = function.body[0]
        count -= (text.end_lineno or 0) - text.lineno + 1
    return count


def test_a_constant_s_name_has_one_value() -> None:
    found: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for path, module in modules():
        for name, value in constants(module):
            text = ast.unparse(value)
            if name != LOADED_LATE and "TypeVar" not in text and not text.endswith(f".{name}"):
                found[name][text].append(path)
    assert len(found) > 500
    assert {name: dict(values) for name, values in found.items() if len(values) > 1} == {}


def test_a_function_fits_a_page() -> None:
    too_long = [
        (path, function.name, code_lines(function))
        for path, module in modules()
        if not path.startswith(COMMANDS) and not path.endswith("_kernels.py")
        for function in functions(module)
        if code_lines(function) > LINES and function.name not in TABLES.get(path, ())
    ]
    assert too_long == []


@pytest.mark.parametrize(
    ("kernels", "most"), [(False, PARAMETERS), (True, KERNEL_PARAMETERS)], ids=["", "kernels"]
)
def test_a_call_fits_a_line(kernels: bool, most: int) -> None:
    too_many = []
    for path, module in modules():
        if path.startswith(COMMANDS) or path.endswith("_kernels.py") != kernels:
            continue
        for function in functions(module):
            given = function.args
            names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
            count = len(names) - (names[:1] in (["self"], ["cls"]))
            if count > most:
                too_many.append((path, function.name, count))
    assert too_many == []


def test_a_class_s_name_has_one_meaning() -> None:
    """Within a package; what two packages call alike is told apart by the import."""
    found: dict[tuple[str, str], list[str]] = defaultdict(list)
    for path, module in modules():
        for node in module.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[path.split("/")[0], node.name].append(path)
    assert {name: paths for name, paths in found.items() if len(paths) > 1} == {}


@functools.cache
def shape(node: object) -> object:
    """Code without its names, strings and numbers."""
    if isinstance(node, ast.Name | ast.arg):
        return type(node)
    if isinstance(node, ast.Constant):
        return type(node.value)
    if not isinstance(node, ast.AST):
        return node
    told = [value for name, value in ast.iter_fields(node) if name != "attr"]
    return type(node), *(
        tuple(map(shape, value)) if isinstance(value, list) else shape(value) for value in told
    )


def is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def runs(function: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[list[ast.stmt]]:
    """Statements one after the other, of so many lines, as short as may be."""
    for node in ast.walk(function):
        for part in ("body", "orelse", "finalbody"):
            found = getattr(node, part, None)
            block = [s for s in found if not is_text(s)] if isinstance(found, list) else []
            for first in range(len(block)):
                for last in range(first, len(block)):
                    lines = (block[last].end_lineno or 0) - block[first].lineno + 1
                    if lines >= SAME_LINES:
                        yield block[first : last + 1]
                        break


def test_nothing_is_written_twice() -> None:
    """No two places of functions have so many lines of the same shape."""
    found: dict[tuple[object, ...], set[str]] = defaultdict(set)
    for path, module in modules():
        for function in functions(module):
            for run in runs(function):
                found[tuple(map(shape, run))].add(f"{path}:{run[0].lineno}")
    assert len(found) > 1000
    assert [sorted(places) for places in found.values() if len(places) > 1] == []
