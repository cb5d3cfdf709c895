"""False alarms on whole clean jobs of a slicer: no repair, no claim of excess, no change of flow.

    python benchmarks/bench_clean_jobs.py --next 4     # judge four jobs not yet run
    python benchmarks/bench_clean_jobs.py --jobs clip:default ring:solid
    python benchmarks/bench_clean_jobs.py --table      # what there is so far

Seven small parts, made here (or any STL: `--jobs part.stl:two`), are cut by the installed
PrusaSlicer in four ways, and by CuraEngine and Slic3r (whose jobs name no roles), printed into the
simulated world of `world.toml` (wandering flow, shrinkage, curl, noise, dropouts, outliers), and
looked at after a few layers and at the end. Every look goes the loop's own way: `sites` says what
is expected, `plan_repair`, `typed` and `decide_look` what is to be done, `rewritten_layer` how the
next layer's flow changes. Nothing is wrong with any of them, so whatever is done is a false alarm.

Counted are repairs, looks that claim more than 10 mm³ of excess (so many millimetres cubed of
regions, of whatever size each), changed layers and halts, offers to print again among them. Lines
of JSON in `--results`, one a job, every region with its box. Scans are kept in `--folder` and
judged again by other code, so that two versions of it see the same points.
"""

from __future__ import annotations

import argparse
import json
import pickle
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
import trimesh
from bench_clean import HALTS, MOST_CURL_MM, motion_of

from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.loop import Stop, locate_part, plan_stops
from amrepair.loop.kinds import typed
from amrepair.loop.learning import Learning
from amrepair.loop.next_layer import rewritten_layer
from amrepair.loop.sites import sites
from amrepair.loop.situation import decide_look
from amrepair.loop.thin_layers import with_covered
from amrepair.policy.table import Action
from amrepair.repair import RepairPlan, Site, plan_repair
from amrepair.scans import Scan, ScanRequest
from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.parameters import DEFAULT_SCANNER, WorldParameters, load_world
from amrepair.simulate.placed import PlacedDefect
from amrepair.simulate.scanner import SimulatedScanner
from amrepair.simulate.world import World
from amrepair.template import MeshSdf, load_mesh
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import Job, read_job
from gcode.resumption.flow import ChangedLayer

CENTRE_MM = (60.0, 60.0)
MUCH_EXCESS_MM3 = 10.0
# A look whose scan fits nothing: counted as a halt.
NOTHING: dict[str, Any] = {
    "missing_mm3": 0.0, "excess_mm3": 0.0, "repair_mm3": 0.0, "flow_mm3": None, "regions": [],
    "action": str(Action.STOP), "halted": True,
}  # fmt: skip
COMMON = (
    *("--layer-height", "0.2", "--first-layer-height", "0.2", "--nozzle-diameter", "0.4"),
    *("--filament-diameter", "1.75", "--gcode-flavor", "marlin"),
    *("--center", f"{CENTRE_MM[0]:g},{CENTRE_MM[1]:g}"),
)
# What differs from the slicer's own defaults (3 perimeters, 20 % stars, 3 solid layers).
WAYS: dict[str, tuple[str, ...]] = {
    "default": (),
    "two": ("--perimeters", "2", "--fill-density", "15%", "--fill-pattern", "grid"),
    "gyroid": ("--perimeters", "2", "--fill-density", "15%", "--fill-pattern", "gyroid"),
    "solid": ("--perimeters", "3", "--fill-density", "100%", "--fill-pattern", "rectilinear"),
    "cura": (),
    "slic3r": (),
}
CURA_DEFINITIONS = Path("/usr/share/cura/resources/definitions")
# What Cura itself would reckon from others, and where the part is to lie.
CURA_SETTINGS = {
    "layer_height": "0.2", "layer_height_0": "0.2", "center_object": "true",
    "machine_width": f"{2 * CENTRE_MM[0]:g}", "machine_depth": f"{2 * CENTRE_MM[1]:g}",
    "machine_start_gcode": "G28", "wall_line_count": "2", "wall_thickness": "0.8",
    "top_layers": "4", "bottom_layers": "4", "initial_bottom_layers": "4",
    "roofing_layer_count": "0", "infill_pattern": "grid", "infill_line_distance": "4",
    "infill_overlap_mm": "0.1", "skin_overlap_mm": "0.05", "material_diameter": "1.75",
    "retraction_amount": "1", "speed_print": "50", "adhesion_type": "none",
    "skin_edge_support_layers": "0",  # else infill is laid twice on one place
}  # fmt: skip


