"""Find and load profiles: by ID from the shipped folder, or by path; single `inherits`.

A profile's hash is of its resolved content, so that a change in a parent changes the child's.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from gcode.errors import ProfileError
from gcode.profiles.names import Kind, id_of, is_path, list_profiles, profile_dir
from gcode.profiles.own_limits import own_fault
from gcode.profiles.schema import MaterialProfile, PrinterProfile, ProcessProfile

# What pydantic calls values beyond a bound, and how a bound reads.
_BEYOND = frozenset({"greater_than", "greater_than_equal", "less_than", "less_than_equal"})
_BOUNDS = {"ge": "at least", "gt": "more than", "le": "at most", "lt": "less than"}

_P = TypeVar("_P", PrinterProfile, MaterialProfile, ProcessProfile)
Model = TypeVar("Model", bound=BaseModel)


MODELS: dict[Kind, type[BaseModel]] = {
    "printers": PrinterProfile,
    "materials": MaterialProfile,
    "processes": ProcessProfile,
}


def load_printer(id_or_path: str | Path) -> PrinterProfile:
    """Load a printer profile by ID or path."""
    return _load(PrinterProfile, "printers", id_or_path)


def load_material(id_or_path: str | Path) -> MaterialProfile:
    """Load a material profile by ID or path."""
    return _load(MaterialProfile, "materials", id_or_path)


def load_process(id_or_path: str | Path) -> ProcessProfile:
    """Load a process profile by ID or path."""
    return _load(ProcessProfile, "processes", id_or_path)


def content_of(kind: Kind, id_or_path: str | Path) -> dict[str, Any]:
    """Return a profile's content with everything it inherits, before validation."""
    return _resolve(kind, _find(kind, id_or_path).resolve(), ())


def kind_of(id_or_path: str | Path) -> Kind:
    """Which kind of profile an ID or a file is: the one whose keys, and whose parent, it has.

    Raises
    ------
    ProfileError
        Where it is none, or an ID that several kinds have.
    """
    text = str(id_or_path)
    named: list[Kind] = [kind for kind in MODELS if text in list_profiles(kind)]
    if len(named) == 1:
        return named[0]
    if not is_path(text):
        several = f"is a profile of several kinds ({', '.join(named)}); say which"
        nothing = (
            "is no profile; 'gcode profiles list' names them, a file of your own ends in .toml"
        )
        raise ProfileError(f"'{text}' {several if named else nothing}.")
    own = read_toml(_find("printers", text))
    parent = Path(str(own.get("inherits", ""))).name.removesuffix(".toml")
    points = {
        kind: sum(key in model.model_fields for key in own) + (parent in list_profiles(kind))
        for kind, model in MODELS.items()
    }
    best = max(points.values())
    fits = [kind for kind, value in points.items() if value == best]
    if len(fits) > 1:
        raise ProfileError(
            f"{text}: its keys do not tell whether it is of {', '.join(fits)}; say which by --kind."
        )
    return fits[0]


def _find(kind: Kind, id_or_path: str | Path, beside: Path | None = None) -> Path:
    """The file that an ID or a path means."""
    text = str(id_or_path)
    if is_path(text):
        path = Path(text)
        if beside is not None and not path.is_absolute():
            path = beside / path
        if not path.is_file():
            raise ProfileError(f"{path}: no such profile file; give a .toml file or a known ID.")
        return path
    folders = [profile_dir() / kind] if beside is None else [beside, profile_dir() / kind]
    for folder in folders:
        if (folder / f"{text}.toml").is_file():
            return folder / f"{text}.toml"
    known = ", ".join(list_profiles(kind)) or "none"
    raise ProfileError(
        f"Unknown {kind[:-1]} profile '{text}'; known are: {known}.".replace(
            "processe ", "process "
        )
    )


@lru_cache(maxsize=128)
def _load_cached(model: type[Any], kind: Kind, path: Path, stamp: int) -> Any:
    return _sound(_validate(model, _resolve(kind, path, ()), path), path)


def _load(model: type[_P], kind: Kind, id_or_path: str | Path) -> _P:
    path = _find(kind, id_or_path).resolve()
    if _inherits_from_user(path):
        return _sound(_validate(model, _resolve(kind, path, ()), path), path)
    loaded: _P = _load_cached(model, kind, path, path.stat().st_mtime_ns)
    return loaded


def _inherits_from_user(path: Path) -> bool:
    """Whether a parent could change without the file itself changing."""
    return not path.is_relative_to(profile_dir().resolve())


