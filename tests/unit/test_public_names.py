"""The names at the top of both packages: pinned, light to import, each with a running example."""

from __future__ import annotations

import ast
import doctest
import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import amrepair
import gcode
from amrepair.device import _WhenUsed
from tests.draws import draws

# A name that goes, goes with a new major version; one that comes, comes with a new minor one.
NAMES = {
    "amrepair": {
        "AmrepairError", "RepairPlan", "Scan", "Scanner", "Site", "Transform", "align_scan",
        "detect_defects", "fit_template", "open_template", "plan_repair", "read_scan", "run_loop",
    },
    "gcode": {
        "CheckedProgram", "GcodeError", "HeightField", "Program", "check_program", "connect",
        "estimate_program", "load_setup", "read_job", "read_solid", "slice_part", "slice_patch",
        "write_program",
    },
}  # fmt: skip
LOADED_LATE = ["amrepair", "amrepair.batch", "amrepair.report", "gcode", "gcode.profiles"]
HEAVY = {"numpy", "torch", "open3d", "scipy", "trimesh", "numba", "plotly", "pydantic"}


@pytest.mark.parametrize("package", [amrepair, gcode], ids=["amrepair", "gcode"])
def test_the_names_are_these(package: ModuleType) -> None:
    name = package.__name__
    assert set(package.__all__) == NAMES[name]
    assert NAMES[name] <= set(dir(package))
    for one in NAMES[name]:
        assert getattr(package, one) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        _ = package.nonsense
    assert (Path(str(package.__file__)).parent / "py.typed").is_file()


@pytest.mark.parametrize("name", LOADED_LATE)
def test_type_checkers_see_what_is_loaded(name: str) -> None:
    """The imports under TYPE_CHECKING and the table of homes say the same."""
    package = importlib.import_module(name)
    tree = ast.parse(Path(str(package.__file__)).read_text(encoding="utf-8"))
    told: dict[str, list[str]] = {}
    for branch in ast.walk(tree):
        for node in branch.body if isinstance(branch, ast.If) else ():
            if isinstance(node, ast.ImportFrom):
                names = [ast.unparse(alias) for alias in node.names]
                told.setdefault(str(node.module), []).extend(names)
    homes = {module: sorted(names.split(", ")) for module, names in package._HOMES.items()}
    assert {module: sorted(names) for module, names in told.items()} == homes


def test_importing_loads_nothing_heavy() -> None:
    code = "import sys, json, amrepair, gcode; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(json.loads(done.stdout))


@pytest.mark.slow
def test_from_scan_to_program_neither_torch_nor_open3d_is_loaded() -> None:
    code = (
        "import sys, amrepair, gcode\n"
        "for package in (amrepair, gcode):\n"
        "    for name in package.__all__: getattr(package, name)\n"
        "assert not {'torch', 'open3d'} & set(sys.modules), 'loaded too early'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_open3d_is_loaded_without_its_web_server() -> None:
    # regression: the web server that open3d loads with itself took longer than all else of it
    code = (
        "import sys\n"
        "from amrepair.device import open3d\n"
        "assert open3d().geometry.PointCloud\n"
        "assert 'dash' not in sys.modules, 'a web server'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_what_is_loaded_when_used_is_what_is_meant() -> None:
    text, at = _WhenUsed("json", "dumps"), _WhenUsed("json", "decoder")
    assert text([1]) == "[1]"
    assert at.JSONDecoder is json.JSONDecoder


def examples() -> list[str]:
    return [
        "amrepair",
        "gcode",
        *(f"amrepair.{name}" for name in sorted(NAMES["amrepair"])),
        *(f"gcode.{name}" for name in sorted(NAMES["gcode"])),
    ]


@pytest.mark.usefixtures("small_fits")
@pytest.mark.parametrize("name", draws(examples(), *(set(examples()) - {"amrepair.run_loop"})))
def test_its_example_runs(name: str, example_files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, _, attribute = name.partition(".")
    module = importlib.import_module(package)
    thing = getattr(module, attribute) if attribute else module
    monkeypatch.chdir(example_files)
    monkeypatch.setenv("XDG_CACHE_HOME", str(example_files / "cache"))
    found = doctest.DocTestParser().get_doctest(thing.__doc__ or "", {}, name, None, None)
    assert found.examples, f"{name} has no example"
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    said: list[str] = []
    result = doctest.DocTestRunner(optionflags=flags).run(found, out=said.append)
    assert result.failed == 0, "".join(said)


def test_ten_lines_go_from_a_scan_to_a_program() -> None:
    lines = doctest.DocTestParser().get_examples(amrepair.__doc__ or "")
    assert len(lines) <= 10
