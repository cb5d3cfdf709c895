"""A plugin of OctoPrint for tests: beads of the job that lie in a box come to nothing, unnoticed.

`BOX` is six numbers, mm; whoever installs it fills them in.
"""

import math
import re

BOX = ()
STEP_MM = 1.0  # a bead is cut into pieces so long, each laid or not
WORD = re.compile(r"([XYZEF])(-?[\d.]+)")
at = {"X": 0.0, "Y": 0.0, "Z": 0.0}


def clog(comm, phase, cmd, cmd_type, gcode, *args, tags=None, **kwargs):
    if "source:file" not in (tags or ()) or gcode not in ("G0", "G1"):
        return None
    words = {name: float(value) for name, value in WORD.findall(cmd)}
    start = dict(at)
    at.update({name: words[name] for name in "XYZ" if name in words})
    length = math.hypot(at["X"] - start["X"], at["Y"] - start["Y"])
    if words.get("E", 0.0) <= 0.0 or not length or not BOX[2] <= at["Z"] <= BOX[5]:
        return None
    steps = max(1, round(length / STEP_MM))
    found = [f"G1 F{words['F']:g}"] if "F" in words else []
    for k in range(1, steps + 1):
        x, y = (start[n] + (at[n] - start[n]) * k / steps for n in "XY")
        lost = BOX[0] <= x <= BOX[3] and BOX[1] <= y <= BOX[4]
        found.append(f"G1 X{x:.4f} Y{y:.4f}" + ("" if lost else f" E{words['E'] / steps:.6f}"))
    return found


__plugin_name__ = "clogged"
__plugin_pythoncompat__ = ">=3.7,<4"
__plugin_hooks__ = {"octoprint.comm.protocol.gcode.queuing": clog}
