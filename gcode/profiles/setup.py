"""`PrintSetup`: a printer, a material and a process together, and the scripts they fill in."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from gcode.errors import ProfileError
from gcode.profiles.names import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS
from gcode.profiles.priming import prime_line
from gcode.profiles.schema import MaterialProfile, PrinterProfile, ProcessProfile
from gcode.profiles.store import load_material, load_printer, load_process

_FIELD = re.compile(r"\{([a-z0-9_]+)\}")


@dataclass(frozen=True, slots=True)
class PrintSetup:
    """What a job is printed with."""

    printer: PrinterProfile
    material: MaterialProfile
    process: ProcessProfile

    @property
    def max_volumetric_mm3_s(self) -> float:
        """What hotend and filament both can melt, mm³/s."""
        return min(self.printer.max_volumetric_mm3_s, self.material.max_volumetric_mm3_s)

    def melting_all(self) -> PrintSetup:
        """The same for a filament of unknown kind, taken to melt as fast as the hotend can."""
        as_hotend = {"max_volumetric_mm3_s": self.printer.max_volumetric_mm3_s}
        return replace(self, material=self.material.model_copy(update=as_hotend))

    @property
    def hashes(self) -> dict[str, str]:
        """Profile hashes by `kind/id`, for reports."""
        return {
            f"printers/{self.printer.id}": self.printer.sha256,
            f"materials/{self.material.id}": self.material.sha256,
            f"processes/{self.process.id}": self.process.sha256,
        }


def load_setup(
    printer: str | Path = DEFAULT_PRINTER,
    material: str | Path = DEFAULT_MATERIAL,
    process: str | Path = DEFAULT_PROCESS,
) -> PrintSetup:
    """Load the three profiles by ID or path.

    Raises
    ------
    ProfileError
        Where one is unknown, malformed, or the material is too hot for the printer.

    Examples
    --------
    >>> import gcode
    >>> setup = gcode.load_setup("voron_2_4", "petg", "repair_0.10")
    >>> setup.printer.dialect, setup.process.layer_height_mm
    ('klipper', 0.1)
    """
    setup = PrintSetup(load_printer(printer), load_material(material), load_process(process))
    hottest_c = max(setup.material.hotend_c, setup.material.first_layer_hotend_c)
    for what, value_c, limit_c in (
        ("hotend", hottest_c, setup.printer.max_hotend_c),
        ("bed", setup.material.bed_c, setup.printer.max_bed_c),
    ):
        if value_c > limit_c:
            raise ProfileError(
                f"Material '{setup.material.id}' wants the {what} at {value_c:g} °C, above the "
                f"{limit_c:g} °C of printer '{setup.printer.id}'; choose another of the two."
            )
    return setup


def expand_script(
    lines: tuple[str, ...], setup: PrintSetup, **values: float | str
) -> tuple[str, ...]:
    """Fill `{name}` in a profile's own G-code.

    Known names: hotend_c, first_layer_hotend_c, bed_c, fan, bed_x_mm, bed_y_mm, max_z_mm, park_x,
    park_y, park_z, filament, printer, prime_line (lines of their own, within the profiles' limits),
    and what `values` adds (such as `max_layer_z`).
    """
    p, m = setup.printer, setup.material
    known: dict[str, float | str] = {
        "hotend_c": m.hotend_c,
        "first_layer_hotend_c": m.first_layer_hotend_c,
        "bed_c": m.bed_c,
        "fan": round(255 * m.fan_ratio),
        "bed_x_mm": p.bed_box_mm[2],
        "bed_y_mm": p.bed_box_mm[3],
        "max_z_mm": p.max_z_mm,
        "park_x": p.park_mm[0],
        "park_y": p.park_mm[1],
        "park_z": p.park_mm[2],
        "filament": m.id,
        "printer": p.id,
        "prime_line": "\n".join(prime_line(p, m)),
        **values,
    }

    def fill(match: re.Match[str]) -> str:
        name = match.group(1)
        if name not in known:
            raise ProfileError(
                f"Script of printer '{p.id}' names '{{{name}}}'; known names are: "
                f"{', '.join(sorted(known))}."
            )
        value = known[name]
        return value if isinstance(value, str) else f"{value:g}"

    return tuple(part for line in lines for part in _FIELD.sub(fill, line).split("\n"))
