"""Replay: a recorded decision is made again from its facts alone, perhaps by other options."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from amrepair.errors import InputError
from amrepair.policy.options import DEFAULT_POLICY, PolicyOptions
from amrepair.policy.table import Action, Cover, Decision, Finding, Situation, decide, judge
from amrepair.policy.table import gravest as gravest_of
from amrepair.regions.anomaly import DefectType

_MEANT: dict[str, type[DefectType] | type[Cover] | type[Action]] = {
    "type": DefectType, "cover": Cover, "gravest": Action,
}  # fmt: skip


def decided_again(recorded: Mapping[str, Any], options: PolicyOptions = DEFAULT_POLICY) -> Decision:
    """Decide again from the facts that a decision recorded (`Decision.to_json`).

    The facts stay as they were recorded, even those that were themselves derived by the options of
    that time: whether a pass was the last, or changed little.

    Raises
    ------
    InputError
        If the record lacks a fact.
    """
    try:
        findings = [_facts(Finding, said) for said in recorded["findings"]]
        situation = _facts(Situation, recorded["situation"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"a recorded decision cannot be made again ({error}); it was written by another version"
        ) from error
    verdicts = tuple(judge(finding, options) for finding in findings)
    return decide(verdicts, replace(situation, gravest=gravest_of(verdicts)), options)


def changed(options: PolicyOptions, rules: Sequence[str]) -> PolicyOptions:
    """The options with some numbers changed, each told as `name=value`.

    Raises
    ------
    InputError
        If there is no such number, or the value is none.
    """
    known = {field.name: getattr(options, field.name) for field in fields(options)}
    for rule in rules:
        name, _, value = rule.partition("=")
        if name not in known:
            raise InputError(f"there is no rule '{name}'; there are: {', '.join(sorted(known))}")
        try:
            number = type(known[name])(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):  # nothing is above or below what is no number
            raise InputError(
                f"the rule '{rule}' has no number in it; say {name}={known[name]:g}, for example"
            )
        known[name] = number
    return PolicyOptions(**known)


def _facts(kind: Any, said: Mapping[str, Any]) -> Any:
    """A record of facts from its JSON; what the table does not look at is left out."""
    names = [field.name for field in fields(kind)]
    return kind(**{name: _meant(name, said[name]) for name in names if name in said})


def _meant(name: str, value: Any) -> Any:
    if name in _MEANT:
        return _MEANT[name](value)
    return tuple(tuple(corner) for corner in value) if name == "box_mm" else value
