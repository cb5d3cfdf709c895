"""How the emulated firmwares differ: one table.

Facts from the firmwares' sources and documentation; where one is a choice of ours it says so.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

MARLIN_TAKES = frozenset(
    b"""G5 G11 G17 G18 G19 G26 G42 G60 G61 G80 M17 M20 M21 M27 M31 M73 M75 M76 M77 M78 M81 M85 M86
    M110 M111 M113 M116 M119 M141 M142 M150 M191 M200 M206 M207 M208 M209 M211 M221.1 M250 M300 M301
    M304 M355 M412 M413 M420 M421 M486 M500 M501 M502 M503 M555 M569 M572 M573 M575 M593 M600 M601
    M602 M603 M701 M702 M711 M851 M862 M862.1 M862.2 M862.3 M862.4 M862.5 M862.6 M900 M906 M907 M914
    M974 T0""".split()
)


@dataclass(frozen=True, slots=True)
class Variant:
    """What a firmware says and takes; where nothing is said, what Marlin does.

    Attributes
    ----------
    numbers
        `verify`: number and checksum must be right; `checksum`: only the checksum, a bad line is
        dropped silently; `ignore`: both are stripped unread.
    refuses
        What it refuses, and the words for it: moves that are then not made (`unhomed`,
        `out_of_range`, `cold`, `arc`; `{to}` is where to), and inches (`inches`). What is none of
        these it does as far as it can: it moves axes that are not homed, cuts moves short at the
        end stops, moves on without plastic.
    cold
        What is said where it moves on without plastic.
    unknown, no_tool
        Answers to a command that it does not know, and to a tool that is not there: the whole of
        it (`{command}`), its first word (`{name}`).
    modes_follow_g90
        G90 and G91 set the extruder's mode too (Marlin); `relative_only`: G91 makes E relative
        while it lasts and M83 persists (Klipper); `independent`: they leave it alone.
    parks
        What lays the present tool of several down.
    line_bytes
        Of its buffer for a line; what is longer is cut silently.
    answers_empty
        It acknowledges empty lines.
    any_case
        It takes commands in small letters.
    passes
        Commands that are heeded while another is under way.
    about_in_ok
        The answer to M115 is a part of the `ok`.
    place, heat
        The answers to M114 and M105; `{steps}` are those of X, Y and Z.
    heat_of_head, tells_each_head
        What M105 tells of head `{k}` of several; whether of an only one, too.
    waits_cooler
        A head that is not chosen has a temperature of its own.
    tool_zeroes_e
        Another head's E begins at 0.
    motors_off_s
        After the last move; infinity where they keep a part of their current.
    m84_sets_time
        M84 S sets that time, and lets go of nothing.
    g92_homes
        Axes that G92 names are taken for homed.
    halted
        What it says when it stops for good.
    once_halted
        What it says to whatever it is told afterwards, `{why}` being the cause; empty where it is
        deaf until a reset.
    takes
        Commands taken and answered, without anything that shows.
    named
        Commands with a name, and whose way of carrying them out they have.
    unbuilt
        Commands that this build of the firmware does not know.
    """

    name: str
    banner: tuple[str, ...]
    firmware_line: str
    capabilities: tuple[tuple[str, bool], ...]
    numbers: Literal["verify", "checksum", "ignore"]
    modes_follow_g90: Literal["both", "relative_only", "independent"]
    error_prefix: str = "Error:"
    refuses: Mapping[str, str] = field(default_factory=dict)
    cold: str = "echo: cold extrusion prevented"
    unknown: str = 'echo:Unknown command: "{command}"'
    no_tool: str = "echo:{name} Invalid extruder"
    parks: frozenset[bytes] = frozenset({b"P0"})
    line_bytes: int = 96
    answers_empty: bool = False
    any_case: bool = False
    passes: frozenset[bytes] = frozenset()
    keepalive: bool = False
    about_in_ok: bool = False
    advanced_ok: bool = False
    place: str = "X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:{e:.2f} Count {steps}"
    heat: str = "T:{0:.2f} /{1:.2f} B:{2:.2f} /{3:.2f}{heads} @:0 B@:0"
    heat_of_head: str = " T{k}:{0:.2f} /{1:.2f}"
    tells_each_head: bool = False
    waits_cooler: bool = False
    tool_zeroes_e: bool = False
    motors_off_s: float = 120.0
    m84_sets_time: bool = True
    g92_homes: bool = False
    halted: str = "Error:Printer halted. kill() called!"
    once_halted: tuple[str, ...] = ()
    takes: frozenset[bytes] = MARLIN_TAKES
    named: Mapping[bytes, str] = field(default_factory=dict)
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
        passes=frozenset({b"M108", b"M112", b"M410"}),
        keepalive=True,
    ),
    # MK3S: Prusa-Firmware, where only M82 and M83 set the extruder's mode.
    "prusa": Variant(
        name="prusa",
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
        unbuilt=frozenset({b"G38"}),
    ),
    # As a live one answered (tests/peers/test_klipper_live.py), with the macros that jobs begin and
    # end with, and ours.
    "klipper": Variant(
        name="klipper",
        banner=("// Klipper state: Ready",),
        firmware_line="FIRMWARE_NAME:Klipper FIRMWARE_VERSION:v0.12.0-emulated",
        capabilities=(),
        numbers="ignore",
        modes_follow_g90="relative_only",
        error_prefix="!! ",
        refuses={
            "unhomed": "!! Must home axis first{to}",
            "out_of_range": "!! Move out of range{to}",
            "cold": "// Extrude below minimum temp\n"
            "// See the 'min_extrude_temp' config option for details\n"
            "!! Extrude below minimum temp",
            "arc": "!! G2/G3 does not support {what}",
            "inches": "!! Machine does not support G20 (inches) command",
        },
        unknown='// Unknown command:"{name}"',
        no_tool='// Unknown command:"{name}"',
        parks=frozenset(),
        line_bytes=sys.maxsize,
        answers_empty=True,
        any_case=True,
        passes=frozenset({b"M112"}),
        about_in_ok=True,
        place="X:{x:.3f} Y:{y:.3f} Z:{z:.3f} E:{e:.3f}",
        heat="B:{2:.1f} /{3:.1f}{heads}",
        heat_of_head=" T{k}:{0:.1f} /{1:.1f}",
        tells_each_head=True,
        tool_zeroes_e=True,
        motors_off_s=600.0,
        m84_sets_time=False,
        halted="// Klipper state: Shutdown",
        once_halted=(
            "// {why}",
            "// Once the underlying issue is corrected, use the",
            '// "FIRMWARE_RESTART" command to reset the firmware, reload the',
            "// config, and restart the host software.",
            "// Printer is shutdown",
            "!! {why}",
        ),
        takes=frozenset(b"G17 G18 G19 M20 M21 M73 M110 M119".split()),
        named={
            b"AMREPAIR_TOUCH": "amrepair_touch",
            b"TEMPERATURE_WAIT": "temperature_wait",
            b"SET_HEATER_TEMPERATURE": "set_heater_temperature",
            b"ACTIVATE_EXTRUDER": "activate_extruder",
            b"TURN_OFF_HEATERS": "end_print",
            b"SET_KINEMATIC_POSITION": "set_kinematic_position",
            b"PRINT_START": "start_print",
            b"START_PRINT": "start_print",
            b"PRINT_END": "end_print",
            b"END_PRINT": "end_print",
        },
        unbuilt=frozenset(b"G10 G29 G38 M0 M1 M108 M154 M155 M201 M203 M205 M302 M410".split()),
    ),
    "reprap": Variant(
        name="reprap",
        banner=("RepRapFirmware for emulated boards is up and running.",),
        firmware_line="FIRMWARE_NAME: RepRapFirmware for emulated boards FIRMWARE_VERSION: 3.6.0 "
        "ELECTRONICS: emulated",
        capabilities=(),
        numbers="checksum",
        modes_follow_g90="independent",
        error_prefix="Error: ",
        refuses={"unhomed": "Error: G0/G1: insufficient axes homed"},
        cold=" cold extrusion prevented",
        unknown="Error: Bad command: {command}",
        no_tool="",
        place="X:{x:.3f} Y:{y:.3f} Z:{z:.3f} E:{e:.3f}",
        motors_off_s=float("inf"),
        waits_cooler=True,
        g92_homes=True,
        halted="Error: Printer halted. kill() called!",
        named={b"G10": "tool_settings", b"M568": "tool_settings", b"M116": "wait_for_heat"},
    ),
}
