"""Arrays are held to the shapes that annotations name, wherever a test calls the code.

What `jaxtyping.install_import_hook` does to every function is done here to those functions alone
that name a shape, once a module is loaded: what is left needs mypy and no call at run time.
"""

from __future__ import annotations

import functools
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, FunctionType, ModuleType
from typing import Any

from beartype import beartype
from jaxtyping import jaxtyped

# What is called thousands of times is called from few places: a fifth of some tests was checks.
# From each place so many calls are all checked, and one in so many after them.
ALL_CHECKED = 5
checked_every = 16


def install(packages: Sequence[str]) -> None:
    """Check shapes in all modules of `packages` that are loaded from now on.

    Kernels are left out: numba compiles them and asks for types itself.
    """
    sys.meta_path.insert(0, _Finder(tuple(packages)))


class _Finder:
    def __init__(self, packages: tuple[str, ...]) -> None:
        self._packages = packages

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name.partition(".")[0] not in self._packages or name.endswith("_kernels"):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and type(spec.loader) is SourceFileLoader:
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        _check(module, module)


def _check(owner: ModuleType | type, module: ModuleType) -> None:
    """Put checks around the functions, methods and records that `module` itself defines."""
    for name, value in list(vars(owner).items()):
        if isinstance(value, type):
            if value.__module__ == module.__name__ and value is not owner:
                _check(value, module)
        elif isinstance(value, classmethod | staticmethod):
            if shapes := _shapes(value.__func__, module):
                setattr(owner, name, type(value)(_checked(value.__func__, shapes)))
        elif isinstance(value, property):
            if shapes := _shapes(value.fget, module):
                checked = property(_checked(value.fget, shapes), value.fset, value.fdel)
                setattr(owner, name, checked)
        elif isinstance(value, functools.cached_property):
            if shapes := _shapes(value.func, module):
                value.func = _checked(value.func, shapes)
        elif shapes := _shapes(value, module):
            setattr(owner, name, _checked(value, shapes))


def _shapes(function: object, module: ModuleType) -> dict[str, object]:
    """The annotations of `function` that name a shape, evaluated; none for what is not ours."""
    if not isinstance(function, FunctionType) or hasattr(function, "__wrapped__"):
        return {}
    if function.__module__ != module.__name__ or inspect.isgeneratorfunction(function):
        return {}
    known = vars(module)
    return {
        name: eval(said, known)
        for name, said in function.__annotations__.items()
        if any("jaxtyping." in repr(known.get(word)) for word in re.findall(r"\w+", str(said)))
    }


def _asked(function: FunctionType, shapes: dict[str, object]) -> FunctionType:
    """The function with checks of these annotations, and of no others."""
    all_said = function.__annotations__
    function.__annotations__ = shapes
    try:
        return beartype(function)
    finally:
        function.__annotations__ = all_said


def _checked(function: FunctionType, shapes: dict[str, object]) -> Callable[..., Any]:
    calls: dict[tuple[CodeType, int], int] = {}
    # not before the first call: most of what a worker loads it never calls
    checking = functools.cache(functools.partial(_asked, function, shapes))

    @functools.wraps(function)
    def call(*values: Any, **named: Any) -> Any:
        caller = sys._getframe(1)
        place = (caller.f_code, caller.f_lasti)
        call_index = calls[place] = calls.get(place, -1) + 1
        if call_index >= ALL_CHECKED and call_index % checked_every:
            return function(*values, **named)
        with jaxtyped("context"):  # one n, one m … for all that this call names
            return checking()(*values, **named)

    return call
