"""What every test beside a peer shares."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))


@pytest.fixture(autouse=True)
def _no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs of the link's own tests; the checker's refusals are not the subject here."""
    for name in ("serial", "server"):
        monkeypatch.setattr(f"gcode.hosts.{name}.require_checked", lambda checked: None)