def _box(size_mm: tuple[float, float, float], at_mm: tuple[float, float, float]) -> m3.Manifold:
    return m3.Manifold.cube(size_mm).translate(at_mm)


def clip() -> m3.Manifold:
    """A slim spring clip, 10 × 18 × 40 mm: two arms, a round throat, a lip with 45° under it."""
    side = [(0.0, 0.0), (18.0, 0.0), (18.0, 40.0), (13.5, 40.0), (13.5, 9.0), (4.5, 9.0),
            (4.5, 31.0), (7.0, 33.5), (7.0, 35.0), (5.0, 40.0), (0.0, 40.0)]  # fmt: skip
    body = m3.CrossSection([side]).extrude(10.0).rotate((90.0, 0.0, 90.0))
    return body - m3.Manifold.cylinder(12.0, 6.0, 6.0, 64).rotate((0.0, 90.0, 0.0)).translate(
        (-1.0, 9.0, 14.0)
    )


def bridge() -> m3.Manifold:
    """A U turned over: two legs, and 12 mm of bridge between them."""
    return _box((24.0, 10.0, 12.0), (0.0, 0.0, 0.0)) - _box((12.0, 12.0, 8.0), (6.0, -1.0, 0.0))


def ring() -> m3.Manifold:
    """24 mm across, its bore 15 mm, 7 mm high; walls of ten beads."""
    return m3.Manifold.cylinder(7.0, 12.0, 12.0, 96) - m3.Manifold.cylinder(
        9.0, 7.5, 7.5, 96
    ).translate((0.0, 0.0, -1.0))


def cup() -> m3.Manifold:
    """A cup that widens upwards; its wall is 1.1 mm, no multiple of a bead."""
    outer = m3.Manifold.cylinder(16.0, 8.0, 11.0, 96)
    return outer - m3.Manifold.cylinder(16.0, 6.9, 9.9, 96).translate((0.0, 0.0, 1.4))


def wedge() -> m3.Manifold:
    """A ramp of 25° with a hole through it: every layer has a step of solid top skin."""
    ramp = m3.CrossSection([[(0.0, 0.0), (24.0, 0.0), (24.0, 11.3), (22.0, 11.3), (0.0, 1.0)]])
    body = ramp.extrude(12.0).rotate((90.0, 0.0, 0.0)).translate((0.0, 12.0, 0.0))
    return body - m3.Manifold.cylinder(30.0, 2.0, 2.0, 48).translate((17.0, 6.0, -1.0))


def bracket() -> m3.Manifold:
    """An angle with a rib and screw holes, its top at a height between two layers."""
    plate = _box((26.0, 16.0, 3.1), (0.0, 0.0, 0.0)) + _box((4.0, 16.0, 14.5), (0.0, 0.0, 0.0))
    rib = m3.CrossSection([[(0.0, 0.0), (14.0, 0.0), (0.0, 11.0)]]).extrude(3.0)
    plate += rib.rotate((90.0, 0.0, 0.0)).translate((3.0, 9.5, 2.0))
    holes = m3.Manifold.cylinder(9.0, 1.7, 1.7, 32).translate((21.0, 4.0, -1.0))
    return plate - holes - holes.translate((0.0, 8.0, 0.0))


def button() -> m3.Manifold:
    """A dome on a foot: shallow slopes near the top, thin shells of skin below."""
    ball = m3.Manifold.sphere(14.0, 128).translate((0.0, 0.0, -6.0))
    dome = ball.trim_by_plane((0.0, 0.0, 1.0), 0.0)
    return dome + m3.Manifold.cylinder(1.5, 13.4, 13.4, 96)


PARTS: dict[str, Callable[[], m3.Manifold]] = {
    "clip": clip, "bridge": bridge, "ring": ring, "cup": cup, "wedge": wedge,
    "bracket": bracket, "button": button,
}  # fmt: skip


