"""What is kept of compiled kernels is what was compiled, whoever else compiles meanwhile."""

from __future__ import annotations

import ast
import gc
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import IndexDataCacheFile
from numba.core.errors import TypingError
from numba.extending import overload

from gcode import compiled
from gcode.slicing import infill_kernels

STAMP = (1.0, 1)
ROOT = Path(__file__).parents[2]


def kept_in(folder: Path, *, safely: bool) -> Any:
    file = IndexDataCacheFile(str(folder), "kernel-1.py311", STAMP)
    if safely:
        compiled.keep_safely(file)
    return file


def loaded_after_a_race(folder: Path, monkeypatch: pytest.MonkeyPatch, *, safely: bool) -> object:
    """One process has chosen its name, and writes after another one wrote and loads."""
    one, other = (kept_in(folder, safely=safely) for _ in range(2))
    late: list[tuple[str, object]] = []
    monkeypatch.setattr(one, "_save_data", lambda name, data: late.append((name, data)))
    # both look into the empty index before either writes it
    monkeypatch.setattr(other, "_load_index", dict)
    if safely:
        monkeypatch.setattr(compiled.os, "getpid", lambda: 1)
    one.save("contiguous", "code for contiguous arrays")
    if safely:
        monkeypatch.setattr(compiled.os, "getpid", lambda: 2)
    other.save("strided", "code for strided arrays")
    monkeypatch.undo()
    for name, data in late:
        kept_in(folder, safely=safely)._save_data(name, data)
    return kept_in(folder, safely=safely).load("strided")


def test_two_processes_that_compile_at_once_load_what_each_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """numba alone hands out the other one's machine code: a wrong height field, silently."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    alone = loaded_after_a_race(tmp_path / "a", monkeypatch, safely=False)
    assert alone == "code for contiguous arrays"
    ours = loaded_after_a_race(tmp_path / "b", monkeypatch, safely=True)
    assert ours == "code for strided arrays"


SORTED = """
import numpy as np
from numba.core.bytecode import FunctionIdentity
from gcode.compiled import njit

for _ in range({skip}):
    next(FunctionIdentity._unique_ids)

@njit(cache=True)
def kernel(values):
    return np.{function}(values)
"""


def test_each_process_numbers_what_it_compiles_from_a_place_of_its_own() -> None:
    """Of processes whose places are neighbours two mix their sorts, as a slow test shows."""
    numbers = FunctionIdentity._unique_ids
    try:
        places = [next(numbers)]
        for _ in range(20):
            compiled.count_from_own_place()
            places.append(next(FunctionIdentity._unique_ids))
    finally:
        FunctionIdentity._unique_ids = numbers
    assert np.diff(sorted(places)).min() > 10_000  # as many as a process makes of all kernels


PARTS = re.compile(rb"13run_quicksortB\d+v(\d+)B")


@pytest.mark.slow
def test_kernels_that_two_processes_compiled_do_not_mix_their_parts(tmp_path: Path) -> None:
    """regression: a tree of triangles crashed where another process had compiled another sort."""
    # kernels' code lies beside them wherever this process keeps its own
    outside = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "NUMBA_CACHE_DIR": ""}

    def said(text: str) -> str:
        return subprocess.run(
            [sys.executable, "-c", f"import numpy as np\n{text}"],
            env=outside, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip

    def numbered(name: str, function: str, skip: int = 0) -> int:
        """By which number numba knows the sort's parts once a kernel is compiled, in a process."""
        for old in tmp_path.glob(f"__pycache__/{name}*"):
            old.unlink()
        (tmp_path / f"{name}.py").write_text(SORTED.format(function=function, skip=skip))
        said(f"import {name}; {name}.kernel(np.array([0.3, 0.1, 0.2]))")
        (code,) = tmp_path.glob(f"__pycache__/{name}.kernel*.nbc")
        found = PARTS.search(code.read_bytes())
        assert found is not None
        return int(found[1])

    apart = numbered("sorts", "sort") - numbered("orders", "argsort")
    if 0 <= apart < 100:  # else they are no neighbours, as it is to be
        numbered("orders", "argsort", apart)
    found = said(
        "import sorts, orders, gcode.compiled\n"
        "values = np.array([0.3, 0.1, 0.2])\n"
        "print(sorts.kernel(values).tolist(), orders.kernel(values).tolist(),"
        " gcode.compiled.all_from_disk())"
    )
    assert found == "[0.1, 0.2, 0.3] [1, 2, 0] True\n"
    assert abs(apart) > 100


