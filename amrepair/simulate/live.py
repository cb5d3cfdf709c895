"""A simulated scanner for a printer emulated elsewhere: it looks at what that one has printed.

`gcode emulate --motion FILE` writes what it executes; every look lays what came since in the world
of `world.toml`. It breaks nothing and knows no truth: that is `stage`'s.
"""

from __future__ import annotations

import numpy as np

from amrepair.frames import Transform
from amrepair.scans.scan import Scan
from amrepair.scans.scanner import ScanRequest
from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.parameters import WorldParameters
from amrepair.simulate.scanner import (
    ScannerPose,
    SimulatedScanner,
    calibration_error,
    default_sensors_mm,
)
from amrepair.simulate.world import World
from gcode.firmware.motion import MotionFile
from gcode.profiles import PrinterProfile


class PrintedScanner:
    """A scanner over a world that a file of executed moves builds (`Scanner`).

    Parameters
    ----------
    motion
        Of the emulated printer.
    printer
        Its bed, nozzle and filament.
    pose
        Calibrated pose; the true one is off by the model's calibration error.
    told, scanner
        The world's parameters, and the name of the scanner in them.
    seed
        Of flow, noise and calibration error.
    """

    def __init__(
        self,
        motion: MotionFile,
        *,
        printer: PrinterProfile,
        pose: Transform,
        told: WorldParameters,
        scanner: str,
        seed: int = 0,
    ) -> None:
        model, self.build_from_scanner = told.scanner(scanner), pose
        centre = printer.bed_middle_mm
        self.world = World.of(printer, told)
        rng = np.random.default_rng([seed, 2])
        error = calibration_error(rng, centre_mm=centre, model=model)
        self._motion = motion
        self._flow, self._flow_rng = told.flow, np.random.default_rng([seed, 3])
        self._looked: set[str] = set()
        self._scanner = SimulatedScanner(
            self.world,
            pose=ScannerPose(error.inverse() @ pose, pose),
            sensors_mm=default_sensors_mm(
                centre,
                distance_mm=max(300.0, printer.max_z_mm + 100.0),
                oblique=model.oblique_views,
            ),
            rng=rng,
            model=model,
            recording=told.recording(scanner),
        )

    def scan(self, request: ScanRequest) -> Scan:
        """Lay what was printed since the last look, then look; points in the scanner frame.

        Raises
        ------
        ScannerError
            If nothing stands there: no motion has come, or the file is another printer's.
        """
        batch = noisy_flow(self._motion.take(), self._flow_rng, self._flow)
        # What is printed between two scans of one stop is a repair: the part has cooled by then.
        self.world.deposit(batch, onto_cold=request.label in self._looked)
        self._looked.add(request.label)
        return self._scanner.scan(request)
