"""Kernels compiled to machine code once and kept on disk, so that what is loaded is what was meant.

numba numbers the files it keeps by how many there are: two processes that compile one kernel for
two kinds of arrays at the same moment take the same number, and either then loads what the other
compiled, with wrong results and no error. Here every process names its files itself. And a kernel
is compiled again when any of the kernels has changed: it may have another one's code in its own.
Of processes that start together on a new machine one compiles a kernel, and the others wait.

numba makes some of its own functions (those within a sort, say) anew for each kernel, of one name
for different work, and tells them apart by counting, in each process from one on. Of two kernels on
disk that two processes had compiled, the one that was loaded first lent the other its own, and a
sort of indices crashed. Here each process counts from a place of its own.

A kernel that may add up in any order (`fastmath`) and is called by another is inlined there
(`inline="always"`). Else the process that compiles both uses the code that stands alone, and a
process that loads the caller from disk the caller's copy, which adds up in another order: the same
scan, judged twice, differed in its fourteenth digit.

How a kernel adds up and divides is its own affair. Where it does not say so, numba compiles it as
the kernel that asked for it first: one that a fast kernel calls added up in any order on one
machine, and in its own on another.

A kernel is compiled for types of arguments, not for values: numba compiles a kernel that another
calls with `True` or `1` in its text once more for that very value, and no kernel asks for it.

A kernel that kernels alone call (`inner=True`) gets no way in from Python, and none gets one from
C: for each of them numba compiles another function, which takes apart every argument. And what has
no way in is neither optimised nor turned into machine code by itself: the kernel that calls it has
it in its own code, where both is done again.

Threads are OpenMP's, and sleep while they wait. Where numba finds a TBB it takes that first, whose
threads spin: beside one other busy process an alignment took six times as long, and a process that
was done did not end for minutes.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import inspect
import itertools
import os
import secrets
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when the first of its threads starts
# numba words and paints every reason why a function of its own does not fit, and shows few of them
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import numba
import numba.np.linalg
import numpy as np
from llvmlite.binding import ffi
from numba import get_num_threads, prange, set_num_threads, types
from numba import version_info as numba_version
from numba.core import bytecode, event
from numba.core.base import BaseContext
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.cpu import CPUContext
from numba.core.environment import lookup_environment
from numba.core.runtime import nrt, nrtdynmod
from numba.core.targetconfig import TargetConfig
from numba.core.typed_passes import BaseNativeLowering
from numba.extending import overload
from numba.np import arrayobj
from numba.np.ufunc import parallel
from numba.parfors import parfor_lowering

from gcode.locks import try_lock

__all__ = ["all_from_disk", "get_num_threads", "njit", "prange", "read_only", "set_num_threads"]

_KERNEL_PACKAGES = ("gcode", "amrepair")
_PROCESS_TOKEN = secrets.token_hex(4)
# What numba leaves to the kernel that calls, where a kernel does not say it itself; and no way in
# from C.
OWN_OPTIONS: dict[str, Any] = {
    "fastmath": False,
    "error_model": "python",
    "no_cfunc_wrapper": True,
}
# The slowest kernel takes six seconds alone, with all that it calls eleven.
LONGEST_COMPILE_S = 60.0
COMPILE_POLL_S = 0.02
# What a process makes while it compiles all kernels is some ten thousand functions.
_PLACE_BITS, _COUNT_BITS = 40, 20
# How numba links what it compiles is its own affair: what is changed there is tested with this one.
_PROVEN_WITH = (0, 68)
_LINKED_ONLY = "linked only"
_CONSTANTS_PREFIX = "_ZN08NumbaEnv"  # as numba names where a function's constants are

if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]


def without_scipy() -> None:
    """Load what numba adds to numpy's functions, but not scipy for it.

    With its first kernel numba loads `scipy.linalg`, to ask whether there is a BLAS that
    `np.correlate` might use: 0.15 s and 15 MB at the start of every command. Who multiplies
    matrices in a kernel has numba ask anew, and scipy loaded.
    """
    asked = numba.np.linalg.ensure_blas

    def not_asked() -> None:
        raise ImportError

    numba.np.linalg.ensure_blas = not_asked
    try:
        importlib.import_module("numba.np.arraymath")
    finally:
        numba.np.linalg.ensure_blas = asked


def runtime_when_asked() -> None:
    """Compile numba's own functions that count references when a kernel is compiled, not before.

    With its first kernel numba compiles them, and so loads LLVM's optimiser: 0.03 s and 30 MB at
    the start of every command. A kernel that was kept on disk has them in its own code; what they
    call is made known to it all the same.
    """
    compile_now: Any = getattr(nrtdynmod, "compile_nrt_functions", None)
    kind: Any = type(nrt.rtsys)
    asked = getattr(getattr(kind, "library", None), "fget", None)
    if compile_now is None or asked is None:
        return  # a numba that does it otherwise: then at once, as it would

    def library(runtime: Any) -> Any:
        found = asked(runtime)
        if isinstance(found, functools.partial):
            with _linked_only(False):
                found = runtime._library = found()
        return found

    nrtdynmod.compile_nrt_functions = functools.partial(functools.partial, compile_now)
    kind.library = property(library)


def shapes_unsaid() -> None:
    """Where a kernel assigns an array to a slice of another shape, say so without the shapes.

    To write them out numba compiles its functions for text with the first kernel of a process that
    assigns to a slice: two seconds, and one more for arrays of two dimensions.
    """
    without_text: Any = getattr(arrayobj, "ol_raise_with_shape_context_generic", None)
    if without_text is None:
        return  # a numba that does it otherwise

    def differ(src_shapes: Any, index_shape: Any) -> None:
        raise NotImplementedError

    overload(differ)(without_text)
    arrayobj.raise_with_shape_context = differ


def options_at_once() -> None:
    """Options of how a kernel is compiled, compared as a whole.

    numba looks up which of its functions a call means by these options, and asks for each of some
    twenty by its name: a tenth of the time that compiling takes.
    """

    def values(self: Any) -> dict[str, Any]:
        return {name: option.default for name, option in self.options.items()} | self._values

    if hasattr(TargetConfig, "values") and "_values" in getattr(TargetConfig, "__slots__", ()):
        cast(Any, TargetConfig).values = values


def lock_untold() -> None:
    """Make no event of every call into LLVM: half a million in a process that compiles all.

    They tell who measures how long others wait for it, and nobody does.
    """
    lock: Any = getattr(ffi.lib, "_lock", None)
    if isinstance(getattr(lock, "_cblist", None), list):
        lock._cblist.clear()


def loops_without_ways_in() -> None:
    """Compile the body of a `prange` with no way in from Python: its threads call it directly."""
    body: Any = cast(Any, parfor_lowering)._create_gufunc_for_parfor_body
    asked = inspect.signature(body)

    def without(*values: Any, **named: Any) -> Any:
        given = asked.bind(*values, **named).arguments
        given["flags"].no_cpython_wrapper = True
        return body(**given)

    cast(Any, parfor_lowering)._create_gufunc_for_parfor_body = without


class _Library(cast(Any, JITCodeLibrary)):  # type: ignore[misc]
    """Code of one function with all that it calls; or, of what is only called, the code to link."""

    compiles_only_callers = False  # set while what is made has no way in of its own

    def __init__(self, *values: Any, **named: Any) -> None:
        super().__init__(*values, **named)
        self._is_linked_only = _Library.compiles_only_callers

    def _optimize_final_module(self) -> None:
        if not self._is_linked_only:
            super()._optimize_final_module()

    def _finalize_final_module(self) -> None:
        if self._is_linked_only:
            self._finalized = True
        else:
            super()._finalize_final_module()

    def serialize_using_object_code(self) -> Any:
        """What is kept on disk; the kind says of what there is no machine code."""
        if not self._is_linked_only:
            return super().serialize_using_object_code()
        name, _, code = self.serialize_using_bitcode()
        return name, _LINKED_ONLY, code

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, code = state
        if kind != _LINKED_ONLY:
            return super()._unserialize(codegen, state)
        with _linked_only(True):
            return super()._unserialize(codegen, (name, "bitcode", code))


@contextlib.contextmanager
def _linked_only(choice: bool) -> Iterator[None]:
    """Libraries that are made meanwhile are linked only, or not; numba's lock is held."""
    before, _Library.compiles_only_callers = _Library.compiles_only_callers, choice
    try:
        yield
    finally:
        _Library.compiles_only_callers = before


