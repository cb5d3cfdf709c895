"""The closed loop over a job's layers: print, stop, scan, repair, scan again, go on.

`run` is the loop, `amrepair.policy` decides in it, `tape` what it remembers, `replay` the same
run looked at again. It knows ports only, and draws nothing.
"""

from __future__ import annotations

from amrepair.loop.locate import locate_part
from amrepair.loop.looks import Look, LoopReport, Stop, plan_stops
from amrepair.loop.options import Approval, LoopOptions, Records
from amrepair.loop.run import run_loop
from amrepair.loop.tape import Tape
from amrepair.policy import Action, Decision

__all__ = [
    "Action",
    "Approval",
    "Decision",
    "Look",
    "LoopOptions",
    "LoopReport",
    "Records",
    "Stop",
    "Tape",
    "locate_part",
    "plan_stops",
    "run_loop",
]
