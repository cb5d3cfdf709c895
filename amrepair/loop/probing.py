"""The printer's own probe as a scanner: it touches where that tells most, and says what it felt.

It knows the job, so it knows what stands there, what may be touched and how high that should be.
Touches are programs that the checker has passed (`gcode.resumption.touch_tour`), sent by the same
port as the job. What is not touched is not in the scan.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Points, Values
from amrepair.frames import Transform
from amrepair.loop import travel
from amrepair.loop.looks import Stop, plan_stops
from amrepair.loop.sequential_objects import finished_at
from amrepair.loop.tape import FELT
from amrepair.loop.touch_design import (
    DEFAULT_TOUCHES,
    Flats,
    ProbeOptions,
    first_places,
    flats_of,
    next_places,
)
from amrepair.loop.touched import Touches, measured_sigma_mm, scan_of
from amrepair.loop.wire import Wire, touching
from amrepair.scans import PROBE, Scan, ScanRequest
from gcode.check import CheckedProgram
from gcode.hosts.port import Printer
from gcode.moves import ModalState
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.reader import Job
from gcode.resumption.standing import standing_field
from gcode.resumption.touch_tour import cooled, heated, tour
from gcode.surfaces import HeightField


@dataclass(frozen=True, slots=True)
class Felt:
    """What a look cost, and how well it felt.

    Attributes
    ----------
    touches
        Repeated ones included; `off`: places that were not as high as planned.
    seconds
        From where the job rested, and back; cooling and heating included.
    """

    stop: str
    touches: int
    off: int
    sigma_mm: float
    seconds: float

    def told(self) -> str:
        """The same, in a sentence."""
        return (
            f"{self.touches} touches in {self.seconds:.0f} s, {self.off} of them off; one touch is "
            f"good to {self.sigma_mm:.3f} mm"
        )


@runtime_checkable
class Feeler(Protocol):
    """Whoever touches, for a job that rests."""

    def send_by(self, wire: Wire) -> None:
        """Send by this wire from now on."""

    def get_ready(self, rest: ModalState) -> None:
        """Be cold, where what feels must be."""

    def feel(
        self,
        places_mm: Float[np.ndarray, "k 3"],
        rest: ModalState,
        standing: HeightField,
        told: Callable[[], None],
    ) -> Float[np.ndarray, " k"]:
        """(k,) heights met where surfaces are to be felt, build frame; `told` at each."""

    def get_back(self, rest: ModalState) -> None:
        """Be as hot as the job was."""


class PortFeeler:
    """The probe of a printer on a port, by programs that the checker has passed.

    Raises
    ------
    InputError
        If the printer does not tell where a touch ended.
    gcode.errors.ProfileError
        If it has no probe that feels plastic.
    """

    def __init__(self, printer: Printer, setup: PrintSetup) -> None:
        self._wire = Wire(touching(printer))  # refused early
        self._setup, self._probe = setup, setup.printer.feeler

    def send_by(self, wire: Wire) -> None:
        """Send by this wire from now on."""
        self._wire = wire

    def get_ready(self, rest: ModalState) -> None:
        """Wait until the nozzle is cold, where it feels itself."""
        self._send("cool", cooled(self._setup, rest))

    def feel(
        self,
        places_mm: Float[np.ndarray, "k 3"],
        rest: ModalState,
        standing: HeightField,
        told: Callable[[], None],
    ) -> Float[np.ndarray, " k"]:
        """Touch, and go back to where the job rests."""
        program = tour(places_mm, self._setup, rest, standing)
        met_mm = self._wire.touch(program, told)
        return np.array(met_mm) + self._probe.offset_mm[2]

    def get_back(self, rest: ModalState) -> None:
        """Heat the nozzle again."""
        self._send("heat", heated(self._setup, rest))

    def _send(self, kind: str, program: CheckedProgram | None) -> None:
        if program is not None:
            self._wire.send(kind, program)


class ProbeScanner:
    """A scanner (`Scanner`) that touches.

    Parameters
    ----------
    feeler
        Touches; the nozzle is at rest where `travel.park` left it.
    job
        What is being printed.
    clock
        Seconds; by default the wall's.

    Attributes
    ----------
    felt
        What each look cost.
    """

    build_from_scanner = Transform.identity("build", PROBE)  # the printer's own axes

    def __init__(
        self,
        feeler: Feeler,
        job: Job,
        setup: PrintSetup,
        *,
        options: ProbeOptions = DEFAULT_TOUCHES,
        clock: Callable[[], float] = time.monotonic,
        progress: Progress = silent,
    ) -> None:
        self._feeler = feeler
        self._probe = setup.printer.feeler
        self._job, self._setup, self._options = job, setup, options
        self._clock, self._progress = clock, progress
        self._before: list[tuple[Stop, Touches]] = []
        self._wire: Wire | None = None
        self.felt: list[Felt] = []

    def send_by(self, wire: Wire) -> None:
        """Have the printer move by this wire from now on."""
        self._wire = wire
        self._feeler.send_by(wire)

    @property
    def _reach_mm(self) -> float:
        """How far from its middle a touch speaks: a bead beside its flat."""
        return self._probe.tip_radius_mm + self._setup.process.line_width_mm

    def scan(self, request: ScanRequest) -> Scan:
        """Touch the last layer, or the finished part's tops.

        Raises
        ------
        ScannerError
            If nothing there can be touched.
        gcode.errors.PrinterError
            If the probe does not trigger; the heaters are off then.
        """
        began_s = self._clock()
        stop = self._stop(request)
        standing = standing_field(self._job.beads, stop.line, self._setup.printer)
        flats = flats_of(self._job, stop, self._setup, standing, self._options)
        touches, count = self._touched(stop, flats, standing)
        self._before.append((stop, touches))
        off = int(touches.is_off.sum())
        cost = Felt(stop.label, count, off, touches.sigma_mm, self._clock() - began_s)
        if self._wire is not None:  # a resumed run tells what it cost then
            cost = Felt(**self._wire.note(FELT, **asdict(cost)))
        self.felt.append(cost)
        self._progress(f"{stop.label}: {cost.told()}", 1.0, 1.0)
        return scan_of(
            touches,
            flats,
            tip_radius_mm=self._probe.tip_radius_mm,
            reach_mm=self._reach_mm,
            source=f"the probe at {stop.label}",
        )

    def _stop(self, request: ScanRequest) -> Stop:
        layer = request.layer_index
        if layer is not None:
            return Stop(layer, self._job.layers[layer].end_line, request.z_mm)
        ends = plan_stops(self._job, ())
        return next((stop for stop in ends if stop.label == request.label), ends[-1])

    def _touched(self, stop: Stop, flats: Flats, standing: HeightField) -> tuple[Touches, int]:
        """All touches of a look, and how many they were."""
        most = self._options.most
        finished = finished_at(self._job, self._job.turn_at(stop.line), self._setup)
        others = None if finished is None else finished.standing
        _, rest = travel.park(self._setup, self._job.state_after(stop.line), others)
        self._progress(f"touch {stop.label}: the nozzle gets ready", 0.0, float(most))
        self._feeler.get_ready(rest)
        felt_mm = np.zeros((0, 3))
        places = self._first(stop, flats)
        repeated = np.repeat(places[:1], self._options.repeats, axis=0)
        sigma_mm, count = self._probe.sigma_mm, 0
        while len(places):
            ask = np.concatenate([repeated, places])
            z_mm = self._feel(ask, flats, standing, rest, f"touch {stop.label}", count)
            if len(repeated):
                same = z_mm[: len(repeated) + 1]
                sigma_mm = measured_sigma_mm(same, self._probe.sigma_mm, self._options)
                repeated = places[:0]
                z_mm = np.append(same.mean(), z_mm[len(same) :])
            count += len(ask)
            felt_mm = np.concatenate([felt_mm, np.column_stack([places, z_mm])])
            touches = Touches(felt_mm, self._planned(felt_mm, flats), sigma_mm, self._options)
            places = next_places(
                flats, felt_mm[:, :2], touches.off_mm, touches.is_off,
                reach_mm=self._reach_mm, most=most - count,
            )  # fmt: skip
        self._progress(f"touch {stop.label}: the nozzle gets hot again", float(most), float(most))
        self._feeler.get_back(rest)
        return touches, count

    def _first(self, stop: Stop, flats: Flats) -> Float[np.ndarray, "k 2"]:
        """Where a look begins: what was off here before, else far from all that was felt."""
        most = self._options.most - self._options.repeats
        before = [touches for earlier, touches in self._before if earlier == stop]
        if before and (is_off := before[-1].is_off).any():
            # something was printed since: is it as it should be, and what had no touch left?
            last = before[-1]
            again = last.place_mm[is_off, :2]
            beside = next_places(
                flats, last.place_mm[:, :2], last.off_mm, is_off,
                reach_mm=self._reach_mm, most=most - len(again),
            )  # fmt: skip
            return np.concatenate([again, beside])[:most]
        earlier = [
            np.column_stack([
                touches.place_mm[:, :2],
                np.full(len(touches.place_mm), self._options.fade_mm * self._layers(at, stop)),
            ])
            for at, touches in self._before
        ]  # fmt: skip
        known = np.concatenate(earlier) if earlier else np.zeros((0, 3))
        return first_places(flats, self._options.first, known)

    def _layers(self, earlier: Stop, now: Stop) -> int:
        last = len(self._job.layers) - 1
        one, other = (last if s.layer_index is None else s.layer_index for s in (earlier, now))
        return abs(other - one)

    def _planned(self, felt_mm: Points, flats: Flats) -> Values:
        return np.asarray(flats.top_mm[flats.at(felt_mm[:, :2])])

    def _feel(
        self,
        xy_mm: Float[np.ndarray, "k 2"],
        flats: Flats,
        standing: HeightField,
        rest: ModalState,
        stage: str,
        done: int,
    ) -> Float[np.ndarray, " k"]:
        """(k,) heights felt at places, build frame."""
        places_mm = np.column_stack([xy_mm, flats.top_mm[flats.at(xy_mm)]])
        count = done

        def one_more() -> None:
            nonlocal count
            count += 1
            self._progress(stage, float(count), float(self._options.most))

        return self._feeler.feel(places_mm, rest, standing, one_more)
