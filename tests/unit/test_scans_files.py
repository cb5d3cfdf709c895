"""The watched folder: partial, repeated, late and early files, without any waiting."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from amrepair.errors import InputError, ScannerError
from amrepair.scans import Scan, ScanRequest, WatchedFolderScanner, write_ply


class Time:
    """A clock that only sleeping moves; things may happen while one sleeps."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.plan: list[tuple[float, Callable[[], object]]] = []

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        due = [act for at, act in self.plan if at <= self.now_s]
        self.plan = [(at, act) for at, act in self.plan if at > self.now_s]
        for act in due:
            act()


def make(seed: int) -> Scan:
    return Scan(np.random.default_rng(seed).uniform(0, 9, (40, 3)), 0.04, "scanner")


def watcher(folder: Path, time: Time) -> WatchedFolderScanner:
    return WatchedFolderScanner(folder, timeout_s=5.0, clock=time.clock, sleep=time.sleep)


def ask(layer: int) -> ScanRequest:
    return ScanRequest(f"layer-{layer:03d}", layer, layer * 0.2)


def test_takes_the_new_file_not_the_old_one(tmp_path: Path) -> None:
    time = Time()
    write_ply(make(0), tmp_path / "old.ply")
    scanner = watcher(tmp_path, time)
    time.plan = [(1.0, lambda: write_ply(make(1), tmp_path / "new.ply"))]
    assert np.array_equal(scanner.scan(ask(3)).points_mm, make(1).points_mm)


def test_files_in_metres_are_read_as_such(tmp_path: Path) -> None:
    time = Time()
    scanner = WatchedFolderScanner(
        tmp_path, timeout_s=5.0, unit="m", clock=time.clock, sleep=time.sleep
    )
    time.plan = [(1.0, lambda: np.save(tmp_path / "new.npy", make(1).points_mm / 1000.0))]
    assert scanner.scan(ask(3)).points_mm == pytest.approx(make(1).points_mm)


def test_waits_for_a_file_that_still_grows(tmp_path: Path) -> None:
    time = Time()
    scanner = watcher(tmp_path, time)
    write_ply(make(1), tmp_path / "whole.hidden")
    whole = (tmp_path / "whole.hidden").read_bytes()
    path = tmp_path / "a.ply"
    time.plan = [
        (0.5, lambda: path.write_bytes(whole[:60])),
        (1.8, lambda: path.write_bytes(whole[:500])),
        (3.0, lambda: path.write_bytes(whole)),
    ]
    assert len(scanner.scan(ask(1))) == 40
    assert time.now_s >= 3.0


def test_a_repeat_is_not_a_new_scan(tmp_path: Path) -> None:
    time = Time()
    scanner = watcher(tmp_path, time)
    time.plan = [(0.1, lambda: write_ply(make(1), tmp_path / "a.ply"))]
    scanner.scan(ask(1))
    time.plan = [(time.now_s + 0.1, lambda: write_ply(make(1), tmp_path / "b.ply"))]
    with pytest.raises(ScannerError, match="repeats an earlier scan"):
        scanner.scan(ask(2))


def test_late_files_are_dropped_and_early_ones_kept(tmp_path: Path) -> None:
    time = Time()
    scanner = watcher(tmp_path, time)
    write_ply(make(3), tmp_path / "layer-003.ply")
    write_ply(make(1), tmp_path / "layer-001.ply")
    write_ply(make(2), tmp_path / "layer-002.ply")
    assert np.array_equal(scanner.scan(ask(2)).points_mm, make(2).points_mm)
    assert np.array_equal(scanner.scan(ask(3)).points_mm, make(3).points_mm)


