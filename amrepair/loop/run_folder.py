"""The setting of a run: all that is needed to look at its scans again, kept in the run's folder.

`run.json` names the profiles (with their hashes), the stops and the poses; the job and the
template lie beside it. It holds no secret and no clock.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import trimesh
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.loop.looks import Stop, plan_stops
from amrepair.loop.marked_stops import marked_stops
from amrepair.loop.options import LoopOptions
from amrepair.loop.pace import Pace
from amrepair.policy import DEFAULT_POLICY, PolicyOptions
from amrepair.regions.error_calibration import Calibration, as_tuples
from amrepair.scans import PROBE
from amrepair.template import MeshSdf, StoodTemplate, load_template
from amrepair.template.port import Template
from gcode.check import CheckedProgram, check, policy_of
from gcode.meshes import mesh_of
from gcode.profiles import PrintSetup, ProcessProfile, load_setup
from gcode.profiles.names import is_path
from gcode.reader import Job, job_for
from gcode.surfaces.sizes import in_words
from gcode.whole import write_bytes

SETTING, JOB, TEMPLATE, MESH = "run.json", "job.gcode", "template.safetensors", "template.npz"
RUN_VERSION = 4
# What comes of files that are cut off, or that hold something else than was written.
_DAMAGED = (
    *(ArithmeticError, AttributeError, LookupError, TypeError, ValueError),
    *(BadZipFile, EOFError),
)


@dataclass(frozen=True, slots=True)
class Setting:
    """What a run was begun with.

    Attributes
    ----------
    layers
        After which the run looks; `final`: and at the finished part.
    by_beads
        Layers are judged by the job's beads, else by the template's cut.
    build_from_template, build_from_scanner
        4×4, rows.
    copies
        Where each copy stands, 4×4, where the template that the run looks with is of them
        (`locate.stood`); else empty.
    parts
        Of which of the kept templates each copy is; empty where there is one template.
    policy
        What is worth a repair, and how many passes a stop may have.
    limited
        Whether it prints without asking, within the profile's limits.
    adaptive
        Layers that adaptive looks begin with (`pace`); 0 where there are none.
    leave_heaters
        The job may leave heaters on; else lines that switch them off are put at its end.
    marked
        The run looks where the job is marked, from this line on; `layers` and `final` say nothing
        then. None: it does not go by marks.
    sound
        What sound parts look like to the scanner, where somebody named it: name, scans, widths,
        wander and tails, as `Calibration` has them. Empty: the run learns from its first layers.
    scan_unit
        Of the scanner's files, where they do not say it; None: mm.
    """

    printer: str
    material: str
    process: str
    profiles: dict[str, str]
    layers: tuple[int, ...]
    final: bool
    by_beads: bool
    build_from_template: tuple[tuple[float, ...], ...]
    build_from_scanner: tuple[tuple[float, ...], ...]
    seed: int
    policy: PolicyOptions = DEFAULT_POLICY
    limited: bool = False
    adaptive: int = 0
    port: str = ""
    scanner: str = ""
    scan_timeout_s: float = 120.0
    approve: str = ""
    title: str = "job"
    copies: tuple[tuple[tuple[float, ...], ...], ...] = ()
    parts: tuple[int, ...] = ()
    leave_heaters: bool = False
    marked: int | None = None
    sound: tuple[Any, ...] = ()
    scan_unit: str | None = None

    @classmethod
    def of(
        cls,
        setup: PrintSetup,
        ids: tuple[str, str, str],
        *,
        stops: Sequence[Stop],
        build_from_template: Transform,
        build_from_scanner: Transform,
        copies: Sequence[Transform] = (),
        **others: Any,
    ) -> Setting:
        """From what a run is begun with; `ids` are the profiles as they were named."""
        return cls(
            printer=_whole(ids[0]),
            material=_whole(ids[1]),
            process=_whole(ids[2]),
            profiles=setup.hashes,
            layers=tuple(s.layer_index for s in stops if s.layer_index is not None),
            final=any(s.layer_index is None for s in stops),
            build_from_template=_rows(build_from_template),
            build_from_scanner=_rows(build_from_scanner),
            copies=tuple(_rows(pose) for pose in copies),
            **others,
        )

    def options(self, process: ProcessProfile) -> LoopOptions:
        """How the run goes."""
        return LoopOptions(
            policy=self.policy,
            pace=Pace(self.adaptive) if self.adaptive else None,
            limits=process if self.limited else None,
            calibration=self.scanners_errors,
            seed=self.seed,
        )

    @property
    def scanners_errors(self) -> Calibration | None:
        """The calibration that somebody named."""
        return Calibration(*self.sound) if self.sound else None

    @property
    def placed(self) -> Transform:
        """Build from template."""
        return Transform("build", "template", _matrix(self.build_from_template))

    def as_it_stands(self, templates: Sequence[Template]) -> Template:
        """What the run looks with: the part's template, or all parts as they stand."""
        if not self.copies:
            return templates[0]
        poses = (Transform("build", "template", _matrix(rows)) for rows in self.copies)
        which = self.parts or (0,) * len(self.copies)
        return StoodTemplate.of_parts(tuple(templates[k] for k in which), tuple(poses))

    @property
    def scanner_pose(self) -> Transform:
        """Build from scanner; from the printer's own axes where its probe touches."""
        frame = PROBE if self.scanner == PROBE else "scanner"
        return Transform("build", frame, _matrix(self.build_from_scanner))

    def setup(self) -> PrintSetup:
        """The profiles, which must not have changed.

        Raises
        ------
        InputError
            If one has.
        """
        setup = load_setup(self.printer, self.material, self.process)
        changed = [key for key, value in setup.hashes.items() if self.profiles.get(key) != value]
        if changed:
            raise InputError(
                f"the profile {changed[0]} has changed since the run was recorded; decisions "
                "depend on it: restore it, or begin a new run"
            )
        return setup


