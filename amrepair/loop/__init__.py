"""The closed loop over a job's layers: print, stop, scan, repair, scan again, go on.

`run` is the loop, `decide` its table of decisions, `tape` what it remembers, `replay` the same
run looked at again. It knows ports only, and draws nothing.
"""

from __future__ import annotations

from amrepair.loop.decide import Action, Decision
from amrepair.loop.locate import locate_part
from amrepair.loop.looks import LEFT_RATIO, Look, LoopReport, Stop, left_well, plan_stops
from amrepair.loop.run import MAX_ITERATIONS, run_loop
from amrepair.loop.tape import Tape

__all__ = [
    "LEFT_RATIO",
    "MAX_ITERATIONS",
    "Action",
    "Decision",
    "Look",
    "LoopReport",
    "Stop",
    "Tape",
    "left_well",
    "locate_part",
    "plan_stops",
    "run_loop",
]
