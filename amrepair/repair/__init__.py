"""Repair: from one scan to a checked program that fills what is missing.

Begin reading at `pipeline.plan_repair`: it is the whole offline algorithm, with one call for each
stage. It moves no machine and writes no file; the loop sends the program, and the command line
writes it.
"""

from amrepair.repair.pipeline import plan_repair
from amrepair.repair.plan import RepairPlan
from amrepair.repair.site import Detector, Site
from amrepair.repair.stopwatch import Stopwatch

__all__ = ["Detector", "RepairPlan", "Site", "Stopwatch", "plan_repair"]
