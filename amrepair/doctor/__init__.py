"""Doctor: whether this machine can do what amrepair asks of it, and how to fix what it cannot.

It looks and reports; it installs, changes and repairs nothing. Each check is one function that
returns a `CheckFinding`. Only the standard library is imported up here: the doctor must be able to
speak where everything else fails to load.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module, metadata
from pathlib import Path

from amrepair.device import open3d, torch_device
from amrepair.errors import AmrepairError

OLDEST_PYTHON = (3, 11)
# A run of the demo leaves 60 MB, a template in the cache 10 MB.
LEAST_DISK_MB = 200.0
ENOUGH_DISK_MB = 1000.0
# Compiled libraries: installed is not yet loadable.
COMPILED = ("manifold3d", "numba", "scipy", "shapely", "kiss_matcher")


class State(StrEnum):
    """What a finding means for the user."""

    OK = "ok"
    NOTE = "note"  # works, though something is worth knowing
    BAD = "bad"  # some command will fail


@dataclass(frozen=True, slots=True)
class CheckFinding:
    """What one check found.

    Attributes
    ----------
    name
        What was looked at.
    found
        What is there, in one sentence.
    mend
        What to do about it; empty where nothing need be done.
    """

    name: str
    state: State
    found: str
    mend: str = ""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port as the system lists it."""

    device: str
    description: str = ""


def examine(progress: Callable[[str], None] = lambda name: None) -> tuple[CheckFinding, ...]:
    """Run every check.

    Parameters
    ----------
    progress
        Told the name of each check before it runs: loading torch takes seconds.
    """
    checks: dict[str, Callable[[], CheckFinding]] = {
        "python": check_python,
        "libraries": check_libraries,
        "torch": check_torch,
        "open3d": check_open3d,
        "profiles": check_profiles,
        "serial ports": check_serial_ports,
        "emulated printer": check_terminals,
        "disk": check_disk,
        "cache": check_cache,
    }
    found = []
    for name, check in checks.items():
        progress(name)
        try:
            found.append(check())
        except Exception as error:  # noqa: BLE001  what nobody thought of is a finding, too
            trouble = f"the check itself failed: {type(error).__name__}: {error}"
            found.append(CheckFinding(name, State.BAD, trouble, "report this as a bug"))
    return tuple(found)


def check_python(version: tuple[int, int, int] = sys.version_info[:3]) -> CheckFinding:
    """Python's version."""
    found = f"{'.'.join(map(str, version))} on {platform.system()} {platform.machine()}"
    if version[:2] >= OLDEST_PYTHON:
        return CheckFinding("python", State.OK, found)
    wanted = ".".join(map(str, OLDEST_PYTHON))
    return CheckFinding(
        "python",
        State.BAD,
        found,
        f"install Python {wanted} or newer and make a new environment with it",
    )


def check_libraries(requirements: Iterable[str] | None = None) -> CheckFinding:
    """Every library that amrepair declares is installed, and the compiled ones load."""
    if requirements is None:
        try:
            requirements = metadata.requires("amrepair") or ()
        except metadata.PackageNotFoundError:
            requirements = ()
    names = [_name_of(line) for line in requirements if "extra ==" not in line]
    missing = []
    for name in names:
        try:
            metadata.version(name)
        except metadata.PackageNotFoundError:
            missing.append(name)
    broken = []
    for name in COMPILED:
        try:
            import_module(name)
        except (ImportError, OSError) as error:
            broken.append(f"{name} ({error})")
    if missing or broken:
        what = [f"missing: {', '.join(missing)}"] if missing else []
        what += [f"cannot be loaded: {', '.join(broken)}"] if broken else []
        return CheckFinding(
            "libraries",
            State.BAD,
            "; ".join(what),
            "pip install --force-reinstall --constraint constraints.txt amrepair",
        )
    return CheckFinding(
        "libraries", State.OK, f"all {len(names)} are installed, compiled ones load"
    )


def _name_of(requirement: str) -> str:
    found = re.match(r"[A-Za-z0-9._-]+", requirement)
    return found.group(0) if found else requirement


def check_torch() -> CheckFinding:
    """Torch loads, and which device it will use."""
    try:
        import torch

        device = torch_device()
    except (ImportError, OSError, AmrepairError) as error:
        return CheckFinding(
            "torch",
            State.BAD,
            f"cannot be loaded ({error})",
            "pip install --force-reinstall torch (for a machine without a GPU with the --index-url "
            "that PyTorch's installation page gives for CPU); only fitting templates needs it",
        )
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        return CheckFinding("torch", State.OK, f"{torch.__version__}, on {name}")
    threads = torch.get_num_threads()
    return CheckFinding(
        "torch",
        State.OK,
        f"{torch.__version__}, on the CPU with {threads} threads (a template takes about 15 s)",
    )


def check_open3d(load: Callable[[], object] = open3d) -> CheckFinding:
    """open3d and the system libraries that its wheel links to."""
    try:
        module = load()
    except (AmrepairError, ImportError, OSError) as error:
        return CheckFinding(
            "open3d",
            State.BAD,
            str(error),
            "install the system's libraries: 'apt-get install libusb-1.0-0 libgl1 libgomp1' "
            "(Debian, Ubuntu) or 'dnf install libusb1 mesa-libGL libgomp' (Fedora)",
        )
    return CheckFinding("open3d", State.OK, f"{getattr(module, '__version__', '?')}, loads")


