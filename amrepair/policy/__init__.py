"""Policy: what is worth a repair, in which order, when to ask, and when to give up.

Frozen rules with their reasons, and pure functions on results: nothing here measures, prints, asks
or reads a file. A recorded run is judged again by this room alone (`policy.replay`).
"""

from amrepair.policy.options import USUAL_POLICY, PolicyOptions
from amrepair.policy.table import Action, Decision, decide, gravest, judge

__all__ = ["USUAL_POLICY", "Action", "Decision", "PolicyOptions", "decide", "gravest", "judge"]
