"""What a job says of the printer and the material that it was sliced for.

A program of `gcode slice` names its profiles. Of a slicer's job the settings that are written in it
(`importers.jobs`) are made profiles of. It tells whether a profile is of another machine, and
judges no move.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

from gcode.dialects import dialect_of
from gcode.errors import ProfileError
from gcode.profiles.importers import ImportedFile, import_job, write_profiles
from gcode.profiles.importers.jobs import dialect_of_words, generator
from gcode.profiles.machines import machine_named
from gcode.profiles.names import DEFAULT_PRINTER, DEFAULT_PROCESS
from gcode.profiles.schema import PrinterProfile
from gcode.profiles.setup import PrintSetup, load_setup
from gcode.profiles.store import load_printer

SAME_BED_RATIO = 0.05  # slicers and makers give one bed a few millimetres more or less
SAME_NOZZLE_MM = 0.01  # nozzles are sold in steps of a tenth
NAMED_WITHIN = 4096
NO_HOSTS = "Bambu Lab"
"""Whose printers are driven by their maker's own programs."""
_SLICED_FOR = "profiles: "
_MADE_FOR = "printer: "
# What one would ask first, and what no slicer tells.
_ASKED_FIRST = {
    "bed_size_mm": "bed",
    "max_z_mm": "height",
    "nozzle_diameter_mm": "nozzle",
    "max_speed_mm_s": "speeds",
    "max_hotend_c": "temperature limits",
    "envelope": "tool head",
}


@dataclass(frozen=True, slots=True)
class OwnSettings:
    """A job's own settings.

    Attributes
    ----------
    job
        The job's name.
    slicer
        Which program wrote it, as it says itself; empty where it does not.
    machine
        The shipped profile of the job's printer; None where none is known.
    bed_size_mm
        How far the slicer's bed goes in X and Y; None where the job does not tell.
    """

    job: str
    slicer: str
    found: ImportedFile
    machine: str | None
    bed_size_mm: tuple[float, float] | None

    @property
    def printer_name(self) -> str:
        """What the slicer calls the printer."""
        return self.found.profiles[0].name

    @property
    def flow_is_told(self) -> bool:
        """Whether the job says how fast its filament may be melted."""
        return "max_volumetric_mm3_s" in self.found.profiles[1].values

    def setup(self, material: str | None = None, process: str | None = None) -> PrintSetup:
        """Printer and, where none is named, material of the job.

        Parameters
        ----------
        process
            The process of our own that repairs are sliced with; its default where left out.
        """
        with tempfile.TemporaryDirectory(prefix="gcode-job-") as folder:
            return load_setup(*self.keep(Path(folder), material, process))

    def named(self, material: str | None, process: str | None) -> None:
        """IDs or paths of such profiles: there are none but those that `keep` writes."""

    def keep(
        self, folder: Path, material: str | None = None, process: str | None = None
    ) -> tuple[str, str, str]:
        """Write the profiles into a folder; the three paths or IDs to load."""
        paths = write_profiles(self.found, folder)
        return (
            str(paths["printers"]),
            material or str(paths["materials"]),
            process or DEFAULT_PROCESS,
        )

    def in_words(self, setup: PrintSetup) -> str:
        """One sentence: what was taken from where."""
        printer, made = setup.printer, self.found.profiles[0]
        untold = [words for key, words in _ASKED_FIRST.items() if key not in made.values]
        return (
            f"{self.job}: no --printer is given, so its own settings"
            f"{f' ({self.slicer})' if self.slicer else ''} are taken: {_described(printer)}; "
            f"what they do not tell ({', '.join(untold)}) is {made.inherits}'s"
        )

    def differs_from(self, printer: PrinterProfile) -> str | None:
        """One sentence if the job was sliced for another machine; None where it may be this one."""
        if self.printer_name.startswith(NO_HOSTS):
            return (
                f"{self.job} was sliced for a {self.printer_name}, which takes no G-code from a "
                "host, and has commands of its own (M1002, M620, …); slice it for the printer "
                "that is to print it"
            )
        values = self.found.profiles[0].values
        why = []
        corner_mm = values.get("bed_min_mm", (0.0, 0.0)) if self.bed_size_mm else None
        if self.bed_size_mm is not None and _apart(self.bed_size_mm, printer.bed_size_mm, printer):
            why.append(f"a bed of {_bed(self.bed_size_mm)}, not {_bed(printer.bed_size_mm)}")
        elif corner_mm is not None and _apart(corner_mm, printer.bed_min_mm, printer):
            why.append(f"a bed from {_corner(corner_mm)} on, not {_corner(printer.bed_min_mm)}")
        nozzle_mm = values.get("nozzle_diameter_mm")
        if nozzle_mm is not None and abs(nozzle_mm - printer.nozzle_diameter_mm) > SAME_NOZZLE_MM:
            why.append(f"a nozzle of {nozzle_mm:g} mm, not {printer.nozzle_diameter_mm:g} mm")
        dialect = values.get("dialect")
        understood = {printer.dialect} | dialect_of(printer.dialect).reads
        if dialect is not None and dialect not in understood:
            why.append(f"{dialect}, not {printer.dialect}")
        given = machine_named(printer.name)
        known = self.machine is not None and given is not None
        if not why and not (known and self.machine != given):
            return None
        reasons = f" ({'; '.join(why)})" if why else ""
        remedy = f"--printer {self.machine}" if self.machine else "a profile of that printer"
        return (
            f"{self.job} was sliced for another printer than {printer.name}: for "
            f"'{self.printer_name}'{reasons}; give {remedy}, leave --printer out to take the "
            "job's own settings, or slice it for this one"
        )