def machine_code_at_the_end() -> None:
    """Have numba optimise and compile what is called from Python, with all that it calls, once.

    By itself it does both with each function that a kernel calls, and then with the kernel and all
    of them in it again; with a `prange` four times. Where code is linked alone, the places that
    refer to a function's constants are there only with the kernel's own code, and are set then.
    """
    kinds: tuple[Any, ...] = (BaseContext, BaseNativeLowering, CPUContext, parallel, JITCPUCodegen)
    base, native, context, loops, codegen = kinds
    own, lower = base._compile_subroutine_no_cache, native.run_pass
    executable, set_env = context.get_executable, codegen.set_env
    wrapped, constants_of = loops.build_gufunc_wrapper, cast(Any, lookup_environment)

    def run_pass(self: Any, state: Any) -> Any:
        with _linked_only(bool(state.flags.no_cpython_wrapper)):
            return lower(self, state)

    def _compile_subroutine_no_cache(*values: Any, **named: Any) -> Any:
        with _linked_only(True):
            return own(*values, **named)

    def build_gufunc_wrapper(*values: Any, **named: Any) -> Any:
        with _linked_only(bool(named.get("is_parfors"))):
            return wrapped(*values, **named)

    def get_executable(self: Any, library: Any, fndesc: Any, env: Any) -> Any:
        found = executable(self, library, fndesc, env)
        if not getattr(library, "_is_linked_only", True):
            for variable in library._final_module.global_variables:
                if variable.name.startswith(_CONSTANTS_PREFIX):
                    constants = constants_of(variable.name)
                    if constants is not None:
                        library.codegen.set_env(variable.name, constants)
        return found

    def set_env_if_there(self: Any, env_name: str, env: Any) -> None:
        if self._engine.get_global_value_address(env_name):
            set_env(self, env_name, env)

    base._compile_subroutine_no_cache = _compile_subroutine_no_cache
    native.run_pass, context.get_executable = run_pass, get_executable
    loops.build_gufunc_wrapper = build_gufunc_wrapper
    codegen.set_env, codegen._library_class = set_env_if_there, _Library