def mesh_of(solid: m3.Manifold) -> trimesh.Trimesh:
    """Its triangles."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))


def mesh_called(part: str) -> trimesh.Trimesh:
    """One of ours, or a file."""
    return mesh_of(PARTS[part]()) if part in PARTS else load_mesh(Path(part))


def sliced(part: str, way: str, folder: Path) -> Job:
    """The part's job, cut by the installed PrusaSlicer once."""
    name = Path(part).stem
    gcode = folder / f"{name}-{way}.gcode"
    if not gcode.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        stl = folder / f"{name}.stl"
        mesh_called(part).export(stl)
        subprocess.run(slicing(way, stl, gcode), check=True, capture_output=True)
    text = Program(gcode.read_text(errors="replace"), "marlin")
    return read_job(text, filament_diameter_mm=1.75, dialect="marlin")


def slicing(way: str, stl: Path, gcode: Path) -> list[str]:
    """The slicer's command line."""
    name = {"cura": "CuraEngine", "slic3r": "slic3r"}.get(way, "prusa-slicer")
    program = shutil.which(name)
    if program is None:
        raise SystemExit(f"{name} is not on the path; install it, or judge kept scans")
    if way == "cura":
        settings = [
            word for key, value in CURA_SETTINGS.items() for word in ("-s", f"{key}={value}")
        ]
        machine = str(CURA_DEFINITIONS / "fdmprinter.def.json")
        files = ["-l", str(stl), "-o", str(gcode)]
        return [program, "slice", "-j", machine, *settings, "-e0", *settings, *files]
    if way == "slic3r":
        middle = f"{CENTRE_MM[0]:g},{CENTRE_MM[1]:g}"
        own = ["--no-gui", *COMMON[:8], "--print-center", middle]
        return [program, *own, "-o", str(gcode), str(stl)]
    return [program, "-g", *COMMON, *WAYS[way], "-o", str(gcode), str(stl)]


def stops_of(job: Job, looks: int) -> tuple[Stop, ...]:
    """Evenly spread over the layers, and the finished part."""
    count = len(job.layers)
    layers = [int(count * (k + 0.5) / (looks - 1)) for k in range(looks - 1)]
    return plan_stops(job, layers)


def scans_of(
    job: Job,
    stops: Sequence[Stop],
    told: WorldParameters,
    scanner_name: str,
    seed: int,
    defects: Sequence[PlacedDefect] = (),
) -> Iterator[tuple[tuple[Scan, Scan], Transform]]:
    """What a scanner sees at every stop of a job, printed without a defect if none is told.

    And what it sees if it looks again.

    Its errors are drawn anew for another look. Those of a real one may be the same.
    """
    beads = job.beads
    part = beads.layer >= 0
    low, high = beads.start_mm[part].min(axis=0), beads.start_mm[part].max(axis=0)
    far_mm = 0.5 * float(np.hypot(*(high - low)[:2]))
    curl = min(told.thermal.curl_per_mm, MOST_CURL_MM / far_mm**2)
    world = World(
        (float(high[0]) + 20.0, float(high[1]) + 20.0),
        cell_mm=told.columns_mm,
        bead=told.bead,
        thermal=told.thermal.model_copy(update={"curl_per_mm": curl}),
        middle_mm=CENTRE_MM,
    )
    rng, flow_rng = np.random.default_rng([seed, 2]), np.random.default_rng([seed, 3])
    scanner = SimulatedScanner.seeded(
        world, told, scanner_name, centre_mm=CENTRE_MM, high_mm=float(high[2]), rng=rng
    )
    done = -1
    for stop in stops:
        layer = len(job.layers) - 1 if stop.layer_index is None else stop.layer_index
        if layer > done:
            world.deposit(noisy_flow(motion_of(job, done + 1, layer), flow_rng, told.flow), defects)
            done = layer
        asked = ScanRequest(stop.label, stop.layer_index, stop.z_mm)
        yield (scanner.scan(asked), scanner.scan(asked)), scanner.build_from_scanner


