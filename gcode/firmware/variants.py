"""How the emulated firmwares differ: one table.

Facts from the firmwares' sources and documentation; where one is a choice of ours it says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Family = Literal["marlin", "prusa", "klipper", "reprap"]


@dataclass(frozen=True, slots=True)
class Variant:
    """What a firmware says and takes.

    Attributes
    ----------
    family
        The firmware that it is, or is a relative of, in all that no other field says.
    numbers
        `verify`: number and checksum must be right; `checksum`: only the checksum, a bad line is
        dropped silently; `ignore`: both are stripped unread.
    unhomed
        What is said to a move of an axis that is not homed, which is then not made; empty where
        such moves are made (Marlin, unless it is built otherwise).
    modes_follow_g90
        G90 and G91 set the extruder's mode too (Marlin); `relative_only`: G91 makes E relative
        while it lasts and M83 persists (Klipper); `independent`: they leave it alone.
    place_digits
        Decimals of the answer to M114, mm.
    motors_off_s
        After the last move; infinity where they keep a part of their current.
    unbuilt
        Commands that this build of the firmware does not know.
    """

    name: str
    family: Family
    banner: tuple[str, ...]
    firmware_line: str
    capabilities: tuple[tuple[str, bool], ...]
    numbers: Literal["verify", "checksum", "ignore"]
    modes_follow_g90: Literal["both", "relative_only", "independent"]
    error_prefix: str = "Error:"
    unhomed: str = ""
    unknown: str = 'echo:Unknown command: "{command}"'
    echo_prefix: str = "echo:"
    emergency_parser: bool = False
    keepalive: bool = False
    temperatures_in_ok: bool = True
    advanced_ok: bool = False
    place_digits: int = 2
    motors_off_s: float = 120.0
    unbuilt: frozenset[bytes] = frozenset()

    def without(self, *options: str) -> Variant:
        """The firmware as it is built without some of `BUILT_WITHOUT`; it says so, where it can."""
        missing = [BUILT_WITHOUT[option] for option in options]
        said = {capability for _, capability in missing}
        return replace(
            self,
            unbuilt=self.unbuilt.union(*(commands for commands, _ in missing)),
            capabilities=tuple((cap, has and cap not in said) for cap, has in self.capabilities),
        )


BUILT_WITHOUT: dict[str, tuple[frozenset[bytes], str]] = {
    "no_arcs": (frozenset({b"G2", b"G3"}), "ARCS"),
    "no_inches": (frozenset({b"G20"}), ""),
}
"""Parts that not everybody builds: their commands, and the capability that says so."""

_MARLIN_CAPABILITIES = (
    ("SERIAL_XON_XOFF", False),
    ("EEPROM", True),
    ("AUTOREPORT_POS", True),
    ("AUTOREPORT_TEMP", True),
    ("PROGRESS", False),
    ("AUTOLEVEL", True),
    ("EMERGENCY_PARSER", True),
    ("HOST_ACTION_COMMANDS", True),
    ("ARCS", True),
)

FIRMWARES: dict[str, Variant] = {
    "marlin": Variant(
        name="marlin",
        family="marlin",
        banner=(
            "start",
            "echo:Marlin 2.1.2",
            "echo: Last Updated: 2022-12-17 | Author: (emulated)",
            "echo: Free Memory: 5000  PlannerBufferBytes: 1200",
        ),
        firmware_line="FIRMWARE_NAME:Marlin 2.1.2 (emulated) SOURCE_CODE_URL:none "
        "PROTOCOL_VERSION:1.0 MACHINE_TYPE:{machine} EXTRUDER_COUNT:1",
        capabilities=_MARLIN_CAPABILITIES,
        numbers="verify",
        modes_follow_g90="both",
        emergency_parser=True,
        keepalive=True,
    ),
    # MK3S: Prusa-Firmware, where only M82 and M83 set the extruder's mode.
    "prusa": Variant(
        name="prusa",
        family="prusa",
        banner=("start", "echo: 3.13.3-7094", "echo: Last Updated: (emulated)"),
        firmware_line="FIRMWARE_NAME:Prusa-Firmware 3.13.3 (emulated) based on Marlin "
        "PROTOCOL_VERSION:1.0 MACHINE_TYPE:{machine} EXTRUDER_COUNT:1",
        capabilities=(
            ("AUTOREPORT_TEMP", True),
            ("AUTOREPORT_POSITION", True),
            ("EXTENDED_M20", True),
        ),
        numbers="verify",
        modes_follow_g90="independent",
        keepalive=True,
    ),
    "klipper": Variant(
        name="klipper",
        family="klipper",
        place_digits=3,
        banner=("// Klipper state: Ready",),
        firmware_line="FIRMWARE_NAME:Klipper FIRMWARE_VERSION:v0.12.0-emulated",
        capabilities=(),
        numbers="ignore",
        modes_follow_g90="relative_only",
        error_prefix="!! ",
        unhomed="!! Must home axis first",
        unknown='// Unknown command:"{command}"',
        echo_prefix="// ",
        motors_off_s=600.0,
    ),
    "reprap": Variant(
        name="reprap",
        family="reprap",
        place_digits=3,
        banner=("RepRapFirmware for emulated boards is up and running.",),
        firmware_line="FIRMWARE_NAME: RepRapFirmware for emulated boards FIRMWARE_VERSION: 3.6.0 "
        "ELECTRONICS: emulated",
        capabilities=(),
        numbers="checksum",
        modes_follow_g90="independent",
        error_prefix="Error: ",
        unhomed="Error: G0/G1: insufficient axes homed",
        unknown="Error: Bad command: {command}",
        echo_prefix="",
        motors_off_s=float("inf"),
    ),
}
