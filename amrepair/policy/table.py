"""Decisions as two tables: what is done about each finding, and then what happens at the stop.

Both tables are data: rows of conditions with an action and its reason, of which the first that fits
counts. `FINDINGS` decides about each region by itself (`judge`); `STOP_ROWS` decides about the stop
as a whole, by the gravest of those decisions (`decide`). The page `docs/explanation/decisions.md`
is made from the tables, and a test compares them. The facts come from `amrepair.loop.findings` and
`amrepair.loop.situation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Any

from amrepair.policy.options import DEFAULT_POLICY, PolicyOptions
from amrepair.policy.remedies import Way
from amrepair.regions.anomaly import DefectType


class Action(StrEnum):
    """What can be decided, from the gravest down."""

    STOP = "stop"
    PAUSE = "pause and ask"
    GIVE_UP = "give the object up"
    LOOK_AGAIN = "look again"
    FILL_NOW = "fill now"
    FILL_WITH_NEXT = "fill with the next layer"
    LOWER_NEXT = "lower the next layer's flow"
    OFFER = "offer to print again"
    GO_ON = "go on"


class Cover(StrEnum):
    """What the job will lay over a place with its next layer."""

    NOTHING = "nothing"
    OPEN = "open infill"
    SOLID = "solid beads"


@dataclass(frozen=True, slots=True)
class Finding:
    """The facts about one region that the table looks at.

    Attributes
    ----------
    kind
        `missing` or `excess`.
    confidence
        How sure it is, from 0 to 1, that the region is there and is of this type.
    volume_mm3
        Volume of the region.
    defect_mm3
        Volume of the whole defect that the region is a piece of (`acceptance.defect_volumes`).
    thickness_layers, height_layers
        Mean thickness, and height from the lowest to the highest point, in layers of the job.
    reachable_ratio
        Share of it that the nozzle reaches; 1 where that has not been asked.
    cover
        What the job will lay over it with its next layer.
    hit_mm
        How deep the head would run into it on the job's next moves; 0 if it clears it.
    box_mm
        Lowest and highest corner, build frame.
    seen_twice
        Whether this stop was looked at again already, with nothing printed in between.
    skipped
        Whether a missing line of the job lies in it, so that a bead fits.
    layer_off
        Whether the layer's top lies off its plane there by more than the tolerance and the layer's
        own scatter explain (`loop.layer_level`). Only then is the next layer's flow changed.
    object
        The object of the job in which it lies; empty where the job prints only one, or where the
        region lies in none.
    lost_ratio
        Share of that object, as far as it is printed, that is missing in all its regions together.
    given_up
        Whether it lies in an object that has been given up.
    told
        What is known of it beyond its type, for people; the table does not look at it.
    """

    kind: str
    type: DefectType
    confidence: float
    volume_mm3: float
    defect_mm3: float
    thickness_layers: float
    height_layers: float
    reachable_ratio: float
    cover: Cover
    hit_mm: float
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]]
    seen_twice: bool = False
    skipped: bool = False
    layer_off: bool = True
    object: str = ""
    lost_ratio: float = 0.0
    given_up: bool = False
    told: str = ""

    @property
    def named(self) -> str:
        """Its type, and what is known of it beyond that."""
        return f"{self.type} ({self.told})" if self.told else str(self.type)


@dataclass(frozen=True, slots=True)
class Situation:
    """The facts about a stop that the second table looks at.

    Attributes
    ----------
    gravest
        The gravest action that was decided for a finding.
    seen_twice
        Whether this stop was looked at again already, with nothing printed in between.
    refused
        Whether the checker refuses the patch, or nothing of the patch is left to print.
    last_pass, stuck, little_left
        Reasons against another pass: as many as allowed were made; the last one changed little;
        little is left (`stopping_criteria`).
    laid_nothing
        Whether nothing rose where the last repair was laid: the nozzle is clogged, or the filament
        out. Then it is not `stuck`.
    beyond
        Where repairs are printed unasked: the limit of the profile that this one exceeds. Else
        empty.
    buried_mm3
        Volume that stays open under layers that were printed since, however the stop ends.
    other_material
        The material in the nozzle, where what is missing is of another one; else empty.
    """

    gravest: Action
    seen_twice: bool = False
    refused: bool = False
    last_pass: bool = False
    stuck: bool = False
    laid_nothing: bool = False
    little_left: bool = False
    beyond: str = ""
    buried_mm3: float = 0.0
    other_material: str = ""


@dataclass(frozen=True, slots=True)
class Condition:
    """One condition of a row: a fact, compared with a value.

    Attributes
    ----------
    fact
        The name of an attribute of `Finding` or `Situation`.
    test
        `is` equal to the value, `in` one of several values, `stated` (not empty), `≥` or `<`.
    value
        What the fact is compared with. For `≥` and `<` it may be the name of a number of
        `PolicyOptions`.
    """

    fact: str
    test: str
    value: Any

    def fits(self, facts: Finding | Situation, options: PolicyOptions = DEFAULT_POLICY) -> bool:
        """Whether the condition holds."""
        found = getattr(facts, self.fact)
        if self.test == "is":
            return bool(found == self.value)
        if self.test == "in":
            return found in self.value
        if self.test == "stated":
            return bool(found)
        limit = self.limit(options)
        return bool(found >= limit) if self.test == "≥" else bool(found < limit)

    def limit(self, options: PolicyOptions) -> float:
        """The number that `≥` and `<` compare with; a name is looked up in the options."""
        return float(getattr(options, self.value) if isinstance(self.value, str) else self.value)

    def __str__(self) -> str:
        if self.test == "stated":
            return self._name()
        if isinstance(self.value, bool):
            return self._name() if self.value else f"not {self._name()}"
        if self.test == "in":
            return f"{self._name()} is {' or '.join(str(v) for v in self.value)}"
        if self.test == "is":
            return f"{self._name()} is {self.value}"
        unit = _QUANTITY_UNITS.get(self.fact, "")
        return f"{self._name()} {self.test} {self.limit(DEFAULT_POLICY):g}{unit}"

    def _name(self) -> str:
        return _QUANTITY_NAMES.get(self.fact, self.fact)


_QUANTITY_NAMES = {
    "thickness_layers": "mean thickness",
    "height_layers": "height",
    "volume_mm3": "volume",
    "defect_mm3": "the whole defect's volume",
    "reachable_ratio": "share in reach",
    "cover": "covered next by",
    "hit_mm": "in the head's way by",
    "seen_twice": "looked at twice",
    "object": "in one of several objects",
    "lost_ratio": "share of the object that is gone",
    "given_up": "in an object that was given up",
    "skipped": "where a line was skipped",
    "layer_off": "the layer lies off by more than its own scatter",
    "last_pass": "it was the last pass allowed",
    "stuck": "the last pass changed little",
    "laid_nothing": "nothing rose where the last repair was laid",
    "little_left": "little is left",
    "refused": "nothing of the patch may be printed",
    "gravest": "gravest",
    "beyond": "beyond a limit for printing unasked",
    "buried_mm3": "left open under later layers",
    "other_material": "another material is in the nozzle",
}
_QUANTITY_UNITS = {
    "thickness_layers": " layers",
    "height_layers": " layers",
    "volume_mm3": " mm³",
    "defect_mm3": " mm³",
    "buried_mm3": " mm³",
    "hit_mm": " mm",
}


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table."""

    id: str
    action: Action
    when: tuple[Condition, ...]
    reason: str

    def fits(self, facts: Finding | Situation, options: PolicyOptions = DEFAULT_POLICY) -> bool:
        """Whether all conditions of the row hold."""
        return all(condition.fits(facts, options) for condition in self.when)


