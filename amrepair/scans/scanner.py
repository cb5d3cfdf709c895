"""The `Scanner` port: anything that can be asked for a scan of what stands on the bed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from amrepair.frames import Transform
from amrepair.scans.scan import Scan

PROBE = "probe"
"""The frame of scans by the printer's own probe: the printer's axes themselves, no pose between."""


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """Why a scan is taken.

    Attributes
    ----------
    label
        Short name for files and messages: `layer-044`, `final`, `final-2`.
    layer_index
        The layer just finished, or None for the finished part.
    z_mm
        Height printed so far, build frame; of the object that is under way.
    layers
        How many layers of the job are printed where an object is finished and another one comes;
        None elsewhere.
    """

    label: str
    layer_index: int | None
    z_mm: float
    layers: int | None = None


@runtime_checkable
class Scanner(Protocol):
    """A sensor fixed over the bed.

    Attributes
    ----------
    build_from_scanner
        The calibrated pose of the scanner frame, good to about a tenth of a millimetre.

    Examples
    --------
    Any object with these two members is one; nothing need be inherited.

    >>> import numpy as np
    >>> from amrepair import Scan, Scanner, Transform
    >>> class FlatBed:
    ...     build_from_scanner = Transform.identity("build", "scanner")
    ...
    ...     def scan(self, request):
    ...         x, y = np.meshgrid(np.arange(0.0, 200.0, 5.0), np.arange(0.0, 200.0, 5.0))
    ...         points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    ...         return Scan(points, sigma_mm=0.05, frame="scanner", source=request.label)
    >>> isinstance(FlatBed(), Scanner)
    True
    """

    @property
    def build_from_scanner(self) -> Transform:
        """Calibrated pose."""

    def scan(self, request: ScanRequest) -> Scan:
        """Measure what stands on the bed now.

        Raises
        ------
        ScannerError
            If no usable scan arrives in time.
        """
