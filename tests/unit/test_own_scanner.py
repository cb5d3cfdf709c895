"""`--scanner python:FILE`: a scanner of the user's own, and what is said of one that is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amrepair.cli.scanners import SCANNERS, Bed, known_scanner, open_scanner
from amrepair.errors import InputError, ScannerError
from amrepair.frames import Transform
from amrepair.scans import ScanRequest, WatchedFolderScanner
from gcode.profiles import load_setup

GOOD = """
import numpy as np
from amrepair import Scan

class Mine:
    def __init__(self, pose):
        self.build_from_scanner = pose
    def scan(self, request):
        if request.label == "cable":
            raise OSError("no cable")
        if request.label == "points":
            return np.zeros((3, 3))
        return Scan(np.eye(3), 0.05, "scanner", source=request.label)

def open_scanner(build_from_scanner):
    return Mine(build_from_scanner)
"""
POSE = Transform.from_rotation_translation(
    "build", "scanner", rotation=np.eye(3), translation_mm=np.array([1.0, 2.0, 3.0])
)


def bed() -> Bed:
    return Bed(POSE, 5.0, load_setup())


def test_the_file_s_scanner_is_asked_and_its_pose_is_the_calibration_s(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(GOOD)
    scanner = open_scanner(f"python:{tmp_path / 'mine.py'}", bed())
    assert np.array_equal(scanner.build_from_scanner.matrix, POSE.matrix)
    scan = scanner.scan(ScanRequest("layer-003", 3, 0.8))
    assert scan.source == "layer-003"
    assert np.array_equal(scan.points_mm, np.eye(3))
    with pytest.raises(ScannerError, match=r"mine\.py: .*cable \(OSError: no cable\)"):
        scanner.scan(ScanRequest("cable", None, 0.0))
    with pytest.raises(ScannerError, match="points with a ndarray; it must return"):
        scanner.scan(ScanRequest("points", None, 0.0))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "is not there"),
        ("x = 1\n", "must define open_scanner"),
        ("def open_scanner(pose):\n    return 3\n", "must define open_scanner"),
        ("import no_such_library\n", "ModuleNotFoundError"),
        ("def open_scanner(:\n", "SyntaxError"),
        ("def open_scanner(pose):\n    raise OSError('in use')\n", "OSError: in use"),
    ],
)
def test_a_file_that_is_no_scanner_is_refused_in_a_sentence(
    tmp_path: Path, text: str | None, why: str
) -> None:
    path = tmp_path / "mine.py"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=why) as caught:
        open_scanner(f"python:{path}", bed())
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("typed", ["watch", "watch:", "camera:0", ""])
def test_kinds_that_there_are_not_are_refused(typed: str) -> None:
    with pytest.raises(InputError, match="give watch:DIR, python:FILE"):
        open_scanner(typed, bed())


def test_a_scanner_is_known_without_being_opened(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("raise OSError('the camera was opened')\n")
    known_scanner(f"python:{path}")
    with pytest.raises(InputError, match="is not there; create it first"):
        known_scanner(f"watch:{tmp_path / 'absent'}")


def test_a_folder_is_watched(tmp_path: Path) -> None:
    assert isinstance(open_scanner(f"watch:{tmp_path}", bed()), WatchedFolderScanner)
    assert set(SCANNERS) == {"watch", "simulated", "python", "probe"}


def test_the_printers_own_probe_needs_a_job() -> None:
    known_scanner("probe")
    with pytest.raises(InputError, match="needs no calibration"):
        open_scanner("probe", bed())
    with pytest.raises(InputError, match="probe for the printer's own"):
        known_scanner("probe:somewhere")
