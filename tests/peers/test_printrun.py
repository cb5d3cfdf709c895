"""Printrun's printcore prints a file through our emulated printer."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from link_helpers import moves, profile
from peer_harness import HERE, peer

from gcode.firmware import EmulatedPrinterProcess

pytestmark = pytest.mark.peers

OWN = ("M105", "M110")  # what printcore asks of its own accord


def test_printcore_prints_through_our_emulator(tmp_path: Path) -> None:
    lines = ["G28", "M83", "G90", "M83", *moves(500)]
    job, record = tmp_path / "job.gcode", tmp_path / "executed"
    job.write_text("\n".join(lines) + "\n")
    with EmulatedPrinterProcess(printer=profile(), record=record) as emulator:
        done = subprocess.run(
            [peer("printrun"), HERE / "printcore_send.py", emulator.port, job],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    executed = [row for row in record.read_text().splitlines() if not row.startswith(OWN)]
    assert executed == lines
