"""A scanner that is a folder, into which a real scanner drops its files.

It waits, tells a whole file from a partial one, and refuses stale and repeated scans. It does not
drive hardware.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from amrepair.errors import InputError, ScannerError
from amrepair.frames import Transform
from amrepair.scans.readers import HEIGHT_SUFFIXES, MESH_SUFFIXES, POINT_SUFFIXES, read_scan
from amrepair.scans.scan import Scan
from amrepair.scans.scanner import ScanRequest

_log = logging.getLogger(__name__)

SCAN_SUFFIXES = POINT_SUFFIXES | MESH_SUFFIXES | HEIGHT_SUFFIXES
LAYER_IN_NAME = re.compile(r"layer[-_ ]?(\d+)", re.IGNORECASE)


class WatchedFolderScanner:
    """A `Scanner` that takes what another program drops into a folder (`watch:DIR`).

    A file counts once its size and time have stood still for `settle_s` and it reads whole; a
    file that still grows is waited for. A file whose bytes were seen before is a duplicate. Files
    that were there before the scanner was made are old. A name with `layer-12` in it answers
    only a request for that layer: an earlier layer's file came late and is dropped, a later
    layer's is kept for its request. A file whose name says nothing shows what stood there when it
    came: one that was there before the request, from a sensor that looks whenever it likes, is
    dropped.

    Parameters
    ----------
    clock, sleep
        Injected, so that tests need no waiting.
    """

    def __init__(
        self,
        folder: Path,
        *,
        build_from_scanner: Transform | None = None,
        timeout_s: float = 120.0,
        settle_s: float = 0.5,
        poll_s: float = 0.1,
        sigma_mm: float | None = None,
        sensor_at: Sequence[float] | None = None,
        unit: str | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not folder.is_dir():
            raise InputError(f"{folder}: the watched folder does not exist; create it first")
        self._folder = folder
        self.build_from_scanner = build_from_scanner or Transform.identity("build", "scanner")
        self._timeout_s, self._settle_s, self._poll_s = timeout_s, settle_s, poll_s
        self._sigma_mm, self._sensor_at, self._unit = sigma_mm, sensor_at, unit
        self._clock, self._sleep = clock, sleep
        self._done = {(p, *_stamp(p)) for p in self._files()}
        self._digests: set[bytes] = set()
        self._still_since: dict[Path, tuple[tuple[int, int], float]] = {}

    def scan(self, request: ScanRequest) -> Scan:
        """Wait for the next whole file that answers `request`.

        Raises
        ------
        ScannerError
            If none arrives within the time-out; the message tells why the last one did not do.
        """
        end_s = self._clock() + self._timeout_s
        trouble = self._drop_earlier() or "no new file appeared"
        while True:
            for path in self._settled():
                found, why = self._try(path, request)
                if found is not None:
                    return found
                trouble = why or trouble
            if self._clock() >= end_s:
                raise ScannerError(
                    f"{self._folder}: no usable scan for {request.label} within "
                    f"{self._timeout_s:g} s ({trouble}); check the scanner and its export folder"
                )
            self._sleep(self._poll_s)

    def _drop_earlier(self) -> str:
        """Forget the files without a layer's name that came before a request; what to say of it."""
        early = []
        for path in self._files():
            with contextlib.suppress(FileNotFoundError):  # it may go while it is looked at
                if (
                    LAYER_IN_NAME.search(path.stem) is None
                    and (path, *_stamp(path)) not in self._done
                ):
                    self._forget(path)
                    early.append(path)
        if not early:
            return ""
        _log.warning("%d scans came before they were asked for; dropped", len(early))
        return f"{early[-1].name} came before it was asked for"

    def _files(self) -> list[Path]:
        """Scan files in the folder; hidden and temporary names are somebody else's business."""
        return sorted(
            p
            for p in self._folder.iterdir()
            if p.suffix.lower() in SCAN_SUFFIXES
            and not p.name.startswith((".", "~"))
            and p.is_file()
        )

    def _settled(self) -> list[Path]:
        """New files that have not changed for `settle_s`, oldest first."""
        now_s = self._clock()
        ready: list[tuple[int, Path]] = []
        for path in self._files():
            try:
                stamp = _stamp(path)
            except FileNotFoundError:
                continue  # renamed or removed between listing and looking
            if (path, *stamp) in self._done:
                continue
            before = self._still_since.get(path)
            if before is None or before[0] != stamp:
                self._still_since[path] = (stamp, now_s)
            elif now_s - before[1] >= self._settle_s:
                ready.append((stamp[1], path))
        return [path for _, path in sorted(ready)]

    def _try(self, path: Path, request: ScanRequest) -> tuple[Scan | None, str | None]:
        """The scan, if the file answers the request; else why not."""
        named = LAYER_IN_NAME.search(path.stem)
        if named is not None:
            layer, asked = int(named.group(1)), request.layer_index
            if asked is not None and layer > asked:
                return None, f"{path.name} belongs to a later layer"
            if asked is None or layer < asked:  # nothing with a layer's name is the finished part
                self._forget(path)
                _log.warning("%s came too late: %s is asked for", path, request.label)
                return None, f"{path.name} belongs to an earlier layer"
        try:
            digest = hashlib.sha256(path.read_bytes()).digest()
            if digest in self._digests:
                self._forget(path)
                return None, f"{path.name} repeats an earlier scan"
            scan = read_scan(
                path, frame="scanner", sigma_mm=self._sigma_mm, sensor_at=self._sensor_at,
                unit=self._unit,
            )  # fmt: skip
        except (InputError, OSError) as e:
            # The file may still be half written; a change of size or time brings it back.
            return None, f"{path.name} cannot be read: {e}"
        self._digests.add(digest)
        self._forget(path)
        return scan, None

    def _forget(self, path: Path) -> None:
        """Do not look at this version of the file again."""
        self._done.add((path, *_stamp(path)))
        self._still_since.pop(path, None)


def _stamp(path: Path) -> tuple[int, int]:
    """Size and time of last change."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns
