"""A real OctoPrint of its own environment, with what it is begun with."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from peer_harness import Web, free_port, peer, process, wait_for

from gcode.hosts.octoprint import OctoPrintPrinter
from gcode.hosts.secret import ApiKey
from gcode.hosts.web import Address, WebTiming

KEY = "0123456789ABCDEF0123456789ABCDEF"
# Nothing is looked up outside, nothing reports home.
CONFIG = """\
api: {{key: {key}}}
server:
  firstRun: false
  onlineCheck: {{enabled: false}}
  pluginBlacklist: {{enabled: false}}
plugins:
  _disabled: [tracking, softwareupdate, announcements, discovery, errortracking, pi_support, backup]
  virtual_printer: {{enabled: true, waitInterval: 0.2}}
serial:
  autoconnect: true
  port: {port}
  baudrate: 115200
  additionalPorts: [{port}]
accessControl:
  autologinLocal: true
  autologinAs: me
  autologinHeadsupAcknowledged: true
  localNetworks: [127.0.0.0/8]
"""
QUICK = WebTiming(answer_s=20.0, lost_s=30.0, poll_s=0.2)


@dataclass
class Server:
    base: str
    log: Path
    running: subprocess.Popen[bytes]

    def printer(self) -> OctoPrintPrinter:
        return OctoPrintPrinter(Address.parse(f"octoprint+{self.base}"), ApiKey(KEY), timing=QUICK)


@contextmanager
def octoprint(
    folder: Path, port: str, *, number: int | None = None, plugins: dict[str, str] | None = None
) -> Iterator[Server]:
    """Run one, with files of plugins; begun anew in the same folder it has what it had."""
    base = folder / "octoprint"
    log, number = folder / "octoprint.log", number or free_port()
    if not base.exists():
        (base / "plugins").mkdir(parents=True)
        (base / "config.yaml").write_text(CONFIG.format(key=KEY, port=port))
        for name, text in (plugins or {}).items():
            (base / "plugins" / name).write_text(text)
    python = peer("octoprint")
    # nothing of ours is on its path but what is installed there
    command = ["env", "-u", "PYTHONPATH", python, "-m", "octoprint", "--basedir", str(base)]
    subprocess.run(
        [*command, "user", "add", "me", "--password", "none", "--admin"],
        check=True,
        capture_output=True,
    )
    serve = [*command, "serve", "--host", "127.0.0.1", "--port", str(number), "--no-color"]
    if os.geteuid() == 0:
        serve.append("--iknowwhatimdoing")
    with process(*serve, log=log) as running:
        web = Web(f"http://127.0.0.1:{number}", KEY)
        ready = lambda: web.get("/api/connection").get("current", {}).get("state") == "Operational"  # noqa: E731
        wait_for("OctoPrint is operational", ready, log)
        yield Server(web.base, log, running)
        web.http.close()