class Record:
    """What a kernel takes, kept by its name."""


def test_what_was_kept_of_records_that_are_gone_is_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Renamed, a record left every command with an AttributeError until its caches were removed."""
    kept_in(tmp_path, safely=True).save(Record(), "code for records")
    monkeypatch.delattr(f"{__name__}.Record")
    again = kept_in(tmp_path, safely=True)
    assert again.load("arrays") is None
    again.save("arrays", "code for arrays")
    assert kept_in(tmp_path, safely=True).load("arrays") == "code for arrays"


def test_a_kernel_is_compiled_anew_when_another_has_changed(tmp_path: Path) -> None:
    before = kept_in(tmp_path, safely=True)
    before.save("contiguous", "code")
    assert kept_in(tmp_path, safely=True).load("contiguous") == "code"
    changed = kept_in(tmp_path, safely=False)
    changed._source_stamp = (*STAMP, (*compiled.kernels_stamp(), ("new_kernels.py", 1, 1)))
    assert changed.load("contiguous") is None


def test_every_kernel_is_kept_safely() -> None:
    kept = infill_kernels.inside._cache._cache_file
    assert compiled._PROCESS_TOKEN in kept._data_name(1)
    assert kept._source_stamp[-1] == compiled.kernels_stamp()
    names = {name for name, _, _ in compiled.kernels_stamp()}
    assert {"infill_kernels.py", "nearest_kernels.py"} <= names
    root = Path(compiled.__file__).parents[1]
    for path in (p for k in ("gcode", "amrepair") for p in (root / k).rglob("*.py")):
        if path.name != "compiled.py":
            assert "from numba" not in path.read_text(), path


@compiled.njit()
def plus(value: int, twice: bool) -> int:
    return 2 * value if twice else value


@compiled.njit()
def both(value: int, twice: bool) -> int:
    return plus(value, True) + plus(1, twice)


def test_a_value_in_a_kernels_text_is_no_type_of_its_own() -> None:
    """The longest kernel took its six seconds twice: for a truth and for `True`."""
    assert both(5, False) == 11
    assert [str(kind) for kinds in plus.signatures for kind in kinds] == ["int64", "bool"]


@compiled.njit()
def ratio(value: float, by: float) -> float:
    return value / by + value


@compiled.njit(fastmath=True, error_model="numpy")
def hasty(value: float, by: float) -> float:
    return ratio(value, by) + value


def test_a_kernel_is_the_same_whichever_other_one_asked_for_it_first() -> None:
    # regression: compiled for a fast kernel, a plain one that it calls was fast, too, and kept so:
    # two copies of one source laid a patch in different places
    hasty(1.0, 2.0)
    (code,) = ratio.inspect_llvm().values()
    assert " fast " not in code
    with pytest.raises(ZeroDivisionError):
        ratio(1.0, 0.0)


@compiled.njit()
def put(target: np.ndarray, given: np.ndarray) -> None:
    target[1:] = given


def test_an_array_of_another_shape_is_refused_without_functions_for_text() -> None:
    """numba's words for it took two seconds to compile, in every process."""
    target = np.zeros(3)
    put(target, np.ones(2))
    assert target.tolist() == [0.0, 1.0, 1.0]
    with pytest.raises(ValueError, match="cannot assign slice from input of different size"):
        put(target, np.ones(3))


def test_what_is_read_alone_is_of_one_type_whoever_may_write_to_it() -> None:
    mine, told = np.zeros((4, 3)), np.zeros((4, 3))
    told.setflags(write=False)
    assert numba.typeof(mine) != numba.typeof(told)
    shown = [compiled.read_only(each) for each in (mine, told, mine[::2], mine.astype(np.float32))]
    assert {str(numba.typeof(each)) for each in shown[:3]} == {str(numba.typeof(told))}
    assert compiled.read_only(shown[3], np.float64).dtype == np.float64
    assert mine.flags.writeable


