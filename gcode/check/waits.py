"""Waits that never end, or that outlast a day: for temperatures, and for time.

It knows no moves. Marlin, Prusa's firmware and RepRapFirmware wait for cooling where R tells the
temperature (M109.md, M190.md); Klipper knows S alone and waits for cooling by that, once it is not
0 (klippy/extras/heaters.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from gcode.profiles import PrinterProfile

Finding = tuple[str, str, str]

ROOM_C = 30.0  # on a hot day: what is colder nothing cools down to
OFF_C = -273.0
LONGEST_S = 86_400.0
WAIT_FOR = frozenset({"M109", "M190", "M191"})


def told_c(words: Mapping[str, float | None], dialect: str) -> float | None:
    """The temperature that a command sets: Klipper passes over R."""
    value_c = words.get("S") if dialect == "klipper" else words.get("S", words.get("R"))
    return switched_c(value_c, dialect)


def switched_c(value_c: float | None, dialect: str) -> float | None:
    """RepRapFirmware switches a heater off by absolute zero (G-code dictionary, M104 and G10)."""
    return 0.0 if value_c is not None and dialect == "reprap" and value_c <= OFF_C else value_c


def for_cooling(
    name: str, what: str, words: Mapping[str, float | None], dialect: str
) -> Iterator[Finding]:
    """M109, M190 and M191 that wait until something is colder than its surroundings."""
    value_c = words.get("S") if dialect == "klipper" else words.get("R")
    if name not in WAIT_FOR or value_c is None or value_c >= ROOM_C:
        return
    if dialect == "klipper" and value_c == 0:
        return
    yield (
        f"waits for ever for the {what} to get as cold",
        f"{value_c:g} °C",
        f"{ROOM_C:g} °C, which a warm room has",
    )


def for_sensor(
    sensor: str,
    low_c: float | None,
    high_c: float | None,
    heater_c: float | None,
    printer: PrinterProfile,
) -> Iterator[Finding]:
    """Klipper's TEMPERATURE_WAIT; `heater_c` is what the sensor's heater was told, if it is known.

    A heater goes no further than it is told, and what is no heater gets no hotter than a bed.
    """
    what = f"waits for ever for {sensor.lower() or 'a sensor'}"
    hottest_c = printer.max_bed_c if heater_c is None else heater_c
    if low_c is None and high_c is None:
        yield "wait without a temperature", "no MINIMUM and no MAXIMUM", "one of the two"
    elif low_c is not None and high_c is not None and low_c > high_c:
        yield what, f"from {low_c:g} to {high_c:g} °C", "a MAXIMUM above the MINIMUM"
    elif low_c is not None and low_c > hottest_c:
        yield f"{what} to get as hot", f"{low_c:g} °C", f"{hottest_c:g} °C"
    elif high_c is not None and high_c < max(ROOM_C, heater_c or 0.0):
        yield (
            f"{what} to get as cold",
            f"{high_c:g} °C",
            f"{max(ROOM_C, heater_c or 0.0):g} °C",
        )
