"""An outside judge of repairs: it shares no code with the packages that it judges.

It knows the G-code text, the mesh that stands on the bed, the mesh that is wanted, and its own tool
head. It lays the beads voxel by voxel and says what was filled, what fell beside it, and what the
head ran into.
"""

from tests.judge.head import HEADS, MK3S_HEAD, HeadSlice, reachable
from tests.judge.judge import Verdict, cone_contact_mm, judge
from tests.judge.text import Steps, read_steps
from tests.judge.voxels import Voxels, occupancy

__all__ = [
    "HEADS",
    "MK3S_HEAD",
    "HeadSlice",
    "Steps",
    "Verdict",
    "Voxels",
    "cone_contact_mm",
    "judge",
    "occupancy",
    "reachable",
    "read_steps",
]