def test_threads_are_those_that_sleep_while_they_wait() -> None:
    """TBB's spin, beside other processes, and kept one that was done from ending."""

    @numba.njit(parallel=True)
    def squared(values: np.ndarray) -> None:
        for index in compiled.prange(len(values)):
            values[index] *= values[index]

    squared(np.ones(2))
    assert numba.threading_layer() == "omp"
    assert os.environ["OMP_WAIT_POLICY"] == "passive"


@pytest.mark.slow
def test_numbas_own_functions_are_compiled_with_a_kernel_and_not_to_load_one() -> None:
    """What a command loads from disk is whole; LLVM's optimiser takes 30 MB more."""
    code = (
        "import numpy as np\n"
        "from numba.core.runtime import rtsys\n"
        "from gcode.compiled import njit\n"
        "from gcode.estimate import planner_kernels\n"
        "length = np.array([[10.0, 10.0], [5.0, 5.0], [100.0, 100.0], [1.0, 1.0]])\n"
        "taken = planner_kernels.seconds(length)  # an array of its own: counted by numba\n"
        "before = callable(rtsys._library)\n"
        "twice = njit()(lambda given: given * 2.0)(np.ones(3))\n"
        "print(taken.shape, before, callable(rtsys._library), twice.tolist())\n"
    )
    expected = "(2,) True False [2.0, 2.0, 2.0]"
    for _ in range(2):  # the first compiles it where nobody has before
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
        )
        if done.stdout.split("\n")[0] == expected:
            break
    assert done.stdout.split("\n")[0] == expected


def test_sums_in_any_order_have_one_machine_code() -> None:
    """A `fastmath` kernel that another one calls is inlined there.

    Otherwise the process that compiles it has it twice, alone and within its caller, each adding
    up in an order of its own; it uses the first, and whoever loads the caller from disk the second.
    """
    root = Path(compiled.__file__).parents[1]
    files = [
        file for room in ("amrepair", "gcode") for file in (root / room).rglob("*.py")
        if "njit" in file.read_text()
    ]  # fmt: skip
    trees = [ast.parse(file.read_text()) for file in files]
    assert len(trees) > 30
    called: set[str] = set()
    reordering: set[str] = set()
    for function in (n for tree in trees for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)):
        options = {
            word.arg: ast.literal_eval(word.value)
            for decorator in function.decorator_list
            if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "njit"
            for word in decorator.keywords
        }
        if not options:
            continue
        called |= {
            ast.unparse(n.func).rsplit(".")[-1]
            for n in ast.walk(function)
            if isinstance(n, ast.Call)
        }
        if options.get("fastmath") and options.get("inline") != "always":
            reordering.add(function.name)
    assert reordering, "the kernels of the search"
    assert not reordering & called


KERNEL = """
import sys, time
from pathlib import Path
import numpy as np
from gcode.compiled import njit

@njit(cache=True)
def kernel(points):
    return points.sum()

me, folder, others = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
(folder / f"ready-{me}").touch()
while len(list(folder.glob("ready-*"))) < others:
    time.sleep(0.001)
kernel(np.ones((4, 3)))
print(sum(kernel.stats.cache_misses.values()), sum(kernel.stats.cache_hits.values()))
"""


