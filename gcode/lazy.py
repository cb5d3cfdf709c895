"""Names at the top of a package that are loaded when first used (PEP 562)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(
    namespace: dict[str, Any], homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """A package's `__getattr__` and `__dir__`.

    Parameters
    ----------
    namespace
        The package's `globals()`; a name that was used once stays there.
    homes
        Modules, and what is imported from each, in the words of an import.
    """
    where = {}
    for module, names in homes.items():
        for name in names.split(", "):
            attribute, _, alias = name.partition(" as ")
            where[alias or attribute] = module, attribute

    def getattr_(name: str) -> Any:
        if name not in where:
            raise AttributeError(f"module {namespace['__name__']!r} has no attribute {name!r}")
        module, attribute = where[name]
        found = getattr(import_module(module), attribute)
        namespace[name] = found
        return found

    def dir_() -> list[str]:
        return sorted({*namespace, *where})

    return getattr_, dir_
