"""Repair: from one scan to a checked program that fills what is missing.

`pipeline.plan_repair` is the whole offline algorithm, a call per stage. It moves nothing and writes
no file: the loop sends what it makes, the command line writes it.
"""

from amrepair.repair.pipeline import plan_repair
from amrepair.repair.plan import RepairPlan
from amrepair.repair.site import Detector, Site
from amrepair.repair.stopwatch import Stopwatch

__all__ = ["Detector", "RepairPlan", "Site", "Stopwatch", "plan_repair"]
