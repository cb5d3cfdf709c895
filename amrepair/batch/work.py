"""`Bench`: what a worker does with one scan after another; templates are loaded once."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from amrepair.align import align
from amrepair.batch.cells import PartCells, sums_of
from amrepair.batch.options import BatchKind, Task, TaskOutcome, Work
from amrepair.batch.places import at_hand, digest_of
from amrepair.deficit import compute_deficit, measured_regions
from amrepair.errors import AmrepairError
from amrepair.frames import Transform
from amrepair.library import recognise
from amrepair.regions import AnomalyMap, Region, detect
from amrepair.repair import Site, plan_repair
from amrepair.repair.other_part import refuse_other_part
from amrepair.scans import Scan, read_scan
from amrepair.template import open_template
from gcode.compiled import set_num_threads
from gcode.errors import GcodeError
from gcode.process import gives_back, peak_mb

if TYPE_CHECKING:
    from collections.abc import Sequence

    from amrepair.align import Registration
    from amrepair.template.port import Template

SUMS, PROGRAM = "sums", "repair.gcode"
# So many scans between two times that memory is given back: it takes a while to come again.
GIVE_BACK = 32


@dataclass(frozen=True, slots=True)
class _Held:
    """A template and its cells."""

    name: str
    template: Template
    cells: PartCells


class Bench:
    """A worker's desk.

    One thread: sums of several come out differently in their last digits, and a batch's other
    workers have the other cores.
    """

    def __init__(self, work: Work) -> None:
        set_num_threads(1)
        self._work = work
        self._held: dict[str, _Held] = {}
        self._done = 0

    def do(self, task: Task) -> TaskOutcome:
        """Judge one scan; whatever is wrong with it is its sentence."""
        self._done += 1
        return self._lean(task) if self._done % GIVE_BACK == 0 else self._do(task)

    @gives_back
    def _lean(self, task: Task) -> TaskOutcome:
        return self._do(task)

    def _do(self, task: Task) -> TaskOutcome:
        wall_s, cpu_s, size = time.monotonic(), time.process_time(), 0
        try:
            with at_hand(task.uri) as path:
                sha256, size = digest_of(str(path))
                if sha256 != task.sha256:
                    done = _refused(task, "{scan} changed while the batch ran; run it again")
                else:
                    done = self._judged(task, path)
        except OSError as error:
            done = _refused(task, f"{{scan}} cannot be read ({error.strerror or error})")
        except MemoryError:
            done = _refused(task, "{scan} takes more memory than there is; use fewer --workers")
        cost = {
            "cpu_s": round(time.process_time() - cpu_s, 4),
            "wall_s": round(time.monotonic() - wall_s, 4),
            "read_bytes": size,
        }
        if (peak := peak_mb()) is not None:
            cost["peak_mb"] = round(peak, 1)
        return TaskOutcome(
            done.scan_id, done.figures, done.sentence, done.lasting, done.files, cost
        )

    def _judged(self, task: Task, path: Any) -> TaskOutcome:
        try:
            figures, files = self._figures(task, path)
        except (AmrepairError, GcodeError) as error:
            return TaskOutcome(task.scan_id, sentence=str(error).replace(str(path), "{scan}"))
        except (OSError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001  one scan's surprise is not the batch's end
            said = f"{type(error).__name__}: {error}".replace(str(path), "{scan}")
            return TaskOutcome(
                task.scan_id,
                sentence=f"{{scan}} cannot be judged, by an error of the program ({said}); "
                "please report it with the scan",
            )
        return TaskOutcome(task.scan_id, figures, files=files)

    def _figures(self, task: Task, path: Any) -> tuple[Mapping[str, Any], Mapping[str, bytes]]:
        options = self._work.options
        build = options.kind is BatchKind.REPAIR and options.part_pose is None
        sensors = np.array(options.sensors_mm) if options.sensors_mm else None
        scan = read_scan(
            path, frame="build" if build else "scanner", sensor_at=sensors, unit=options.scan_unit
        )
        held, found, confidence = self._template_of(scan)
        chosen = {"template": held.name, "confidence": confidence}
        if options.kind is BatchKind.REPAIR:
            return self._repair(task, scan, held, chosen)
        if found is None:
            found = align(
                scan,
                held.template,
                part_is_known=options.part_is_known,
                rng=np.random.default_rng(options.seed),
            )
        pose = {**chosen, **_pose_figures(found)}
        if options.kind is BatchKind.ALIGN:
            return pose, {}
        placed = scan.moved(found.template_from_scan)
        anomaly = detect(placed, held.template, calibration=self._work.calibration)
        if not options.part_is_known:
            refuse_other_part(anomaly, held.template, scan.source)
        here = Transform.identity("build", "template")
        deficit = compute_deficit(placed, held.template, anomaly, build_from_template=here)
        regions = measured_regions(anomaly, deficit)
        centres_mm = np.array([np.mean(r.box_mm, axis=0) for r in regions]).reshape(-1, 3)
        sums = sums_of(anomaly, regions, centres_mm, held.cells)
        return {**pose, **_found(anomaly, regions, centres_mm)}, {SUMS: sums.to_bytes()}

    def _repair(
        self, task: Task, scan: Scan, held: _Held, chosen: Mapping[str, Any]
    ) -> tuple[Mapping[str, Any], Mapping[str, bytes]]:
        options, setup = self._work.options, self._work.setup
        assert setup is not None
        placed = None if options.part_pose is None else Transform.on_bed(*options.part_pose)
        site = replace(
            Site.of_part(held.template, setup, build_from_template=placed),
            on_fixture=options.on_fixture,
            part_is_known=options.part_is_known,
            calibration=self._work.calibration,
        )
        plan = plan_repair(
            scan,
            site,
            title=f"repair of scan {task.sha256[:12]}",  # its bytes may have several names
            rng=np.random.default_rng(options.seed),
        )
        template_from_build = plan.build_from_template.inverse()
        regions = plan.deficit.regions
        centres_mm = np.array([np.mean(r.box_mm, axis=0) for r in regions]).reshape(-1, 3)
        centres_mm = template_from_build.apply(centres_mm)
        figures = {
            **chosen,
            **_pose_figures(plan.registration),
            **_found(plan.anomaly, regions, centres_mm),
            "within_tolerance": plan.within_tolerance,
            "unreachable_mm3": plan.unreachable_mm3,
            "filament_mm": 0.0 if plan.estimate is None else plan.estimate.filament_mm,
            "print_time_s": 0.0 if plan.estimate is None else plan.estimate.print_time_s,
        }
        files = {SUMS: sums_of(plan.anomaly, regions, centres_mm, held.cells).to_bytes()}
        if plan.checked is not None:
            files[PROGRAM] = plan.checked.program.text.encode()
        return figures, files

    def _template_of(self, scan: Scan) -> tuple[_Held, Registration | None, float]:
        """The template of a scan: the one that there is, or the one of several that it fits."""
        sources = self._work.templates
        if len(sources) == 1:
            return self._hold(sources[0].name), None, 1.0
        known = recognise(
            scan,
            [(one.name, partial(self._open, one.name)) for one in sources],
            seed=self._work.options.seed,
        )
        return self._hold(known.name), known.registration, known.confidence

    def _open(self, name: str) -> Template:
        return self._hold(name).template

    def _hold(self, name: str) -> _Held:
        if name not in self._held:
            source = next(one for one in self._work.templates if one.name == name)
            template = open_template(source.path)
            self._held[name] = _Held(name, template, PartCells.of(template))
        return self._held[name]


def _refused(task: Task, sentence: str) -> TaskOutcome:
    return TaskOutcome(task.scan_id, sentence=sentence, lasting=False)


def _pose_figures(found: Registration) -> dict[str, object]:
    """As results have it, but how many other poses fit as well, and not which."""
    return found.to_json() | {"symmetric_alternatives": len(found.symmetric_alternatives)}


def _found(
    anomaly: AnomalyMap, regions: Sequence[Region], centres_mm: np.ndarray
) -> dict[str, Any]:
    """What a row tells of a scan's regions."""
    volumes = {"missing": 0.0, "excess": 0.0}
    rows = []
    for region, centre_mm in zip(regions, centres_mm, strict=True):
        label = region.label.name.lower()
        volumes[label] += float(region.volume_mm3)
        rows.append(
            {
                "label": label,
                "type": str(region.type),
                "volume_mm3": float(region.volume_mm3),
                "area_mm2": float(region.area_mm2),
                "depth_mm": float(region.depth_mm),
                "centre_mm": [float(value) for value in centre_mm],
                "p_value": None if np.isnan(region.p_value) else float(region.p_value),
            }
        )
    return {
        "object_score_mm": anomaly.object_score,
        "threshold_mm": anomaly.threshold_mm,
        "sigma_mm": None if anomaly.noise is None else anomaly.noise.sigma_mm,
        "missing_mm3": volumes["missing"],
        "excess_mm3": volumes["excess"],
        "regions": rows,
        "told": list(anomaly.told()),
    }
