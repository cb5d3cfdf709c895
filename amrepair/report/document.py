"""`write_report`: one HTML file that holds everything it shows and asks nothing of the network."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

from plotly.offline import get_plotlyjs

from amrepair.errors import InputError
from amrepair.report.data import ReportData
from amrepair.report.page import body
from amrepair.report.payload import payload
from amrepair.report.tables import escape
from gcode.whole import write_bytes

# The browser itself refuses every request, whatever a library may try.
REPORT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; form-action 'none'; base-uri 'none'"
)


def render_report(data: ReportData) -> str:
    """The whole page as text; the same data give the same text."""
    values = json.dumps(payload(data), separators=(",", ":"), allow_nan=False, sort_keys=True)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{REPORT_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(data.title)} · repair report</title>"
        f"<style>{_asset('report.css')}</style></head>\n<body>{body(data)}\n"
        f"<script>{_inline(get_plotlyjs())}</script>\n"
        f'<script type="application/json" id="report-data">{_inline(values)}</script>\n'
        f"<script>{_asset('report.js')}</script>\n</body></html>\n"
    )


def write_report(data: ReportData, path: Path) -> None:
    """Write the page to `path`: whole or not at all.

    Raises
    ------
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> write_report(data, Path("report.html"))  # doctest: +SKIP
    """
    text = render_report(data)
    try:
        write_bytes(path, text.encode())
    except OSError as e:
        raise InputError(
            f"the report cannot be written to {path}: {e.strerror or e}; choose another folder"
        ) from e


def _asset(name: str) -> str:
    return (resources.files("amrepair.report") / "assets" / name).read_text(encoding="utf-8")


def _inline(text: str) -> str:
    """Text that cannot end the script element it stands in."""
    return text.replace("</script", "<\\/script").replace("<!--", "<\\!--")
