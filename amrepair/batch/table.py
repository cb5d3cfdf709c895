"""The table of a batch: a row for each scan, sorted by name, as CSV and Parquet.

It holds nothing that differs between two runs of the same batch: costs are kept beside it.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

from amrepair.batch.entries import Entry
from amrepair.batch.options import BatchKind

_FIRST_COLUMNS = ("name", "label", "time", "scan_id", "status", "sentence")
_POSE = ("template", "confidence", "rmse_mm", "inlier_ratio", "clutter_ratio",
         "symmetric_alternatives")  # fmt: skip
_FOUND = ("regions", "missing_mm3", "excess_mm3", "worst_label", "worst_type", "worst_mm3",
          "worst_depth_mm", "worst_x_mm", "worst_y_mm", "worst_z_mm", "object_score_mm",
          "threshold_mm", "sigma_mm")  # fmt: skip
_REPAIR_COLUMNS = ("within_tolerance", "unreachable_mm3", "filament_mm", "print_time_s", "gcode")
TABLE_COLUMNS = {
    BatchKind.ALIGN: (*_FIRST_COLUMNS, *_POSE, "template_from_scan"),
    BatchKind.DETECT: (*_FIRST_COLUMNS, *_POSE, *_FOUND),
    BatchKind.REPAIR: (*_FIRST_COLUMNS, *_POSE, *_FOUND, *_REPAIR_COLUMNS),
}
DONE, REFUSED = "ok", "refused"


def row_of(
    entry: Entry, scan_id: str, figures: Mapping[str, Any], sentence: str, gcode: str = ""
) -> dict[str, Any]:
    """One scan's row."""
    row: dict[str, Any] = {
        "name": entry.name,
        "label": entry.label,
        "time": entry.time,
        "scan_id": scan_id,
        "status": REFUSED if sentence else DONE,
        "sentence": sentence.replace("{scan}", entry.name),
        **figures,
        "gcode": gcode,
    }
    if "template_from_scan" in figures:
        row["template_from_scan"] = json.dumps(figures["template_from_scan"])
    if "regions" in figures:
        regions = figures["regions"]
        row["regions"] = len(regions)
        if regions:
            worst = max(regions, key=lambda one: (one["volume_mm3"], one["centre_mm"]))
            x, y, z = worst["centre_mm"]
            row |= {
                "worst_label": worst["label"], "worst_type": worst["type"],
                "worst_mm3": worst["volume_mm3"], "worst_depth_mm": worst["depth_mm"],
                "worst_x_mm": x, "worst_y_mm": y, "worst_z_mm": z,
            }  # fmt: skip
    return row


def as_csv(rows: Sequence[Mapping[str, Any]], kind: BatchKind) -> bytes:
    """With every digit that a figure has."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, TABLE_COLUMNS[kind], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue().encode()


def as_parquet(rows: Sequence[Mapping[str, Any]], kind: BatchKind) -> bytes | None:
    """The same as Parquet; None where pyarrow is not installed."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        return None
    columns = {name: [row.get(name) for row in rows] for name in TABLE_COLUMNS[kind]}
    schema = pa.schema([(name, _type(pa, name)) for name in TABLE_COLUMNS[kind]])
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.table(columns, schema=schema), sink)
    return bytes(sink.getvalue().to_pybytes())


def _type(pa: Any, name: str) -> Any:
    """Types by name, so that a column without any value has its own, too."""
    if name in {"regions", "symmetric_alternatives"}:
        return pa.int64()
    if name == "within_tolerance":
        return pa.bool_()
    if name.endswith(("_mm", "_mm3", "_ratio", "_s")) or name == "confidence":
        return pa.float64()
    return pa.string()
