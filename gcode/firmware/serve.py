"""Puts the emulated printer on a pseudo-terminal, in this process, and serves it.

The port's path is a link that stays while the pseudo-terminal behind it comes and goes
(disconnect faults). A control socket, where given, asks for motion and state; without one it
serves until interrupted. Frames on the socket, both ways: kind (1 byte), length (4), payload.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from gcode.errors import InputError
from gcode.firmware.core import FirmwareCore
from gcode.firmware.faults import FaultScript
from gcode.profiles import PrinterProfile

FRAME = struct.Struct("<cI")
MOTION_FRAME_NUMBERS = 9 * 2000
"""Motion is sent on every 2,000 moves, so that the child's memory stays flat."""
IDLE_S = 0.01
"""Nothing heard for this long: the printer goes on with what it has buffered."""


def require_terminals() -> None:
    """Raise InputError where no pseudo-terminal can be had."""
    if sys.platform == "win32":
        raise InputError(
            "an emulated printer needs a pseudo-terminal, which Linux and macOS have; on Windows "
            "use WSL"
        )


class PtyServer:
    """One emulated printer on one pseudo-terminal.

    Parameters
    ----------
    link
        Path of the link to create, pointing to the pseudo-terminal.
    control
        Socket of the parent, or None.
    motion
        File that executed moves are appended to, before anything is answered; or None.
    """

    def __init__(
        self,
        core: FirmwareCore,
        link: Path,
        *,
        control: socket.socket | None = None,
        motion: BinaryIO | None = None,
    ) -> None:
        self.core = core
        self.link = link
        self._control = control
        self._motion = motion
        self._control_in = b""
        self._start_s = time.monotonic()
        self._idle_from_s = self._start_s
        self._stopping = False
        slow = core.faults.always.get("slow_reader")
        self._slow_s = 0.0 if slow is None else (slow.value or 0.001)
        self._open()

    def _open(self) -> None:
        require_terminals()
        import termios
        import tty

        if self.link.exists() and not self.link.is_symlink():
            raise InputError(f"{self.link} is there already and no port of ours; name another.")
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[3] &= ~termios.ECHO
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        temporary = self.link.with_name(self.link.name + ".new")
        try:
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(os.ttyname(self._slave))
            temporary.replace(self.link)
        except OSError as error:
            self._close()
            raise InputError(f"{self.link} cannot be made ({error.strerror}).") from error

    def _close(self) -> None:
        for fd in (self._slave, self._master):
            os.close(fd)

    def serve(self) -> None:
        """Serve until the control socket closes or `stop` is asked for."""
        self.core.power_up()
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        if self._control is not None:
            poll.register(self._control, select.POLLIN)
        try:
            while not self._stopping:
                ready = poll.poll(self._timeout_ms())
                for fd, _ in ready:
                    if fd == self._master:
                        self._from_host()
                    else:
                        self._from_parent()
                self._go_on(idle=not ready)
                if self.core.hang_up_s is not None:
                    poll.unregister(self._master)
                    self._hang_up()
                    poll.register(self._master, select.POLLIN)
        finally:
            self._close()
            self.link.unlink(missing_ok=True)

    def _timeout_ms(self) -> float | None:
        if self.core.accelerated and self.core.mute_until_s == -math.inf:
            if self.core.machine.planner.blocks:
                return IDLE_S * 1000
            return 1000.0
        return IDLE_S * 1000

    def _from_host(self) -> None:
        try:
            data = os.read(self._master, 512 if self._slow_s else 65536)
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return
        self.core.feed(data, time.monotonic())
        if self._slow_s:
            time.sleep(self._slow_s * max(1, data.count(b"\n")))

    def _go_on(self, *, idle: bool) -> None:
        core, now_s = self.core, time.monotonic()
        wall_s = now_s - self._start_s
        core.run(math.inf if core.accelerated else wall_s, now_s)
        machine = core.machine
        if not core.accelerated:
            core.pass_time(wall_s)
        elif idle:
            core.drain()
            # Accelerated time never runs slower than the wall's.
            core.pass_time(machine.clock_s + now_s - self._idle_from_s)
        self._idle_from_s = now_s
        if self._motion is not None and machine.planner.executed:
            self._motion.write(machine.planner.executed.tobytes())
            self._motion.flush()
            machine.forget_executed()
        data = core.take_output()
        if data:
            self._write(data)
        if len(machine.planner.executed) >= MOTION_FRAME_NUMBERS:
            if self._control is not None:
                self._send_motion()
            else:
                machine.forget_executed()  # nobody asks for it

    def _write(self, data: bytes) -> None:
        """Write as much as the host reads; what a full, unread port cannot take is lost."""
        view = memoryview(data)
        while view:
            try:
                view = view[os.write(self._master, view) :]
            except BlockingIOError:
                if not select.select([], [self._master], [], 0.5)[1]:
                    return

    def _hang_up(self) -> None:
        pause_s, self.core.hang_up_s = self.core.hang_up_s or 0.0, None
        self._close()
        self.link.unlink(missing_ok=True)
        time.sleep(pause_s)
        self.core.take_output()
        self._open()

    # ------------------------------------------------------------------ the parent

    def _from_parent(self) -> None:
        assert self._control is not None
        data = self._control.recv(4096)
        if not data:
            self._stopping = True  # the parent is gone
            return
        self._control_in += data
        while b"\n" in self._control_in:
            line, _, self._control_in = self._control_in.partition(b"\n")
            self._request(json.loads(line))

    def _request(self, request: dict[str, object]) -> None:
        core = self.core
        what = request["do"]
        if what == "motion":
            self._send_motion()
        elif what == "reset":
            core.power_up()
        elif what == "stand":
            from gcode.surfaces import HeightField

            core.machine.stand(HeightField.read(Path(str(request["path"]))))
        elif what == "stop":
            self._stopping = True
        machine = core.machine
        self._frame(
            b"a",
            json.dumps(
                {
                    "clock_s": machine.clock_s,
                    "lines": core.lines_seen,
                    "last_number": core.last_number,
                    "killed": machine.killed,
                    "hotend_c": machine.hotend.temperature_c(machine.clock_s),
                    "hotend_target_c": machine.hotend.target_c,
                    "hotend_targets_c": [one.target_c for one in machine.heads.heaters],
                    "bed_c": machine.bed.temperature_c(machine.clock_s),
                    "bed_target_c": machine.bed.target_c,
                    "motors_let_go": machine.let_go,
                    "fan_ratio": machine.fan_ratio,
                    "position_mm": [machine.x, machine.y, machine.z],
                    "buffered": len(machine.planner.blocks),
                    "logical_z_mm": machine.z + machine.offset[2],
                    "deepest_mm": machine.contact.deepest_mm if machine.contact else 0.0,
                }
            ).encode(),
        )

    def _send_motion(self) -> None:
        executed = self.core.machine.planner.executed
        if executed:
            self._frame(b"m", executed.tobytes())
            self.core.machine.forget_executed()

    def _frame(self, kind: bytes, payload: bytes) -> None:
        assert self._control is not None
        try:
            self._control.sendall(FRAME.pack(kind, len(payload)) + payload)
        except (BrokenPipeError, ConnectionResetError):
            self._stopping = True


def serve_forever(
    profile: PrinterProfile,
    *,
    firmware: str = "marlin",
    faults: FaultScript | None = None,
    link: Path,
    accelerated: bool = False,
    motion: Path | None = None,
    on_port: Callable[[str], None] | None = None,
) -> None:
    """Serve an emulated printer until interrupted (the command line's `gcode emulate`).

    Parameters
    ----------
    link
        Where the port's path is made.
    motion
        File that executed moves are appended to (see `gcode.firmware.motion.MotionFile`).
    on_port
        Told the path once it can be opened.

    Raises
    ------
    InputError
        If that file cannot be opened.
    """
    core = FirmwareCore(profile, firmware, faults=faults, accelerated=accelerated)
    if profile.probe is not None:
        core.machine.feel_what_is_laid()
    with contextlib.ExitStack() as stack:
        file: BinaryIO | None = None
        if motion is not None:
            try:
                file = stack.enter_context(motion.open("ab"))
            except OSError as error:
                raise InputError(
                    f"{motion}: the motion cannot be written ({error.strerror})."
                ) from error
        server = PtyServer(core, link, motion=file)
        if on_port is not None:
            on_port(str(link))
        with contextlib.suppress(KeyboardInterrupt):
            server.serve()