@dataclass(frozen=True, slots=True)
class SlicedFor:
    """The profiles that a program of `gcode slice` names.

    Attributes
    ----------
    job
        The program's name.
    ids
        Of printer, material and process: IDs or paths of files.
    """

    job: str
    ids: tuple[str, str, str]

    flow_is_told: ClassVar[bool] = True

    @property
    def machine(self) -> str:
        """The printer's profile."""
        return self.ids[0]

    def setup(self, material: str | None = None, process: str | None = None) -> PrintSetup:
        """These, but for what is named."""
        return load_setup(*self.named(material, process))

    def keep(
        self, folder: Path, material: str | None = None, process: str | None = None
    ) -> tuple[str, str, str]:
        """The three paths or IDs to load; nothing is written."""
        return self.named(material, process)

    def named(self, material: str | None, process: str | None) -> tuple[str, str, str]:
        """IDs or paths of its profiles, but for what is named."""
        return self.ids[0], material or self.ids[1], process or self.ids[2]

    def in_words(self, setup: PrintSetup) -> str:
        """One sentence: what was taken from where."""
        return (
            f"{self.job}: no --printer is given, so {self.ids[0]} is taken, for which it was "
            f"sliced: {_described(setup.printer)}"
        )

    def differs_from(self, printer: PrinterProfile) -> str | None:
        """One sentence if the program was sliced for another machine."""
        own = load_printer(self.ids[0])
        if own.name == printer.name:
            return None
        return (
            f"{self.job} was sliced for another printer than {printer.name}: for '{own.name}'; "
            f"give --printer {self.ids[0]}, leave --printer out, or slice it for this one"
        )


def profiles_line(ids: tuple[str, str, str]) -> str:
    """What a program of ours says of its profiles; paths of files are whole."""
    whole = (str(Path(i).resolve()) if Path(i).suffix == ".toml" else i for i in ids)
    return _SLICED_FOR + ", ".join(whole)


def printer_line(printer: PrinterProfile) -> str:
    """What a program of ours says of its printer, for people, and where its profile is not."""
    bed = "{:g} x {:g}".format(*printer.bed_size_mm)
    return (
        f"{_MADE_FOR}{_in_ascii(printer.name)} ({printer.id}), bed {bed} mm, nozzle "
        f"{printer.nozzle_diameter_mm:g} mm"
    )