def test_what_came_before_it_was_asked_for_is_no_answer(tmp_path: Path) -> None:
    # regression: of a sensor that looks while the job is printed, a scan of a layer long covered
    # was taken for the layer just finished
    time = Time()
    scanner = watcher(tmp_path, time)
    write_ply(make(1), tmp_path / "0001.ply")
    with pytest.raises(ScannerError, match=r"0001\.ply came before it was asked for"):
        scanner.scan(ask(1))
    write_ply(make(2), tmp_path / "0002.ply")
    time.plan = [(time.now_s + 1.0, lambda: write_ply(make(3), tmp_path / "0003.ply"))]
    assert np.array_equal(scanner.scan(ask(2)).points_mm, make(3).points_mm)
    # the same name, written anew for the request
    time.plan = [(time.now_s + 1.0, lambda: write_ply(make(4), tmp_path / "0003.ply"))]
    assert np.array_equal(scanner.scan(ask(3)).points_mm, make(4).points_mm)


def test_silence_is_an_error_of_the_link(tmp_path: Path) -> None:
    time = Time()
    with pytest.raises(ScannerError, match="no new file") as caught:
        watcher(tmp_path, time).scan(ask(1))
    assert caught.value.exit_code == 4


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        WatchedFolderScanner(tmp_path / "gone")


def test_a_file_that_shrinks_and_comes_back_whole_is_taken_once(tmp_path: Path) -> None:
    time = Time()
    scanner = watcher(tmp_path, time)
    write_ply(make(4), tmp_path / "whole.hidden")
    whole = (tmp_path / "whole.hidden").read_bytes()
    path = tmp_path / "a.ply"
    time.plan = [
        (0.2, lambda: path.write_bytes(whole)),
        (0.5, lambda: path.write_bytes(b"")),  # the exporter begins anew
        (2.0, lambda: path.write_bytes(whole)),
    ]
    assert np.array_equal(scanner.scan(ask(1)).points_mm, make(4).points_mm)
    assert time.now_s >= 2.0
    with pytest.raises(ScannerError, match="no new file"):
        scanner.scan(ask(2))


def test_a_file_written_aside_and_renamed_is_taken(tmp_path: Path) -> None:
    time = Time()
    scanner = watcher(tmp_path, time)
    aside = tmp_path / ".layer-001.ply"
    time.plan = [
        (0.3, lambda: write_ply(make(1), aside)),
        (1.5, lambda: aside.rename(tmp_path / "layer-001.ply")),
    ]
    assert np.array_equal(scanner.scan(ask(1)).points_mm, make(1).points_mm)
    assert time.now_s >= 1.5


def test_a_late_scan_of_an_earlier_layer_never_answers_for_a_later_one(tmp_path: Path) -> None:
    time = Time()
    scanner = watcher(tmp_path, time)
    time.plan = [
        (0.5, lambda: write_ply(make(1), tmp_path / "layer-001.ply")),
        (6.0, lambda: write_ply(make(2), tmp_path / "layer-002.ply")),
    ]
    with pytest.raises(ScannerError, match="earlier layer"):
        scanner.scan(ask(2))
    assert np.array_equal(scanner.scan(ask(2)).points_mm, make(2).points_mm)


def test_a_file_that_goes_while_it_is_looked_at_is_no_error(tmp_path: Path) -> None:
    time = Time()
    scanner = watcher(tmp_path, time)
    gone, there = tmp_path / "a.ply", tmp_path / "b.ply"
    time.plan = [
        (0.1, lambda: write_ply(make(1), gone)),
        (0.4, gone.unlink),
        (1.0, lambda: write_ply(make(2), there)),
    ]
    assert np.array_equal(scanner.scan(ask(3)).points_mm, make(2).points_mm)


def test_a_late_layer_does_not_answer_for_the_finished_part(tmp_path: Path) -> None:
    # regression: a second file of the last layer looked at was taken for the finished part
    time = Time()
    scanner = watcher(tmp_path, time)
    write_ply(make(1), tmp_path / "layer-004-b.ply")
    time.plan = [(2.0, lambda: write_ply(make(2), tmp_path / "end.ply"))]
    assert np.array_equal(
        scanner.scan(ScanRequest("final", None, 1.0)).points_mm, make(2).points_mm
    )
