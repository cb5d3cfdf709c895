"""Whatever a print server pushes: a state or nothing, never an exception in the reader's thread."""

from __future__ import annotations

from collections import deque
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.hosts.moonraker_state import KlippyState
from gcode.hosts.octoprint_state import ServerState

FILE = "ours.gcode"
WORDS = st.sampled_from(
    "current history event state flags job file path progress filepos completion logs resends count"
    " type payload reason error text printing closedOrError PrintDone PrintFailed cancelled"
    " method params id result status webhooks print_stats filename virtual_sdcard file_position"
    " notify_status_update notify_klippy_ready notify_klippy_shutdown ready shutdown complete"
    f" state_message message {FILE}".split()
)
LEAF = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | WORDS | st.text()
JSON = st.recursive(
    LEAF, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=4)
)


def shaped(**parts: Any) -> st.SearchStrategy[dict[str, Any]]:
    """A message of the right outline, anything at all in its places."""
    return st.fixed_dictionaries({}, optional=parts)


JOB = shaped(file=shaped(path=st.just(FILE) | JSON) | JSON) | JSON
CURRENT = shaped(
    state=shaped(text=JSON, error=JSON, flags=shaped(printing=JSON, closedOrError=JSON) | JSON)
    | JSON,
    job=JOB,
    progress=shaped(filepos=JSON, completion=JSON) | JSON,
    resends=shaped(count=JSON) | JSON,
    logs=JSON,
)
EVENT = shaped(
    type=WORDS | JSON, payload=shaped(path=st.just(FILE), reason=JSON, error=JSON) | JSON
)
STATUS = shaped(
    webhooks=shaped(state=JSON, state_message=JSON) | JSON,
    print_stats=shaped(state=JSON, filename=st.just(FILE) | JSON, message=JSON) | JSON,
    virtual_sdcard=shaped(file_position=JSON) | JSON,
)
OCTOPRINT = JSON | shaped(current=CURRENT | JSON, history=CURRENT | JSON, event=EVENT | JSON)
MOONRAKER = JSON | shaped(
    method=WORDS | JSON, id=JSON, result=JSON, params=st.lists(STATUS | JSON, max_size=2) | JSON
)


@settings(max_examples=50)
@given(st.lists(OCTOPRINT, max_size=6), CURRENT | JSON)
def test_octoprints_news(messages: list[Any], report: Any) -> None:
    state = ServerState()
    state.follow(FILE)
    state.terminal = deque()
    for message in messages:
        state.take(message)
        assert isinstance(state.ended, bool)
        assert isinstance(state.file_position, int)
    if isinstance(report, dict):
        assert isinstance(state.look(report, {}), bool)


@settings(max_examples=50)
@given(st.lists(MOONRAKER, max_size=6))
def test_moonrakers_news(messages: list[Any]) -> None:
    state = KlippyState()
    state.follow(FILE)
    for message in messages:
        state.take(message)
        assert state.outcome in {"", "complete", "cancelled", "error"}
        assert state.file_position >= 0
        assert isinstance(state.printing_ours, bool)


@settings(max_examples=50)
@given(st.lists(OCTOPRINT, max_size=6))
def test_an_end_needs_its_own_event(messages: list[Any]) -> None:
    """No news but an end of our file, or a printer that is gone, ends the print."""
    state = ServerState()
    state.follow(FILE)
    for message in messages:
        state.take(message)
    ends = [
        message["event"].get("type")
        for message in messages
        if isinstance(message, dict)
        and isinstance(message.get("event"), dict)
        and isinstance(message["event"].get("payload"), dict)
        and message["event"]["payload"].get("path") == FILE
    ]
    assert not state.outcome or ends
