"""Where a slicer's dialog takes a post-processing script, drawn, not photographed.

Run: `python docs/dialogs.py`; it writes `docs/images/dialog-*.svg`. Names of tabs, pages and fields
are those of the slicers' own sources (`TabPrint::build` in `Tab.cpp` of PrusaSlicer, OrcaSlicer).
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

IMAGES = Path(__file__).parent / "images"
WIDE, ROW, LEFT = 760, 34, 200
INK, PAPER, LINE, CHOSEN, POINTED = "#282c34", "#fafaf8", "#b0b2b6", "#dbe8fb", "#e07814"
SCRIPT = "/home/me/.local/bin/amrepair postprocess --every 20"


@dataclass(frozen=True)
class Dialog:
    """One dialog: its tabs, the pages of the chosen tab, and the groups of the chosen page.

    Attributes
    ----------
    tabs, pages
        Names; the chosen one is named again in `tab` and `page`.
    groups
        Titles of the page's groups, above each other; the field is in the last.
    mode
        What the dialog must be switched to, for the field to be there.
    """

    title: str
    tabs: tuple[str, ...]
    tab: str
    pages: tuple[str, ...]
    page: str
    groups: tuple[str, ...]
    mode: str


DIALOGS = {
    "prusaslicer": Dialog(
        "PrusaSlicer",
        ("Plater", "Print Settings", "Filaments", "Printers"),
        "Print Settings",
        ("Layers and perimeters", "Infill", "Skirt and brim", "Support material", "Speed",
         "Multiple Extruders", "Advanced", "Output options", "Notes"),
        "Output options",
        ("Sequential printing", "Output file", "Other", "Post-processing scripts"),
        "Expert",
    ),
    "orcaslicer": Dialog(
        "OrcaSlicer, Bambu Studio, Creality Print",
        ("Quality", "Strength", "Speed", "Support", "Others"),
        "Others",
        (),
        "",
        ("Special mode", "G-code output", "Post-processing Scripts"),
        "Advanced",
    ),
}  # fmt: skip


def drawn(dialog: Dialog) -> str:
    """The dialog as SVG."""
    shapes: list[str] = []

    def box(x: float, y: float, wide: float, high: float, fill: str, line: str = LINE) -> None:
        shapes.append(
            f'<rect x="{x}" y="{y}" width="{wide}" height="{high}" rx="4" fill="{fill}" '
            f'stroke="{line}"/>'
        )

    def text(x: float, y: float, said: str, extra: str = "") -> None:
        shapes.append(f'<text x="{x}" y="{y}" {extra}>{escape(said)}</text>')

    text(16, 26, dialog.title, 'font-weight="bold"')
    text(WIDE - 16, 26, f"mode: {dialog.mode}", f'text-anchor="end" fill="{POINTED}"')
    x = 16.0
    for tab in dialog.tabs:
        wide = 24 + 8.2 * len(tab)
        box(x, 40, wide, ROW - 6, CHOSEN if tab == dialog.tab else PAPER)
        text(x + 12, 59, tab)
        x += wide + 6
    top = 84
    for row, page in enumerate(dialog.pages):
        if page == dialog.page:
            box(16, top + ROW * row, LEFT - 32, ROW - 6, CHOSEN)
        text(26, top + 19 + ROW * row, page)
    x = LEFT if dialog.pages else 16.0
    for row, group in enumerate(dialog.groups):
        last = row == len(dialog.groups) - 1
        y = top + 2 * ROW * row
        text(x, y + 19, group, 'font-weight="bold"')
        box(x, y + ROW - 6, WIDE - x - 16, ROW * (1.6 if last else 0.8), "white",
            POINTED if last else LINE)  # fmt: skip
        if last:
            text(x + 10, y + ROW + 20, SCRIPT, 'font-family="monospace"')
    high = top + max(ROW * len(dialog.pages), 2 * ROW * len(dialog.groups) + ROW) + 10
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE} {high}" font-size="15" '
        f'font-family="sans-serif" fill="{INK}">\n'
        f'<rect width="{WIDE}" height="{high}" fill="{PAPER}"/>\n'
        + "\n".join(shapes)
        + "\n</svg>\n"
    )


def main() -> None:
    """Write all of them."""
    for name, dialog in DIALOGS.items():
        (IMAGES / f"dialog-{name}.svg").write_text(drawn(dialog), encoding="utf-8")


if __name__ == "__main__":
    main()