ENDING_DEFECTS = (DefectType.DETACHED, DefectType.LAYER_SHIFT)
BEYOND_MENDING = (*ENDING_DEFECTS, DefectType.WARP, DefectType.CLOG)
"""Defects that adding material cannot mend."""


def _is(fact: str, value: object) -> Condition:
    return Condition(fact, "in" if isinstance(value, tuple) else "is", value)


def _from(fact: str, value: float | str) -> Condition:
    return Condition(fact, "≥", value)


def _below(fact: str, value: float | str) -> Condition:
    return Condition(fact, "<", value)


_THIN = (
    _is("skipped", False), _below("thickness_layers", "thin_layers"),
    _from("thickness_layers", "least_layers"), _below("height_layers", "one_layer"),
    _is("cover", Cover.SOLID),
)  # fmt: skip
_MISSING, _EXCESS = _is("kind", "missing"), _is("kind", "excess")
_OWN_OBJECT = Condition("object", "stated", None)

FINDINGS: tuple[Row, ...] = (
    Row("F0a", Action.GO_ON, (_is("given_up", True),),
        "nothing more is printed of that object"),
    Row("F0b", Action.LOOK_AGAIN, (_MISSING, _OWN_OBJECT, _from("lost_ratio", "lost_ratio"),
                                   _is("seen_twice", False)),
        "a false alarm would cost the object"),
    Row("F0c", Action.GIVE_UP, (_MISSING, _OWN_OBJECT, _from("lost_ratio", "lost_ratio")),
        "too little is left of the object to repair it; the others can go on"),
    Row("F1", Action.STOP, (_is("type", ENDING_DEFECTS), _from("confidence", "sure")),
        "what is printed from here on would land beside the part"),
    Row("F2", Action.LOOK_AGAIN, (_is("type", BEYOND_MENDING), _below("confidence", "sure"),
                                  _is("seen_twice", False)),
        "a false alarm would cost the print"),
    Row("F3a", Action.GIVE_UP, (_is("type", (DefectType.WARP,)), _OWN_OBJECT),
        "adding material cannot mend it; the other objects can go on"),
    Row("F3", Action.PAUSE, (_is("type", BEYOND_MENDING),),
        "adding material cannot mend it; somebody has to look"),
    Row("F3b", Action.LOOK_AGAIN, (_EXCESS, _from("volume_mm3", "least_hit_mm3"),
                                   _from("hit_mm", 1e-6), _below("confidence", "sure"),
                                   _is("seen_twice", False)),
        "a false alarm would halt the print"),
    Row("F4a", Action.GIVE_UP, (_EXCESS, _OWN_OBJECT, _from("volume_mm3", "least_hit_mm3"),
                                _from("hit_mm", 1e-6)),
        "the head would hit it on its next moves; the other objects can go on"),
    Row("F4", Action.PAUSE, (_EXCESS, _from("volume_mm3", "least_hit_mm3"), _from("hit_mm", 1e-6)),
        "the head would hit it on its next moves; cut it off, or end the print"),
    Row("F5", Action.GO_ON, (_EXCESS, _is("type", (DefectType.STRING,))),
        "strings come off by hand, and the nozzle melts through them"),
    Row("F5a", Action.GO_ON, (_EXCESS, _is("type", (DefectType.SAG,))),
        "what the job laid over nothing has sagged; printing cannot lift it, supports would have "
        "held it"),
    Row("F6", Action.LOWER_NEXT, (_EXCESS, _from("volume_mm3", "least_excess_mm3"),
                                  _from("thickness_layers", "least_layers"),
                                  _below("thickness_layers", "excess_layers"),
                                  _is("cover", (Cover.SOLID, Cover.OPEN)),
                                  _is("layer_off", True)),
        "the next layer's beads have less room there"),
    Row("F7", Action.GO_ON, (_EXCESS,),
        "printing cannot take excess away"),
    Row("F8a", Action.GO_ON, (_MISSING, _is("skipped", False),
                              _below("defect_mm3", "least_mm3")),
        "smaller than is worth a repair"),
    Row("F8b", Action.GO_ON, (_MISSING, _below("defect_mm3", "least_skipped_mm3")),
        "less of the job's lines is gone than is worth a repair"),
    Row("F9", Action.LOOK_AGAIN, (_MISSING, _below("confidence", "doubtful"),
                                  _is("seen_twice", False)),
        "it hardly stands out from the noise"),
    Row("F10", Action.GO_ON, (_MISSING, _below("confidence", "doubtful")),
        "two looks do not make it stand out from the noise"),
    Row("F11a", Action.GO_ON, (_MISSING, *_THIN, _is("layer_off", False)),
        "no more than the layer's own beads differ by"),
    Row("F11b", Action.FILL_WITH_NEXT, (_MISSING, *_THIN),
        "thinner than a bead of its own; the next layer's beads can carry it"),
    Row("F12", Action.FILL_WITH_NEXT, (_MISSING, _below("reachable_ratio", "least_reach_ratio"),
                                       _below("height_layers", "one_layer"),
                                       _is("cover", Cover.SOLID), _is("layer_off", True)),
        "the nozzle cannot get down to it, and the next layer's beads can carry it"),
    Row("F13", Action.GO_ON, (_MISSING, _below("reachable_ratio", "least_reach_ratio")),
        "nothing of it can be reached"),
    Row("F14", Action.FILL_NOW, (_MISSING,),
        "a bead fits, and the nozzle reaches it"),
)  # fmt: skip
"""What is done about one finding: the first row that fits counts."""

