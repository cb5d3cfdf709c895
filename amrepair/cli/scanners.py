"""Scanners by what is typed, `--scanner KIND:WHERE`: one table of how each kind is opened.

A new kind is a row of `SCANNERS`. A scanner of one's own needs none: `python:FILE` loads it.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from amrepair.errors import AmrepairError, InputError, ScannerError
from amrepair.frames import Transform
from amrepair.scans import PROBE, Scan, Scanner, ScanRequest, WatchedFolderScanner
from gcode.hosts.port import Printer
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.reader import Job

MAKER = "open_scanner"  # the function that a scanner's file defines


@dataclass(frozen=True, slots=True)
class Bed:
    """The bed that a scanner looks at, and how.

    Attributes
    ----------
    build_from_scanner
        Where it hangs, by its calibration.
    timeout_s
        How long it may take to answer.
    setup
        The printer below it.
    seed
        Of what is simulated.
    printer, job
        The printer itself, connected, and what it prints: for its own probe, which touches.
    progress
        Told of touches.
    scan_unit
        Of the files that a watched folder gets, where they do not say it; None is mm.
    """

    build_from_scanner: Transform
    timeout_s: float
    setup: PrintSetup
    seed: int = 0
    printer: Printer | None = None
    job: Job | None = None
    progress: Progress = silent
    scan_unit: str | None = None


@dataclass(frozen=True, slots=True)
class OwnScanner:
    """A scanner from a file of the user's; whatever goes wrong in it is a `ScannerError`."""

    path: Path
    scanner: Scanner

    @property
    def build_from_scanner(self) -> Transform:
        """Calibrated pose, as the file's scanner says it."""
        return self.scanner.build_from_scanner

    def scan(self, request: ScanRequest) -> Scan:
        """Return what the scanner measures.

        Raises
        ------
        ScannerError
            If it raises anything, or what it answers is no scan.
        """
        try:
            found = self.scanner.scan(request)
        except AmrepairError:
            raise
        except Exception as e:  # code that is not ours: any error may come
            raise ScannerError(
                f"{self.path}: the scanner failed at {request.label} ({type(e).__name__}: {e})"
            ) from e
        if not isinstance(found, Scan):
            raise ScannerError(
                f"{self.path}: the scanner answered {request.label} with a "
                f"{type(found).__name__}; it must return an amrepair.Scan"
            )
        return found


def _watched(where: str, bed: Bed) -> Scanner:
    return WatchedFolderScanner(
        Path(where), build_from_scanner=bed.build_from_scanner, timeout_s=bed.timeout_s,
        unit=bed.scan_unit,
    )  # fmt: skip


def _simulated(where: str, bed: Bed) -> Scanner:
    from amrepair.simulate.live import PrintedScanner
    from amrepair.simulate.parameters import DEFAULT_SCANNER, load_world
    from gcode.firmware.motion import MotionFile

    return PrintedScanner(
        MotionFile(Path(where)),
        printer=bed.setup.printer,
        pose=bed.build_from_scanner,
        told=load_world(),
        scanner=DEFAULT_SCANNER,
        seed=bed.seed,
    )


def _own(where: str, bed: Bed) -> Scanner:
    path = Path(where)
    try:
        make = runpy.run_path(str(path), run_name="amrepair_scanner").get(MAKER)
        scanner = make(bed.build_from_scanner) if callable(make) else None
    except AmrepairError:
        raise
    except Exception as e:  # code that is not ours: any error may come
        raise InputError(f"--scanner python:{path}: {type(e).__name__}: {e}") from e
    if not isinstance(scanner, Scanner):
        raise InputError(
            f"--scanner python:{path}: the file must define {MAKER}(build_from_scanner), which "
            "returns an object with build_from_scanner and scan(request)"
        )
    return OwnScanner(path, scanner)


def _probe(where: str, bed: Bed) -> Scanner:
    from amrepair.loop.probing import PortFeeler, ProbeScanner

    if bed.printer is None or bed.job is None:
        raise InputError(
            "--scanner probe touches what a job has laid: it is for 'amrepair loop', 'agent' and "
            "'simulate', and needs no calibration"
        )
    feeler = PortFeeler(bed.printer, bed.setup)
    return ProbeScanner(feeler, bed.job, bed.setup, progress=bed.progress)


@dataclass(frozen=True, slots=True)
class ScannerKind:
    """A kind of scanner.

    Attributes
    ----------
    open
        Opens what is named after the colon.
    there
        Whether that is there already; asked before any work, and opens nothing.
    alone
        Nothing is named: there is no colon.
    """

    open: Callable[[str, Bed], Scanner]
    there: Callable[[Path], bool]
    alone: bool = False


SCANNERS: dict[str, ScannerKind] = {
    "watch": ScannerKind(_watched, Path.is_dir),
    "simulated": ScannerKind(_simulated, lambda _: True),  # the file comes with the first move
    "python": ScannerKind(_own, Path.is_file),
    PROBE: ScannerKind(_probe, lambda _: True, alone=True),
}


def known_scanner(typed: str) -> ScannerKind:
    """The kind of scanner that `--scanner` names; nothing is opened.

    Raises
    ------
    InputError
        If there is no such kind, or its folder or file is not there.
    """
    kind, colon, where = typed.partition(":")
    known = SCANNERS.get(kind)
    if known is None or (bool(colon) if known.alone else not where):
        raise InputError(
            f"--scanner is {typed!r}; give watch:DIR, python:FILE with a scanner of your own, "
            "probe for the printer's own, or simulated:FILE with the motion of an emulated printer "
            "('gcode emulate --motion FILE')"
        )
    if not known.there(Path(where)):
        raise InputError(f"--scanner {typed}: {where} is not there; create it first")
    return known


def open_scanner(typed: str, bed: Bed) -> Scanner:
    """The scanner that `--scanner` names.

    Raises
    ------
    InputError
        If there is no such kind, or it cannot be opened.
    """
    return known_scanner(typed).open(typed.partition(":")[2], bed)