class _WithoutCollector(event.Listener):
    """Holds Python's collector of circles while a kernel is compiled.

    numba makes many objects and few circles: to walk over all of them time and again was a tenth
    of the time that compiling takes.
    """

    def __init__(self) -> None:
        self._depth, self._was_on = 0, False
        self.times = 0

    def on_start(self, event: Any) -> None:
        """A kernel, or one that it calls, is about to be compiled."""
        if self._depth == 0:
            self._was_on = gc.isenabled()
            self.times += 1
            gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """It is compiled, or it failed."""
        self._depth -= 1
        if self._depth == 0 and self._was_on:
            gc.enable()


def count_from_own_place() -> None:
    """Number what numba makes in this process as no other process does, nor its parent."""
    if hasattr(bytecode.FunctionIdentity, "_unique_ids"):
        own = secrets.randbits(_PLACE_BITS) << _COUNT_BITS
        bytecode.FunctionIdentity._unique_ids = itertools.count(own + 1)


count_from_own_place()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=count_from_own_place)
without_scipy()
runtime_when_asked()
_without_collector = _WithoutCollector()
cast(Any, event).register("numba:compile", _without_collector)
shapes_unsaid()
options_at_once()
lock_untold()
if numba_version[:2] == _PROVEN_WITH:  # with another release kernels only take longer to compile
    loops_without_ways_in()
    machine_code_at_the_end()


def all_from_disk() -> bool:
    """Whether this process has compiled no kernel so far: those that it asked for were kept."""
    return _without_collector.times == 0


