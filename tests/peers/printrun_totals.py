"""What Printrun's gcoder finds in a file; runs in Printrun's own environment."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from printrun import gcoder

found = gcoder.GCode(Path(sys.argv[1]).read_text(errors="replace").split("\n"))
box = [found.xmin, found.ymin, found.xmax, found.ymax]
print(json.dumps({"filament_mm": found.filament_length, "box_mm": box}))
