"""Prints in a row by one process leave no file, thread or child behind (`bench_day`)."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


def bench() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "bench_day.py"
    spec = importlib.util.spec_from_file_location("bench_day", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_day"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_three_prints_leave_nothing_behind() -> None:
    day = bench()
    rows = day.day(3)
    assert all(row["repairs"] >= 1 for row in rows)
    first, *_, last = rows
    assert [last[k] - first[k] for k in ("files", "threads", "children")] == [0, 0, 0]