@dataclass(frozen=True, slots=True)
class Recorded:
    """A run's folder, opened."""

    setting: Setting
    setup: PrintSetup
    job: Job
    template: Template
    stops: tuple[Stop, ...]

    def judged(self) -> CheckedProgram:
        """The job, by the policy that it was judged by as the run began."""
        program = self.job.program
        policy, leave = policy_of(program), self.setting.leave_heaters
        return check(program, self.setup, policy=policy, leave_heaters=leave)


def keep(folder: Path, setting: Setting, job_text: str, *templates: Template) -> None:
    """Write setting, job and templates; whole files.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    try:
        write_bytes(folder / JOB, job_text.encode())
        for number, template in enumerate(templates, start=1):
            _keep_template(folder, template, number)
        said = {"version": RUN_VERSION, **asdict(setting)}
        text = json.dumps(said, indent=2, ensure_ascii=False) + "\n"
        write_bytes(folder / SETTING, text.encode())
    except OSError as error:
        raise InputError(
            f"the run's folder {folder} cannot be written ({error.strerror}); name another one"
        ) from error


def open_run(folder: Path) -> Recorded:
    """Read a run's folder.

    Raises
    ------
    InputError
        If something of it is missing, or a profile has changed.
    """
    try:
        said = json.loads((folder / SETTING).read_text(encoding="utf-8"))
        text = (folder / JOB).read_text(encoding="utf-8", errors="replace")
    except (OSError, ValueError) as error:
        raise InputError(
            f"{folder} is not the folder of a recorded run ({_lacks(folder, error)}); name the one "
            "that 'loop' or 'simulate' wrote"
        ) from error
    if not isinstance(said, dict) or said.pop("version", None) != RUN_VERSION:
        raise InputError(
            f"{folder / SETTING} is of another version than {RUN_VERSION}; go on with the amrepair "
            "that began the run"
        )
    try:
        policy = PolicyOptions(**said.pop("policy"))
        setting = Setting(policy=policy, **{key: as_tuples(value) for key, value in said.items()})
        return _opened(folder, setting, text)
    except _DAMAGED as error:
        raise InputError(
            f"the run in {folder} cannot be read ({in_words(error)}); one of its files is damaged, "
            "or of another version"
        ) from error


def _opened(folder: Path, setting: Setting, text: str) -> Recorded:
    """What a setting means."""
    setup = setting.setup()
    setting.options(setup.process)  # what cannot be meant is told now, and not at the first look
    _ = setting.placed, setting.scanner_pose
    job = job_for(text, setup.printer)
    stops = (
        marked_stops(job, setting.title, start=setting.marked)
        if setting.marked is not None
        else plan_stops(job, setting.layers, final=setting.final)
    )
    template = setting.as_it_stands(
        [_kept_template(folder, k + 1) for k in range(max(setting.parts, default=0) + 1)]
    )
    return Recorded(setting, setup, job, template, stops)


def _lacks(folder: Path, error: Exception) -> str:
    """Why it is none: a run that was never begun there is the usual case."""
    if not folder.is_dir():
        return "there is no such folder"
    if isinstance(error, FileNotFoundError):
        name = Path(str(error.filename)).name
        return f"it has no {name}: no run was begun there, or it was stopped before it began"
    return str(getattr(error, "strerror", None) or in_words(error))


def _keep_template(folder: Path, template: Template, number: int) -> None:
    """As its own file; an exact mesh, which has none, as its triangles."""
    save: Any = getattr(template, "save", None)
    own, mesh = _numbered(folder / TEMPLATE, number), _numbered(folder / MESH, number)
    mesh.unlink(missing_ok=True)
    if save is not None:
        save(own)
        return
    vertices, faces = mesh_of(template.solid())
    packed = BytesIO()
    np.savez(packed, vertices_mm=vertices, faces=faces)
    write_bytes(mesh, packed.getvalue())


def _numbered(path: Path, number: int) -> Path:
    """The first template's file has its plain name."""
    return path if number == 1 else path.with_stem(f"{path.stem}-{number}")


def _kept_template(folder: Path, number: int) -> Template:
    own = _numbered(folder / MESH, number)
    if not own.is_file():
        return load_template(_numbered(folder / TEMPLATE, number))
    with np.load(BytesIO(own.read_bytes())) as kept:
        mesh = trimesh.Trimesh(kept["vertices_mm"], kept["faces"], process=False)
    return MeshSdf.from_mesh(mesh)


def forget(folder: Path) -> None:
    """Take an earlier run's record out of a folder that a new run is to have, but for its tape."""
    for pattern in ("run.json", "scan-*.ply", "repair-*.gcode", "deficit-*.stl"):
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)


def _whole(name: str) -> str:
    """A profile's name; a path is kept from wherever it is read again."""
    return str(Path(name).resolve()) if is_path(name) else name


def _matrix(rows: Sequence[Sequence[float]]) -> Float[np.ndarray, "4 4"]:
    matrix = np.array(rows, float)
    if matrix.shape != (4, 4):
        raise ValueError("a pose is no matrix of 4 × 4")
    return matrix


def _rows(transform: Transform) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in transform.matrix)
