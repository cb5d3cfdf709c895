"""A broken file is refused before whatever would judge it is loaded: in well under two seconds."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

HEAVY = ("scipy.stats", "trimesh", "torch", "open3d", "amrepair.align", "amrepair.repair")
RUN = """
import json, re, sys
from pathlib import Path
from amrepair.cli import main
ends = []
for words in json.loads(sys.argv[1]):
    sys.argv = ["amrepair", *words]
    try:
        main()
    except SystemExit as end:
        ends.append(end.code)
# not ru_maxrss: Linux counts what the parent held before this process began as its own
status = Path("/proc/self/status").read_text()
kilobytes = int(re.search(r"VmHWM:\\s+(\\d+)", status).group(1))
print(json.dumps([ends, sorted(set(sys.modules) & set(HEAVY)), kilobytes]))
"""


def bomb(path: Path) -> Path:
    """Half a megabyte that would unpack to 500."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("3D/3dmodel.model", "w", force_zip64=True) as part,
    ):
        part.write(b"<model>")
        for _ in range(250):
            part.write(bytes([32]) * 2**21)
    return path


def promising(path: Path) -> Path:
    """An array of 745 GB, of which there is a kilobyte."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 1000000), }\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(1000))
    return path


def test_what_is_refused_waits_for_nothing(tmp_path: Path) -> None:
    mesh, array = str(bomb(tmp_path / "bomb.3mf")), str(promising(tmp_path / "huge.npy"))
    template = ["--template", str(tmp_path / "part.stl")]
    commands = [
        ["template", "fit", mesh, "-o", str(tmp_path / "x.safetensors")],
        ["simulate", mesh, "--out", str(tmp_path / "run")],
        ["align", array, *template],
        ["detect", array, *template, "--out", str(tmp_path / "out")],
        ["repair", mesh, *template, "-o", str(tmp_path / "x.gcode")],
        ["view", array],
    ]
    script = f"HEAVY = {HEAVY!r}\n{RUN}"
    done = subprocess.run(
        [sys.executable, "-c", script, json.dumps(commands)],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    ends, loaded, kilobytes = json.loads(done.stdout.strip().splitlines()[-1])
    assert ends == [2] * len(commands)
    assert loaded == []
    assert kilobytes < 500_000
    assert done.stderr.count("amrepair: ") == len(commands)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bomb.3mf", "huge.npy"]
