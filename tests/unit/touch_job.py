"""A small solid job for the tests of touching: a block of 24 × 12 mm, solid but for one layer."""

from __future__ import annotations

import math

from gcode.moves import Program

WIDTH_MM, HEIGHT_MM, SPACING_MM = 0.45, 0.2, 0.4
X_MM, Y_MM = (80.0, 104.0), (90.0, 102.0)
SPARSE_LAYER = 3
LAYERS = 6
_E_PER_MM = SPACING_MM * HEIGHT_MM / (math.pi / 4 * 1.75**2)


def touch_job(dialect: str = "marlin") -> Program:
    """Lines along X, side by side; in the sparse layer every sixth of them."""
    lines = ["G28", "G90", "M83", "M190 S60", "M109 S205", "G92 E0"]
    for layer in range(LAYERS):
        z_mm = (layer + 1) * HEIGHT_MM
        lines += [";LAYER_CHANGE", f";Z:{z_mm:.2f}", f";HEIGHT:{HEIGHT_MM}", f"G1 Z{z_mm:.2f} F600"]
        lines += [";TYPE:Solid infill", f";WIDTH:{WIDTH_MM}"]
        step = 6 if layer == SPARSE_LAYER else 1
        for row in range(0, round((Y_MM[1] - Y_MM[0]) / SPACING_MM), step):
            y_mm = Y_MM[0] + (row + 0.5) * SPACING_MM
            first, last = X_MM if row % 2 == 0 else X_MM[::-1]
            e_mm = (X_MM[1] - X_MM[0]) * _E_PER_MM
            lines += [f"G1 X{first:.3f} Y{y_mm:.3f} F9000", f"G1 X{last:.3f} E{e_mm:.5f} F1800"]
    lines += ["G1 E-0.8 F2100", "G1 Z30 F600", "M104 S0", "M140 S0", "M84"]
    return Program("\n".join(lines) + "\n", dialect)