_FILL = _is("gravest", Action.FILL_NOW)
STOP_ROWS: tuple[Row, ...] = (
    Row("S1", Action.STOP, (_is("gravest", Action.STOP),),
        "a finding ends the run: parked, heaters off"),
    Row("S1a", Action.LOOK_AGAIN, (_is("laid_nothing", True), _is("seen_twice", False)),
        "a false alarm would halt the print"),
    Row("S1b", Action.PAUSE, (_is("laid_nothing", True),),
        "nothing rose where the last repair was laid: the nozzle is clogged, or the filament out, "
        "and the job would be printed into air"),
    Row("S2", Action.PAUSE, (_is("gravest", Action.PAUSE),),
        "a finding needs somebody's word; where nobody can be asked, the run ends parked"),
    Row("S2a", Action.GIVE_UP, (_is("gravest", Action.GIVE_UP),),
        "nothing more is printed of the object, which is asked about where somebody is; then "
        "another look at the rest"),
    Row("S3", Action.LOOK_AGAIN, (_is("gravest", Action.LOOK_AGAIN), _is("seen_twice", False)),
        "another scan, nothing moved between"),
    Row("S4", Action.GO_ON, (_FILL, _is("little_left", True)),
        "what is left is a small share of what was found; more passes would only add rims"),
    Row("S5", Action.GO_ON, (_FILL, _is("stuck", True)),
        "the last pass left most of what it found: it has met something else than a defect"),
    Row("S6", Action.GO_ON, (_FILL, _is("last_pass", True)),
        "as many passes as are allowed have been made"),
    Row("S7", Action.GO_ON, (_FILL, _is("refused", True)),
        "the checker refuses the patch, or the nozzle reaches nothing of it"),
    Row("S7a", Action.GO_ON, (_FILL, Condition("other_material", "stated", None)),
        "the nozzle holds another material than what is missing is of; a later look may fill it"),
    Row("S8", Action.PAUSE, (_FILL, Condition("beyond", "stated", None)),
        "larger than the profile lets be printed unasked"),
    Row("S9", Action.FILL_NOW, (_FILL,),
        "the patch has passed the checker"),
    Row("S10", Action.FILL_WITH_NEXT, (_is("gravest", Action.FILL_WITH_NEXT),),
        "the job's next layer is rewritten, bead by bead"),
    Row("S11", Action.LOWER_NEXT, (_is("gravest", Action.LOWER_NEXT),),
        "the job's next layer is rewritten, bead by bead"),
    Row("S12a", Action.OFFER, (_is("gravest", Action.GO_ON), _from("buried_mm3", "buried_mm3")),
        "the nozzle cannot get to it any more: cut down and printed again it could; else it stays"),
    Row("S12", Action.GO_ON, (),
        "nothing is left to decide"),
)  # fmt: skip
"""What happens at the stop: the first row that fits counts."""

