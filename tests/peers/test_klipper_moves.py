"""What the live Klipper's stand makes of the moves that it is told; needs no Klipper."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import live_klipper
import numpy as np
import pytest
from live_klipper import Moves

pytestmark = pytest.mark.peers

BEAD_E_MM = 0.5
TOOLHEAD = [[0.1 * k, 0.1, 10.0, 0.0, [float(k), 0.0, 0.2], [1.0, 0.0, 0.0]] for k in range(4)]
EXTRUDER = [[0.1 * k, 0.1, 5.0, 0.0, [k / 2, 0.0, 0.0], [1.0, 0.0, 0.0]] for k in range(4)]


class Teller:
    """Klipper's API socket, as far as it is asked for moves: it tells them when it is told to."""

    def __init__(self, path: Path) -> None:
        self._server = socket.socket(socket.AF_UNIX)
        self._server.bind(str(path))
        self._server.listen()
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def _answer(self) -> None:
        self._client, _ = self._server.accept()
        for _ in live_klipper.ARMED:
            asked = self._client.recv(4096)
            assert asked.endswith(b"\x03")
            self._send({"id": json.loads(asked[:-1])["id"], "result": {}})

    def _send(self, message: dict[str, object]) -> None:
        self._client.sendall(json.dumps(message).encode() + b"\x03")

    def tell(self, name: str, rows: list[list[object]]) -> None:
        self._send({"armed": name, "params": {"data": rows}})

    def end(self) -> None:
        self._thread.join()
        self._client.close()
        self._server.close()


@pytest.fixture
def teller(tmp_path: Path) -> Iterator[Teller]:
    found = Teller(tmp_path / "klippy.sock")
    yield found
    found.end()


def test_moves_are_told_after_a_rest_longer_than_any_answer(
    teller: Teller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look rests the printer for a minute; the patch after it was missing from the record."""
    monkeypatch.setattr(live_klipper, "ANSWER_S", 0.1)
    with Moves(tmp_path / "klippy.sock") as moves:
        assert len(moves.take(settle_s=0.3)) == 0
        teller.tell("toolhead", TOOLHEAD)
        teller.tell("extruder", EXTRUDER)
        moved = moves.take()
    assert moved.end_mm[-1] == pytest.approx([4.0, 0.0, 0.2])
    assert moved.filament_mm == pytest.approx(4 * [BEAD_E_MM])


def test_a_bead_keeps_its_filament_though_it_is_asked_for_between_its_two_messages(
    teller: Teller, tmp_path: Path
) -> None:
    with Moves(tmp_path / "klippy.sock") as moves:
        teller.tell("toolhead", TOOLHEAD)
        early = moves.take(settle_s=0.3)
        teller.tell("extruder", EXTRUDER)
        batches = [early, moves.take()]
    filament_mm = np.concatenate([batch.filament_mm for batch in batches])
    way_mm = np.concatenate([batch.end_mm - batch.start_mm for batch in batches])
    assert filament_mm == pytest.approx(4 * [BEAD_E_MM])
    assert way_mm[:, 0] == pytest.approx(4 * [1.0])


def test_a_record_that_breaks_off_is_told(teller: Teller, tmp_path: Path) -> None:
    with Moves(tmp_path / "klippy.sock") as moves:
        teller.end()
        with pytest.raises(ConnectionError, match="tells its moves no more"):
            moves.take(settle_s=0.3)