def made_for_another(text: str, name: str, printer: PrinterProfile) -> str | None:
    """One sentence where a program of ours names another printer, by name alone."""
    line = re.search(rf"^; {_MADE_FOR}(.+) \((.+)\), bed ", text[:NAMED_WITHIN], re.MULTILINE)
    if line is None or (line[1], line[2]) == (_in_ascii(printer.name), printer.id):
        return None
    return (
        f"{Path(name).name} was made for another printer than {printer.name}: for '{line[1]}' "
        f"({line[2]}), whose profile is to be given by --printer; or make it for this one"
    )


def _in_ascii(text: str) -> str:
    """As the writer of programs puts it."""
    return text.encode("ascii", "replace").decode()


def _sliced_for(text: str, name: str) -> SlicedFor | None:
    """The profiles that a program names, where they are there to be loaded."""
    line = re.search(f"^; {_SLICED_FOR}(.+), (.+), (.+)$", text[:NAMED_WITHIN], re.MULTILINE)
    if line is None:
        return None
    found = SlicedFor(Path(name).name, (line[1], line[2], line[3]))
    try:
        found.setup()
    except ProfileError:  # another machine's file, or another version's
        return None
    return found


def printer_of_words(text: str) -> str:
    """The profile to take for a job without settings: by the firmware whose words it has."""
    spoken = dialect_of_words(text)
    return DEFAULT_PRINTER if spoken is None else f"generic_{spoken}"


@lru_cache(maxsize=16)
def setup_for_head(setup: PrintSetup, text: str, head: int) -> PrintSetup:
    """A job's setup with the material of one of several heads, or filaments.

    As it is where the job tells of one alone, or another material than its own was chosen.
    """
    own = own_settings(text, "job") if setup.printer.heads > 1 else None
    if not isinstance(own, OwnSettings) or _said(own.setup()) != _said(setup):
        return setup
    of_head = own_settings(text, "job", head)
    if not isinstance(of_head, OwnSettings):
        return setup
    return replace(setup, material=of_head.setup().material)


def _said(setup: PrintSetup) -> dict[str, Any]:
    """A material, whatever it is called."""
    return setup.material.model_dump(exclude={"id", "name", "sha256"})


def own_settings(text: str, name: str, head: int | None = None) -> OwnSettings | SlicedFor | None:
    """What a job's slicer wrote into it; None where there is nothing.

    Parameters
    ----------
    text
        The whole job.
    name
        What it is called in messages.
    head
        Whose settings are taken of several heads; of the one that prints most where left out.

    Raises
    ------
    InputError
        If the settings are cut.
    """
    ours = _sliced_for(text, name)
    if ours is not None:
        return ours
    found = import_job(name, text, head=head)
    if found is None:
        return None
    made = found.profiles[0]
    machine = None if made.inherits.startswith("generic") else made.inherits
    told = made.values.get("bed_size_mm")
    size_mm = None if told is None else (told[0], told[1])
    if machine is not None and not _named(made.name, found, machine):
        machine = None  # a dialect's stand-in, no machine that the job names
    return OwnSettings(Path(name).name, generator(text), found, machine, size_mm)


def _named(name: str, found: ImportedFile, machine: str) -> bool:
    models = [row.source_value for row in found.left if row.source_key == "printer_model"]
    return machine_named(*models, name) == machine


def _described(printer: PrinterProfile) -> str:
    return (
        f"{printer.name}, bed {_bed(printer.bed_size_mm)}, {printer.max_z_mm:g} mm high, nozzle "
        f"{printer.nozzle_diameter_mm:g} mm, {printer.dialect}"
    )


def _apart(job_mm: Sequence[float], own_mm: Sequence[float], printer: PrinterProfile) -> bool:
    """Whether X or Y of a job's bed and of the printer's differ by more than makers round."""
    rows = zip(job_mm, own_mm, printer.bed_size_mm, strict=True)
    return any(abs(job - own) > SAME_BED_RATIO * side for job, own, side in rows)


def _corner(at_mm: Sequence[float]) -> str:
    return f"X {at_mm[0]:g} Y {at_mm[1]:g}"


def _bed(size_mm: tuple[float, float]) -> str:
    return f"{size_mm[0]:g} × {size_mm[1]:g} mm"