_GRAVITY = tuple(Action)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The decision about one finding, with the row that made it."""

    finding: Finding
    action: Action
    row: str
    reason: str


@dataclass(frozen=True, slots=True)
class Decision:
    """What was decided at a look, with all the facts that led to it."""

    action: Action
    row: str
    reason: str
    situation: Situation
    verdicts: tuple[Verdict, ...]
    ways: tuple[Way, ...] = ()

    @property
    def changes_next(self) -> tuple[Verdict, ...]:
        """The findings for which the next layer's flow will be changed."""
        wanted = {Action.FILL_WITH_NEXT, Action.LOWER_NEXT}
        return tuple(verdict for verdict in self.verdicts if verdict.action in wanted)

    @property
    def own(self) -> tuple[Verdict, ...]:
        """The findings that led to this decision."""
        return tuple(verdict for verdict in self.verdicts if verdict.action is self.action)

    @property
    def told(self) -> list[str]:
        """The reasons, and what can be done, as lines for the person who is asked."""
        own = [f"{verdict.finding.named}: {verdict.reason}" for verdict in self.own]
        return (own or [self.reason]) + [way.told for way in self.ways]

    def to_json(self) -> dict[str, Any]:
        """The decision as a run records it."""
        return {
            "action": str(self.action),
            "row": self.row,
            "reason": self.reason,
            "situation": {k: _plain(v) for k, v in asdict(self.situation).items()},
            "findings": [
                {**{k: _plain(v) for k, v in asdict(verdict.finding).items()},
                 "action": str(verdict.action), "row": verdict.row, "reason": verdict.reason}
                for verdict in self.verdicts
            ],
            "ways": [way.to_json() for way in self.ways],
        }  # fmt: skip


