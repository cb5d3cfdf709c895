"""Draws of a dear test: one or two that every run makes, and further ones that are slow."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def draws(all_of_them: Iterable[Any], *each_run: Any) -> list[Any]:
    """All values for `parametrize`, in their order; those not in `each_run` are marked slow."""
    values = list(all_of_them)
    assert each_run
    assert all(value in values for value in each_run)
    return [
        value
        if value in each_run
        else pytest.param(*(value if type(value) is tuple else (value,)), marks=pytest.mark.slow)
        for value in values
    ]
