"""Policy: what is worth a repair, in which order, when to ask, and when to give up.

The room holds rules with their reasons, and pure functions on results; nothing here measures,
prints, asks or reads a file. That is why a recorded run can be decided again by this room alone
(`replay`). `table` has the decisions, `options` their numbers; `acceptance` says what is worth a
repair, `stopping_criteria` when to stop repairing, `limits` what may be printed unasked, and
`remedies` what can be done about a defect that was found too late.
"""

from amrepair.policy.options import DEFAULT_POLICY, PolicyOptions
from amrepair.policy.table import Action, Decision, decide, gravest, judge

__all__ = ["DEFAULT_POLICY", "Action", "Decision", "PolicyOptions", "decide", "gravest", "judge"]
