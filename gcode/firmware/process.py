"""An emulated printer in a process of its own, for tests, the simulation and the benchmarks.

The child's motion comes over a socket that a thread drains, so that neither side can block the
other; the host under test talks to `port` and to nothing else.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import gcode
from gcode.errors import LinkError
from gcode.firmware.faults import FaultScript, parse_faults
from gcode.firmware.motion import MotionBatch
from gcode.firmware.serve import FRAME, require_terminals
from gcode.profiles import PrinterProfile

if TYPE_CHECKING:
    from gcode.surfaces import HeightField

EMULATOR_ANSWERS_S = 60.0


class EmulatedPrinterProcess:
    """A printer on a pseudo-terminal, in its own operating-system process.

    Parameters
    ----------
    firmware
        marlin, prusa, klipper or reprap.
    faults
        A fault script, as text or read already.
    accelerated
        Let the printer's clock jump over heating and moves; else it follows the wall's.
    record
        File that every command carried out is appended to, one a line.
    standing, lost_mm, dead_probe
        A height map (.npz) of what stands on the bed, which the nozzle feels; how much higher than
        the firmware's own zero the nozzle truly is; and whether its probe never triggers.
    """

    def __init__(
        self,
        firmware: str = "marlin",
        *,
        printer: PrinterProfile,
        faults: FaultScript | str | None = None,
        accelerated: bool = True,
        seed: int = 0,
        record: Path | None = None,
        advanced_ok: bool = False,
        standing: Path | None = None,
        lost_mm: float = 0.0,
        dead_probe: bool = False,
    ) -> None:
        script = parse_faults(faults) if isinstance(faults, str) else faults
        self._folder = tempfile.TemporaryDirectory(prefix="gcode-emulate-")
        self.port = str(Path(self._folder.name) / "ttyEMU0")
        self._options = {
            "firmware": firmware,
            "printer": printer.model_dump(mode="json"),
            "faults": script.text() if script is not None else "",
            "accelerated": accelerated,
            "seed": seed,
            "record": str(record) if record is not None else "",
            "link": self.port,
            "advanced_ok": advanced_ok,
            "standing": str(standing) if standing is not None else "",
            "lost_mm": lost_mm,
            "dead_probe": dead_probe,
        }
        self._answers: queue.SimpleQueue[dict[str, object] | None] = queue.SimpleQueue()
        self._motion: list[MotionBatch] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._start()

    def _start(self) -> None:
        require_terminals()
        ours, theirs = socket.socketpair()
        package_root = str(Path(gcode.__file__).parent.parent)
        path = os.pathsep.join(filter(None, [package_root, os.environ.get("PYTHONPATH", "")]))
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "gcode.firmware.child"],
                stdin=subprocess.PIPE,
                pass_fds=(theirs.fileno(),),
                env={**os.environ, "PYTHONPATH": path},
                start_new_session=True,  # an interrupt is for the host; the host stops us
            )
            options = {**self._options, "control_fd": theirs.fileno()}
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps(options).encode() + b"\n")
            self._process.stdin.close()
        self._socket = ours
        self._reader = threading.Thread(target=self._read, daemon=True, name="emulated-motion")
        self._reader.start()
        try:
            self._answer()
        except BaseException:  # an interrupt: nobody holds yet what would stop the printer
            self.stop()
            raise

    @property
    def pid(self) -> int:
        """Process id of the printer, for those who want to kill it."""
        assert self._process is not None
        return self._process.pid

    def __enter__(self) -> EmulatedPrinterProcess:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def take_motion(self) -> MotionBatch:
        """Return everything executed since the last call, in order."""
        self._ask("motion")
        batches, self._motion = self._motion, []
        return MotionBatch.concatenate(batches)

    def clock_s(self) -> float:
        """Return the printer's own clock, s since power-up."""
        return float(self.state()["clock_s"])  # type: ignore[arg-type]

    def state(self) -> dict[str, object]:
        """Return what the machine really is at, for tests: temperatures, targets, position."""
        return self._ask("state")

    def stand(self, surface: HeightField) -> None:
        """Have this stand on the bed from now on; what feels contact feels it."""
        path = Path(self._folder.name) / "standing.npz"
        surface.write(path)
        self._ask("stand", path=str(path))

    def reset(self) -> None:
        """Press the reset button."""
        self._ask("reset")

    def stop(self) -> None:
        """Switch the printer off and wait until it is gone."""
        process = self._process
        if process is None:
            return
        self._process = None
        with contextlib.suppress(OSError):  # it may be gone already
            self._socket.sendall(b'{"do": "stop"}\n')
        try:
            process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._reader.join(timeout=5)
        self._socket.close()
        self._folder.cleanup()

    def _ask(self, what: str, **more: str) -> dict[str, object]:
        try:
            self._socket.sendall(json.dumps({"do": what, **more}).encode() + b"\n")
        except OSError as error:
            raise LinkError("The emulated printer's process is gone; start it anew.") from error
        return self._answer()

    def _answer(self) -> dict[str, object]:
        try:
            answer = self._answers.get(timeout=EMULATOR_ANSWERS_S)
        except queue.Empty:
            raise LinkError(
                f"The emulated printer has not answered for {EMULATOR_ANSWERS_S:g} s; it may hang."
            ) from None
        if answer is None:
            raise LinkError("The emulated printer's process ended; see its standard error.")
        return answer

    def _read(self) -> None:
        with self._socket.makefile("rb") as stream:
            while True:
                try:
                    head = stream.read(FRAME.size)
                    if len(head) < FRAME.size:
                        break
                    kind, length = FRAME.unpack(head)
                    payload = stream.read(length)
                except OSError:
                    break
                if kind == b"m":
                    self._motion.append(MotionBatch.from_bytes(payload))
                else:
                    self._answers.put(json.loads(payload))
        self._answers.put(None)
