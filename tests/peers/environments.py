"""Puts every peer into an environment of its own: `.peers/NAME`, made anew when its pins change.

Run: `python tests/peers/environments.py [NAME…]`. Peers are programs that we are compared with or
talk to; none of them is a dependency.
"""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2] / ".peers"
PEERS: dict[str, tuple[str, ...]] = {
    "octoprint": ("OctoPrint==1.11.8",),
    "moonraker": ("moonraker==0.11.0",),
    "moto": ("moto[server]==5.2.5",),  # speaks S3
    # Its other dependencies are for the windowed program, and one of them does not build.
    "printrun": ("--no-deps", "printrun==2.2.0", "pyserial==3.5", "platformdirs"),
}

# Where our own package is put, too, without what it needs to look and plan: OctoPrint's plugin.
WITH_US = {"octoprint": ("--no-deps", "--editable", str(ROOT.parent))}


def python_of(name: str) -> Path:
    """Return the interpreter of a peer's environment."""
    return ROOT / name / "bin" / "python"


def make(name: str) -> None:
    """Make an environment unless it is there as wanted."""
    stamp, wanted = ROOT / name / "installed", " ".join((*PEERS[name], *WITH_US.get(name, ())))
    if stamp.is_file() and stamp.read_text() == wanted:
        return
    venv.create(ROOT / name, with_pip=True, clear=True)
    for packages in filter(None, (PEERS[name], WITH_US.get(name))):
        subprocess.run([python_of(name), "-m", "pip", "install", "--quiet", *packages], check=True)
    stamp.write_text(wanted)


def main() -> None:
    """Make all, or those that are named; say which could not be made."""
    failed = []
    for name in sys.argv[1:] or PEERS:
        print(f"{name}: {' '.join(PEERS[name])}", flush=True)
        try:
            make(name)
        except subprocess.CalledProcessError:
            failed.append(name)
    if failed:
        sys.exit(f"these peers could not be installed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