def njit(*, inner: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`, once for each type of arguments, and kept safely where it is kept.

    Parameters
    ----------
    inner
        Whether other kernels alone call it.
    """
    options = OWN_OPTIONS | {"no_cpython_wrapper": inner} | options

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        compile_for_types(dispatcher)
        if inner:
            keep_inside(dispatcher)
        kept = getattr(dispatcher._cache, "_cache_file", None)
        if kept is not None:
            keep_safely(kept)
            compile_in_turn(dispatcher._cache, Path(f"{kept._index_path}.lock"))
        return dispatcher

    return compiled


def read_only(array: Any, kind: Any = None) -> np.ndarray:
    """A contiguous array that nobody writes to, for a kernel that only reads it.

    numba compiles a kernel once for arrays that may be written to and once for those that may not.
    A scan's points may not, what is computed from them may: a kernel that takes both gets both so.
    """
    shown = np.ascontiguousarray(array, dtype=kind).view()
    shown.setflags(write=False)
    return shown


def compile_for_types(dispatcher: Any) -> None:
    """Take literal arguments of a kernel's call in another one for what they are an example of."""
    asked, unliteral = dispatcher.get_call_template, cast(Any, types.unliteral)

    def template(args: Any, kws: Any) -> Any:
        named = {name: unliteral(kind) for name, kind in kws.items()}
        return asked(tuple(unliteral(kind) for kind in args), named)

    dispatcher.get_call_template = template


def keep_inside(dispatcher: Any) -> None:
    """Refuse calls from Python, which would jump to where nothing is."""

    def add(compiled: Any) -> None:
        dispatcher.overloads[tuple(compiled.signature.args)] = compiled

    def refuse(*values: Any, **named: Any) -> Any:
        raise TypeError(f"kernels alone call {dispatcher.__name__}; see `inner` in gcode.compiled")

    dispatcher.add_overload, dispatcher._compile_for_args = add, refuse


def keep_safely(kept: Any) -> None:
    """Names of its own, and the state of all kernels, for one of numba's caches on disk.

    Parameters
    ----------
    kept
        A `numba.core.caching.IndexDataCacheFile` that has not loaded anything yet.
    """
    base = kept._data_name(0).removesuffix(".0.nbc")
    # A forked process has its parent's token, but a process number of its own.
    kept._data_name = lambda number: f"{base}.{os.getpid():x}-{_PROCESS_TOKEN}.{number}.nbc"
    kept._source_stamp = (*kept._source_stamp, kernels_stamp())
    load = kept._load_index

    def load_what_is_known() -> Any:
        try:
            return load()
        except (AttributeError, ImportError):  # it names a record that the code no longer has
            return {}

    kept._load_index = load_what_is_known


def compile_in_turn(cache: Any, lock: Path) -> None:
    """Have one process compile a kernel while others that need it wait, and load what it kept.

    Parameters
    ----------
    cache
        A `numba.core.caching.FunctionCache`: it is asked before a kernel is compiled, and told
        afterwards.
    lock
        File whose lock is the turn. It dies with its process.
    """
    load, save, turn = cache.load_overload, cache.save_overload, _Turn(lock)

    def load_in_turn(signature: Any, context: Any) -> Any:
        found = load(signature, context)
        if found is None and turn.take():
            found = load(signature, context)  # somebody else may have compiled it meanwhile
            if found is not None:
                turn.give()
        return found

    def save_in_turn(signature: Any, compiled: Any) -> None:
        try:
            save(signature, compiled)
        finally:
            turn.give()

    cache.load_overload, cache.save_overload = load_in_turn, save_in_turn


class _Turn:
    """The right to compile a kernel; who waits too long compiles it all the same."""

    def __init__(self, path: Path) -> None:
        self._path, self._fd = path, -1

    def take(self, *, wait_s: float = LONGEST_COMPILE_S) -> bool:
        """Wait for the turn; false where it is held already, or cannot be had."""
        if self._fd >= 0:
            return False
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            fd = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            return False  # nothing can be kept there, either
        until_s = time.monotonic() + wait_s
        while True:
            if try_lock(fd):
                self._fd = fd
                return True
            if time.monotonic() > until_s:
                os.close(fd)
                return False
            time.sleep(COMPILE_POLL_S)

    def give(self) -> None:
        """Give the turn to the next."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


def kernels_stamp() -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every file with kernels, and of how they are compiled."""
    return sources_stamp(("_kernels.py", Path(__file__).name))


@functools.cache
def sources_stamp(endings: tuple[str, ...]) -> tuple[tuple[str, int, int], ...]:
    """Name, time of change and size of every file of both packages that ends so."""
    root = Path(__file__).parents[1]
    found = []
    for package in _KERNEL_PACKAGES:
        for folder, _, names in os.walk(root / package):
            for name in names:
                if name.endswith(endings):
                    stat = Path(folder, name).stat()
                    found.append((name, stat.st_mtime_ns, stat.st_size))
    return tuple(sorted(found))