def _resolve(kind: Kind, path: Path, chain: tuple[Path, ...]) -> dict[str, Any]:
    """Content of a file over that of its parent; tables are merged one level deep."""
    if path in chain:
        loop = " → ".join(p.name for p in (*chain, path))
        raise ProfileError(f"{path}: `inherits` runs in a circle ({loop}); remove one link.")
    own = read_toml(path)
    parent = own.pop("inherits", None)
    base: dict[str, Any] = {}
    if parent is not None:
        if not isinstance(parent, str):
            raise ProfileError(f"{path}: key 'inherits' = {parent!r} must be one ID or path.")
        found = _find(kind, parent, beside=path.parent).resolve()
        base = _resolve(kind, found, (*chain, path))
        for key in ("slicer_names", "probe"):  # a child is another machine
            base.pop(key, None)
    for key, value in own.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            base[key] = {**base[key], **value}
        else:
            base[key] = value
    base["id"] = id_of(path)
    return base


def read_toml(path: Path) -> dict[str, Any]:
    """What a file itself says.

    Raises
    ------
    ProfileError
        If it cannot be read, or is no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as e:
        raise ProfileError(f"{path}: not valid TOML ({e}).") from e
    except (OSError, UnicodeDecodeError) as e:
        raise ProfileError(f"{path}: it cannot be read ({e}).") from e


def _validate(model: type[_P], content: dict[str, Any], path: Path) -> _P:
    """The profile, or the first thing wrong with it."""
    digest = hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()
    if "sha256" in content:
        raise ProfileError(f"{path}: key 'sha256' is computed, not written; remove it.")
    return validated(model, {**content, "sha256": digest}, path)


def validated(model: type[Model], content: dict[str, Any], path: Path | str) -> Model:
    """A file's content as a model of it.

    Raises
    ------
    ProfileError
        With the first thing that is wrong: file, key, value, range.
    """
    try:
        return model.model_validate(content)
    except ValidationError as e:
        first = e.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "(whole file)"
        more = f" ({e.error_count() - 1} more)" if e.error_count() > 1 else ""
        if first["type"] == "extra_forbidden":
            known = ", ".join(sorted(model.model_fields))
            raise ProfileError(
                f"{path}: unknown key '{key}' = {first['input']!r}{more}; known keys are: {known}."
            ) from e
        if first["type"] == "missing":
            raise ProfileError(f"{path}: key '{key}' is missing{more}.") from e
        limits = _range(model, first["loc"])
        where = f"{path}: key '{key}' = {first['input']!r}"
        if first["type"] in _BEYOND:
            told = f"it must be {limits}" if limits else first["msg"]
            raise ProfileError(f"{where} is out of range: {told}{more}.") from e
        told = f"it must be {limits}; " if limits else ""
        raise ProfileError(f"{where} is not accepted: {told}{first['msg']}{more}.") from e


def _sound(profile: _P, path: Path) -> _P:
    """The profile, unless it breaks its own limits."""
    fault = own_fault(profile) if isinstance(profile, PrinterProfile) else None
    if fault is not None:
        remedy = " (a line {prime_line} primes within them)" if "start_gcode" in fault else ""
        raise ProfileError(
            f"{path}: the profile breaks its own limits: {fault}; correct one of the two{remedy}."
        )
    return profile


def _range(model: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    """What a key may be, as words; empty where nothing bounds it."""
    at: Any = model
    said: list[Any] = []
    for part in loc:
        if isinstance(part, int):  # of a list: its items' own annotation
            items = get_args(at)
            at = items[min(part, len(items) - 1)] if items else None
            if at is Ellipsis:
                at = items[0]
        elif isinstance(at, type) and issubclass(at, BaseModel) and part in at.model_fields:
            field = at.model_fields[part]
            at, said = field.annotation, list(field.metadata)
        else:
            return ""
        while get_origin(at) is Annotated:
            said = [m for a in get_args(at)[1:] for m in getattr(a, "metadata", [a])]
            at = get_args(at)[0]
    bound = {kind: getattr(m, kind) for m in said for kind in _BOUNDS if hasattr(m, kind)}
    low = bound.get("ge", bound.get("gt"))
    high = bound.get("le", bound.get("lt"))
    if low is None or high is None:
        words = [f"{_BOUNDS[kind]} {value:g}" for kind, value in bound.items()]
        return " and ".join(words)
    return f"{low:g} to {high:g}" + (f", more than {low:g}" if "gt" in bound else "")
