"""Where torch runs, decided once; and the one place that loads open3d.

Both are heavy and optional to most commands, so nothing here is imported at module level.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import sys
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING, Any

from amrepair.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    import torch

_log = logging.getLogger(__name__)


@cache
def torch_device(request: str = "auto") -> torch.device:
    """The device that learned templates run on.

    Parameters
    ----------
    request
        `auto` (CUDA when present), `cpu` or `cuda`.

    Raises
    ------
    InputError
        If the request is unknown, or CUDA was asked for and is not there.
    """
    import torch

    if request not in {"auto", "cpu", "cuda"}:
        raise InputError(f"device '{request}' is unknown; choose auto, cpu or cuda")
    has_cuda = torch.cuda.is_available()
    if request == "cuda" and not has_cuda:
        raise InputError(
            "device 'cuda' was asked for but torch sees no CUDA device; use --device cpu"
        )
    return torch.device("cuda" if has_cuda and request != "cpu" else "cpu")


@cache
def open3d() -> Any:
    """The open3d module, with the system library that its wheel wants but does not carry.

    The wheel links to libusb-1.0.so.0 (for depth cameras). Where the system has none, the copy
    in the `libusb-package` wheel is loaded first: the loader then finds it by its soname.

    Raises
    ------
    MissingDependencyError
        If open3d still cannot be loaded, naming the package to install.
    """
    try:
        return _loaded_open3d()
    except ImportError as first_error:
        _log.debug("open3d did not load at once: %s", first_error)
    try:
        libusb = importlib.import_module("libusb_package")
        ctypes.CDLL(str(libusb.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        return _loaded_open3d()
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"open3d cannot be loaded ({error}); on Debian or Ubuntu try "
            "'apt-get install libusb-1.0-0 libgl1 libgomp1'"
        ) from error


def _loaded_open3d() -> Any:
    """The module without Dash, a web server that it loads for one of its pictures.

    That takes longer than all else of it. Where somebody asks for the picture, it is loaded.
    """
    if "dash" in sys.modules:
        return importlib.import_module("open3d")
    dash = ModuleType("dash")
    for name in ("Dash", "dcc", "html"):
        setattr(dash, name, _WhenUsed("dash", name))
    sys.modules["dash"] = dash
    try:
        return importlib.import_module("open3d")
    finally:
        del sys.modules["dash"]


class _WhenUsed:
    """What a module has under a name; the module is loaded when it is first used."""

    def __init__(self, module: str, name: str) -> None:
        self._place = module, name

    def _meant(self) -> Any:
        module, name = self._place
        return getattr(importlib.import_module(module), name)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._meant(), name)

    def __call__(self, *values: Any, **named: Any) -> Any:
        return self._meant()(*values, **named)
