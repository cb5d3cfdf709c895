"""What is said of heaters as a run ends is what the printer says of them."""

from __future__ import annotations

from typing import Any

import pytest

from amrepair.loop.safe_exit import cool, leave_safe
from gcode.errors import LinkError
from gcode.hosts.port import Temperatures


class Told:
    """A printer that tells of its heaters, or cannot be reached."""

    def __init__(self, *targets_c: float, reached: bool = True) -> None:
        self.targets_c, self.reached = targets_c, reached

    def heaters_off(self) -> None:
        if not self.reached:
            raise LinkError("the port failed")

    def temperatures(self) -> Temperatures:
        return Temperatures(20.0, 0.0, 20.0, self.targets_c[-1], self.targets_c[:-1])


class OnACable(Told):
    """One that is left safe whatever it is at."""

    made_safe = False

    def make_safe(self) -> None:
        self.made_safe = True


@pytest.mark.parametrize("end", [leave_safe, cool])
def test_what_the_printer_says_is_said(end: Any, caplog: pytest.LogCaptureFixture) -> None:
    end(Told(0.0, 0.0))
    assert "printer: heaters off (the printer reports targets of 0)" in caplog.text
    caplog.clear()
    end(Told(0.0, 210.0, 60.0))
    assert "heaters are NOT off" in caplog.text
    assert "210 °C and 60 °C" in caplog.text
    caplog.clear()
    end(Told(0.0, reached=False))
    assert "HEATERS COULD NOT BE REACHED (the port failed): switch the printer off" in caplog.text


def test_on_a_cable_heaters_that_do_not_answer_are_gone_past() -> None:
    printer: Any = OnACable(0.0, reached=False)
    cool(printer)
    assert printer.made_safe
