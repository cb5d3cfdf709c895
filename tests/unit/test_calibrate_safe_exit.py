"""`amrepair calibrate --port` prints, and leaves the printer as safe as whoever else prints."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from amrepair.cli import pose_calibration
from amrepair.cli.pose_calibration import Source
from amrepair.errors import LoopError
from gcode.cli import console
from gcode.profiles import load_setup


class Cable:
    """A printer on a cable whose print ends as asked."""

    def __init__(self, ends: BaseException | bool) -> None:
        self.ends, self.seen = ends, list[str]()

    def connect(self) -> None:
        self.seen.append("connected")

    def print(self, *_: Any, **__: Any) -> Any:
        if isinstance(self.ends, BaseException):
            raise self.ends
        return SimpleNamespace(ok=self.ends, next_line=7)

    def finish_moves(self) -> None:
        """Nothing moves."""

    def make_safe(self) -> None:
        self.seen.append("safe")

    def close(self) -> None:
        self.seen.append("closed")


@pytest.mark.parametrize(
    ("ends", "error"), [(KeyboardInterrupt(), KeyboardInterrupt), (False, LoopError)]
)
def test_a_target_that_is_not_printed_to_its_end_leaves_the_printer_safe(
    monkeypatch: pytest.MonkeyPatch, ends: BaseException | bool, error: type[BaseException]
) -> None:
    """Regression: Ctrl+C let go of the cable with the heaters on and the nozzle in the target."""
    cable, scanned = Cable(ends), list[object]()
    eye = SimpleNamespace(scan=scanned.append)
    monkeypatch.setattr(pose_calibration, "connect", lambda *_, **__: cable)
    monkeypatch.setattr(pose_calibration, "open_scanner", lambda *_: eye)
    monkeypatch.setattr(pose_calibration, "_target", lambda _: None)
    source = Source("/dev/ttyACM0", "watch:scans", None, None, 0, 60.0, None)
    with pytest.raises(error):
        pose_calibration._scan(load_setup("prusa_mk3s"), source, console.Bars())
    assert cable.seen == ["connected", "safe", "closed"]
    assert scanned == []