def judge(finding: Finding, options: PolicyOptions = DEFAULT_POLICY) -> Verdict:
    """Decide about one finding, by the first row that fits."""
    row = next(row for row in FINDINGS if row.fits(finding, options))
    return Verdict(finding, row.action, row.id, row.reason)


def gravest(verdicts: Sequence[Verdict]) -> Action:
    """The gravest action of some verdicts; `go on` where there are none."""
    return min((v.action for v in verdicts), key=_GRAVITY.index, default=Action.GO_ON)


def decide(
    verdicts: Sequence[Verdict], situation: Situation, options: PolicyOptions = DEFAULT_POLICY
) -> Decision:
    """Decide what happens at the stop.

    Where filling is gravest but the patch is not to be printed, the other findings still count:
    then the next gravest action decides, if it asks for anything.
    """
    row = next(row for row in STOP_ROWS if row.fits(situation, options))
    if situation.gravest is Action.FILL_NOW and row.action is Action.GO_ON:
        rest = gravest([v for v in verdicts if v.action is not Action.FILL_NOW])
        rest_of = replace(situation, gravest=rest)
        also = next(other for other in STOP_ROWS if other.fits(rest_of, options))
        if also.action is not Action.GO_ON:
            return Decision(
                also.action, f"{row.id}, {also.id}", f"{row.reason}; {also.reason}",
                situation, tuple(verdicts),
            )  # fmt: skip
    return Decision(row.action, row.id, row.reason, situation, tuple(verdicts))


def _plain(value: Any) -> Any:
    if isinstance(value, StrEnum):
        return str(value)
    if isinstance(value, float):
        return round(value, 6)
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value
