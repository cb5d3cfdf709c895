"""Batch: many scans of one part or of several, judged by many workers, each of them once.

A result is kept under the hash of what it follows from, so that a batch that was killed goes on
where it was. It judges no scan by itself: `align`, `regions` and `repair` do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gcode.lazy import lazy_names

if TYPE_CHECKING:
    from amrepair.batch.options import BatchKind, BatchOptions
    from amrepair.batch.run import BatchReport, run_batch

__all__ = ["BatchKind", "BatchOptions", "BatchReport", "run_batch"]

# Loaded when first used: a worker sets its threads before numpy is there.
_HOMES = {
    "amrepair.batch.options": "BatchKind, BatchOptions",
    "amrepair.batch.run": "BatchReport, run_batch",
}

__getattr__, __dir__ = lazy_names(globals(), _HOMES)
