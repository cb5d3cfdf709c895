"""Where torch runs, decided once; and the one place that loads open3d.

Both are heavy and optional to most commands, so nothing here is imported at module level.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
from functools import cache
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
        return importlib.import_module("open3d")
    except ImportError as first_error:
        _log.debug("open3d did not load at once: %s", first_error)
    try:
        libusb = importlib.import_module("libusb_package")
        ctypes.CDLL(str(libusb.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"open3d cannot be loaded ({error}); on Debian or Ubuntu try "
            "'apt-get install libusb-1.0-0 libgl1 libgomp1'"
        ) from error