def check_profiles(folder: Path | None = None) -> CheckFinding:
    """Every shipped profile loads, and the three defaults go together."""
    from gcode.errors import GcodeError
    from gcode.profiles import load_material, load_printer, load_process, load_setup, profile_dir

    where = folder or profile_dir()
    count, wrong = 0, []
    loaders: dict[str, Callable[[str | Path], object]] = {
        "printers": load_printer,
        "materials": load_material,
        "processes": load_process,
    }
    for kind, load in loaders.items():
        for path in sorted((where / kind).glob("*.toml")):
            count += 1
            try:
                load(path)
            except GcodeError as error:
                wrong.append(str(error))
    try:
        load_setup()
    except GcodeError as error:
        wrong.append(str(error))
    if wrong or not count:
        return CheckFinding(
            "profiles",
            State.BAD,
            " ".join(wrong) or f"there is none in {where}",
            "undo changes in that folder, or install amrepair again",
        )
    return CheckFinding("profiles", State.OK, f"all {count} load from {where}")


def _listed_ports() -> tuple[SerialPort, ...]:
    """USB ports of this machine; the mainboard's own ttyS ports carry no printer."""
    from serial.tools import list_ports

    return tuple(
        SerialPort(port.device, port.description or "")
        for port in sorted(list_ports.comports(), key=lambda port: str(port.device))
        if port.vid is not None or "ttyS" not in port.device
    )


def check_serial_ports(
    ports: Sequence[SerialPort] | None = None,
    access: Callable[[str, int], bool] = os.access,
) -> CheckFinding:
    """Printers on USB, and whether this user may open them."""
    listed = _listed_ports() if ports is None else tuple(ports)
    if not listed:
        return CheckFinding(
            "serial ports",
            State.NOTE,
            "none is there",
            "switch the printer on and plug its USB cable in (a container needs "
            "--device /dev/ttyACM0); simulation and files need no port",
        )
    closed = [port for port in listed if not access(port.device, os.R_OK | os.W_OK)]
    names = ", ".join(
        f"{port.device} ({port.description})" if port.description else port.device
        for port in listed
    )
    if not closed:
        return CheckFinding("serial ports", State.OK, names)
    group = _group_of(closed[0].device)
    return CheckFinding(
        "serial ports",
        State.BAD,
        f"{names}; no permission to open {', '.join(port.device for port in closed)}",
        f"sudo usermod -aG {group} $USER, then log out and in again",
    )


def _group_of(device: str) -> str:
    """The group that may open a device; `dialout` where it cannot be told."""
    with suppress(ImportError, KeyError, OSError):
        import grp

        status = Path(device).stat()
        if status.st_mode & stat.S_IWGRP and status.st_gid != 0:
            return grp.getgrgid(status.st_gid).gr_name
    return "dialout"


def check_terminals() -> CheckFinding:
    """A pseudo-terminal can be opened: the emulated printer is one."""
    try:
        ends = os.openpty()
    except (OSError, AttributeError) as error:
        return CheckFinding(
            "emulated printer",
            State.BAD,
            f"no pseudo-terminal can be opened ({error})",
            "on Linux mount devpts at /dev/pts; on Windows use WSL: 'simulate' and 'emulate' "
            "need one, repairs from files do not",
        )
    for end in ends:
        os.close(end)
    return CheckFinding("emulated printer", State.OK, "pseudo-terminals can be opened")


def check_disk(
    folder: Path | None = None, free_mb: Callable[[Path], float] | None = None
) -> CheckFinding:
    """Room for a run where commands write by default: the current folder."""
    where = (folder or Path.cwd()).resolve()
    free = (free_mb or _free_mb)(where)
    found = f"{free / 1000:.1f} GB are free in {where}"
    if free >= ENOUGH_DISK_MB:
        return CheckFinding("disk", State.OK, found)
    return CheckFinding(
        "disk",
        State.NOTE if free >= LEAST_DISK_MB else State.BAD,
        found,
        f"free {ENOUGH_DISK_MB / 1000:g} GB, or write elsewhere with --out (a run takes about "
        "60 MB)",
    )


def _free_mb(folder: Path) -> float:
    return shutil.disk_usage(folder).free / 1e6


def check_cache(folder: Path | None = None) -> CheckFinding:
    """Fitted templates can be kept: a file is really written there and removed."""
    from amrepair.template import default_cache_dir

    where = folder or default_cache_dir()
    try:
        where.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=where, prefix=".doctor-") as probe:
            probe.write(b"amrepair")
            probe.flush()
    except OSError as error:
        return CheckFinding(
            "cache",
            State.BAD,
            f"{where} cannot be written ({error.strerror}): every run would fit its template anew",
            "make the folder writable, or set XDG_CACHE_HOME to one that is",
        )
    kept = list(where.glob("*.safetensors"))
    size_mb = sum(path.stat().st_size for path in kept) / 1e6
    return CheckFinding("cache", State.OK, f"{where}, {len(kept)} templates, {size_mb:.0f} MB")