def kept_scans(
    path: Path, make: Callable[[], Iterator[tuple[tuple[Scan, Scan], Transform]]]
) -> list[tuple[tuple[Scan, Scan], Transform]]:
    """Those of an earlier call, or new ones, kept."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(list(make())))
    found: list[tuple[tuple[Scan, Scan], Transform]] = pickle.loads(path.read_bytes())
    return found


def figures(
    stop: Stop, plan: RepairPlan, rows: Sequence[Any], changed: ChangedLayer | None
) -> dict[str, Any]:
    """What became of one look; the regions, gravest decision first."""
    regions = [
        {
            "label": region.label.name,
            "type": str(region.type),
            "mm3": round(region.volume_mm3, 2),
            "depth_mm": round(region.depth_mm, 3),
            "confidence": round(region.confidence, 2),
            "action": str(verdict.action),
            "row": verdict.row,
            "box_mm": np.round(region.box_mm, 2).tolist(),
        }
        for region, verdict in zip(plan.deficit.regions, rows, strict=True)
    ]
    return {
        "stop": stop.label,
        "z_mm": round(stop.z_mm, 2),
        "missing_mm3": round(plan.deficit.missing_mm3, 2),
        "excess_mm3": round(plan.deficit.excess_mm3, 2),
        "tolerance_mm": round(plan.deficit.tolerance_mm, 3),
        "flow_mm3": None if changed is None else round(changed.added_mm3, 2),
        "regions": sorted(regions, key=lambda r: list(Action).index(Action(r["action"]))),
    }


def judged(
    scans: Sequence[Scan],
    pose: Transform,
    job: Job,
    site: Site,
    stop: Stop,
    *,
    rng: np.random.Generator,
    learning: Learning,
) -> dict[str, Any]:
    """What the loop decides of a scan, or of another where it looks again; and learns of them."""
    placed = site.build_from_template
    assert placed is not None
    for twice, scan in enumerate(scans):
        site = learning.judged_by(site)
        plan = plan_repair(
            scan, site, title=stop.label, guess=placed.inverse() @ pose, strict=False,
            interruption=job.state_after(stop.line), rng=rng,
        )  # fmt: skip
        plan = typed(plan, job, site, stop.line, pose)
        plan = with_covered(plan, job, site.expected, stop)
        decision = decide_look(plan, job, site, stop, (), seen_twice=bool(twice), limits=None)
        learning.note(stop, plan, decision)
        if decision.action is not Action.LOOK_AGAIN:
            break
    changed = None
    if decision.changes_next and stop.layer_index is not None:
        after = stop.layer_index + 1
        changed = rewritten_layer(job, site.setup, after, plan, decision.changes_next)
    return figures(stop, plan, decision.verdicts, changed) | {
        "action": str(decision.action),
        "repair_mm3": round(sum(r.volume_mm3 for r in plan.to_fill), 2),
        "halted": decision.action in (*HALTS, Action.OFFER),
        "covered_mm3": 0.0 if plan.covered is None else round(plan.covered.piece.volume_mm3, 2),
        "twice": bool(twice),
    }


def run_job(
    name: str, *, looks: int, seed: int, told: WorldParameters, scanner_name: str, folder: Path
) -> dict[str, Any]:
    """Print one job and judge every look at it."""
    began = time.perf_counter()
    part, way = name.rsplit(":", 1)
    setup = load_setup()
    job = sliced(part, way, folder)
    stops = stops_of(job, looks)
    layer_mm = setup.process.layer_height_mm
    template = MeshSdf.from_mesh(mesh_called(part))
    placed = locate_part(job, template, layer_height_mm=layer_mm)
    site_at = sites(job, template, placed, setup)
    scanner = Path(scanner_name).name  # of a recording, its file's
    kept = (
        folder / f"{Path(part).stem}-{way}-{looks}-{seed}-{told.sha256[:8]}-{scanner}-twice.pickle"
    )
    scans = kept_scans(kept, lambda: scans_of(job, stops, told, scanner_name, seed))
    seen, learning = [], Learning()
    for number, (stop, (both, pose)) in enumerate(zip(stops, scans, strict=True), start=1):
        site = site_at(stop)
        try:
            row = judged(
                both, pose, job, site, stop,
                rng=np.random.default_rng([seed, number]), learning=learning,
            )  # fmt: skip
        except AlignmentError as error:  # twice in a row, and the loop ends
            row = {"stop": stop.label, "z_mm": round(stop.z_mm, 2), **NOTHING, "why": str(error)}
        seen.append(row)
    return {
        "job": name,
        "seed": seed,
        "layers": len(job.layers),
        "scanner": scanner_name,
        "world": told.sha256[:12],
        "looks": seen,
        "seconds": round(time.perf_counter() - began, 1),
    }


def counts(rows: Sequence[dict[str, Any]]) -> tuple[int, ...]:
    """Stops, repairs, claims of much excess, changes of flow, halts, and looks taken again."""
    looks = [look for row in rows for look in row["looks"]]
    return (
        len(looks),
        sum(look["repair_mm3"] > 0 or look["action"] == Action.FILL_NOW for look in looks),
        sum(look["excess_mm3"] > MUCH_EXCESS_MM3 for look in looks),
        sum(look["flow_mm3"] is not None for look in looks),
        sum(look["halted"] for look in looks),
        sum(look.get("twice", False) for look in looks),
    )


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: by part, by way and in all; then where each false alarm is."""
    lines = [
        f"| jobs | looks | repairs | excess > {MUCH_EXCESS_MM3:g} mm³ | flow changed | halts "
        "| looked twice | missing, most mm³ | excess, most mm³ |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    names = dict.fromkeys(row["job"].rsplit(":", 1)[0] for row in rows)
    for word in (*names, *WAYS, "all"):
        mine = [row for row in rows if word in (*row["job"].rsplit(":", 1), "all")]
        if not mine:
            continue
        looks = [look for row in mine for look in row["looks"]]
        most = [max(look[key] for look in looks) for key in ("missing_mm3", "excess_mm3")]
        cells = [word, *map(str, counts(mine)), *(f"{value:.1f}" for value in most)]
        lines.append(f"| {' | '.join(cells)} |")
    lines.append("")
    for row in rows:
        for look in row["looks"]:
            if "why" in look:
                lines.append(f"{row['job']} {look['stop']} (z {look['z_mm']}): {look['why']}")
            said = [r for r in look["regions"] if r["action"] != str(Action.GO_ON)]
            if look["excess_mm3"] > MUCH_EXCESS_MM3:
                said += [r for r in look["regions"] if r["label"] == "EXCESS" and r not in said]
            for r in said:
                lines.append(
                    f"{row['job']} {look['stop']} (z {look['z_mm']}): {r['label']} {r['type']} "
                    f"{r['mm3']} mm³, {r['depth_mm']} mm deep, {r['action']} ({r['row']}), "
                    f"{r['box_mm'][0]} to {r['box_mm'][1]}"
                )
    return "\n".join(lines)


def main() -> None:
    every = [f"{part}:{way}" for way in WAYS for part in PARTS]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", nargs="+", metavar="PART:WAY", default=every)
    parser.add_argument("--next", type=int, default=0, help="how many jobs not yet run")
    parser.add_argument("--looks", type=int, default=6, help="a job, the final one among them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--world", type=Path, help="TOML with what differs from the shipped world")
    parser.add_argument("--scanner", default=DEFAULT_SCANNER)
    parser.add_argument("--folder", type=Path, default=Path("out/clean-jobs"))
    parser.add_argument("--results", type=Path, default=Path("out/clean-jobs.jsonl"))
    parser.add_argument("--table", action="store_true", help="of the results so far, and no more")
    args = parser.parse_args()
    for name in args.jobs:
        part, _, way = name.rpartition(":")
        if way not in WAYS or (part not in PARTS and not Path(part).is_file()):
            parser.error(f"there is no job '{name}'; ways are {', '.join(WAYS)}")
    args.results.parent.mkdir(parents=True, exist_ok=True)
    text = args.results.read_text() if args.results.is_file() else ""
    rows = [json.loads(line) for line in text.splitlines()]
    done = {(row["job"], row["seed"]) for row in rows}
    todo = [name for name in args.jobs if (name, args.seed) not in done]
    for name in [] if args.table else todo[: args.next or None]:
        row = run_job(
            name, looks=args.looks, seed=args.seed, told=load_world(args.world),
            scanner_name=args.scanner, folder=args.folder,
        )  # fmt: skip
        rows.append(row)
        with args.results.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(name, dict(zip(("looks", "repairs", "much", "flow", "halts", "twice"), counts([row]),
              strict=True)), row["seconds"], "s", flush=True)  # fmt: skip
    print(table([row for row in rows if row["job"] in args.jobs]))


if __name__ == "__main__":
    main()