def test_of_processes_that_start_together_one_compiles(tmp_path: Path) -> None:
    """On a new machine every worker compiled every kernel, at the same time as the others."""
    script = tmp_path / "kernel.py"
    script.write_text(KERNEL)
    running = [
        subprocess.Popen(
            [sys.executable, str(script), str(k), str(tmp_path), "2"],
            stdout=subprocess.PIPE, text=True, cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        for k in range(2)
    ]  # fmt: skip
    told = [tuple(map(int, one.communicate(timeout=120)[0].split())) for one in running]
    assert sorted(told) == [(0, 1), (1, 0)]


def test_a_turn_that_nobody_gives_back_is_waited_for_no_longer(tmp_path: Path) -> None:
    held, late = (compiled._Turn(tmp_path / "kernel.lock") for _ in range(2))
    assert held.take()
    assert not held.take()  # it has it
    assert not late.take(wait_s=0.05)
    held.give()
    assert late.take(wait_s=0.05)
    late.give()
    assert not compiled._Turn(Path("/dev/null/kernel.lock")).take()


@pytest.mark.parametrize("was_on", [True, False])
@pytest.mark.parametrize("fails", [True, False])
def test_the_collector_rests_while_a_kernel_is_compiled_and_is_as_it_was_afterwards(
    was_on: bool, fails: bool
) -> None:
    seen: list[bool] = []

    def asked() -> int:
        return 1

    @overload(asked)
    def told() -> Any:  # numba asks for it while it finds out the kernel's types
        seen.append(gc.isenabled())
        return None if fails else lambda: 1

    kernel = numba.njit(lambda: asked())  # noqa: PLW0108 - the kernel has to call it
    (gc.enable if was_on else gc.disable)()
    try:
        with pytest.raises(TypingError) if fails else nullcontext():
            kernel.compile(())
        assert gc.isenabled() is was_on
    finally:
        gc.enable()
    assert seen
    assert not any(seen)


LINKED = """
import sys
import numpy as np
from gcode.compiled import all_from_disk, njit, prange

@njit(inner=True, cache=True)
def own(value):
    if value < 0.0:
        raise ValueError("too small", 7)
    return min(value, 0.5)

@njit(cache=True, parallel=True)
def each(values):
    found = np.zeros(len(values))
    for k in prange(len(values)):
        found[k] = own(values[k])
    return found

@njit(cache=True)
def one(value):
    return own(value) + 3.0

@njit(cache=True)
def other(value):
    return own(value) - 3.0

def said(kernel, value):
    try:
        return kernel(value)
    except (ValueError, TypeError) as error:
        return type(error).__name__, error.args[-1]

print(each(np.array([0.2, 3.0])).tolist(), said(one, 0.25), said(one, -1.0), all_from_disk())
if sys.argv[1:]:
    print(said(other, 0.25), said(other, -1.0), said(own, 0.25)[0])
"""


@pytest.mark.slow
def test_what_kernels_alone_call_is_in_the_code_of_each_that_calls_it(tmp_path: Path) -> None:
    """Compiled with its first caller, loaded with it from disk, and loaded for another one."""
    (tmp_path / "linked.py").write_text(LINKED)
    told = [
        subprocess.run(
            [sys.executable, str(tmp_path / "linked.py"), *turn],
            env={**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True, text=True, check=True,
        ).stdout.splitlines()
        for turn in ([], ["other"])
    ]  # fmt: skip
    found = "[0.2, 0.5] 3.25 ('ValueError', 7)"
    assert told == [[f"{found} False"], [f"{found} True", "-2.75 ('ValueError', 7) TypeError"]]


# Python calls them, too: their tests do.
TESTED_ALONE = {"_paired_in_order", "inside", "triangles", "move_aside"}


def test_no_kernel_that_kernels_alone_call_has_a_way_in() -> None:
    """A way in from Python takes as long to compile as a small kernel does."""
    kernels: dict[tuple[str, str], bool] = {}
    asked: set[tuple[str, str]] = set()
    for path in (p for top in ("gcode", "amrepair") for p in (ROOT / top).rglob("*.py")):
        if "_kernels" not in (text := path.read_text()) and not path.stem.endswith("_kernels"):
            continue
        tree, rooms = ast.parse(text), dict[str, str]()
        for node in ast.walk(tree):
            if path.stem.endswith("_kernels") and isinstance(node, ast.FunctionDef):
                said = [ast.unparse(option) for option in node.decorator_list]
                if said and "inline='always'" not in said[0]:
                    kernels[path.stem, node.name] = "inner=True" in said[0]
            elif isinstance(node, ast.ImportFrom) and not path.stem.endswith("_kernels"):
                for name in node.names:
                    asked.add(((node.module or "").rpartition(".")[2], name.name))
                    rooms[name.asname or name.name] = name.name
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                asked.add((rooms.get(node.value.id, ""), node.attr))
    assert len(kernels) > 200
    wrong = {kernel for kernel, inner in kernels.items() if inner == (kernel in asked)}
    wrong = {kernel for kernel in wrong if kernel[1] not in TESTED_ALONE}
    assert not wrong, "either `inner=True` is missing, or Python calls it"
