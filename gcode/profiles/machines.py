"""Which shipped printer a slicer's name means: each profile says under which names it is known.

It reads the profiles' own key `slicer_names` and nothing else of them.
"""

from __future__ import annotations

import re
import tomllib
from fnmatch import fnmatchcase
from functools import lru_cache

from gcode.profiles.names import id_of, profile_dir

# "(0.4 mm nozzle)", "0.4 nozzle", and what slicers add of the project a preset was saved in
_ASIDE = re.compile(r"\([^)]*\)|@.*$|\b0\.\d+ ?(?:MM)? ?NOZZLE\b|-? ?COPY\b")
_NAME_GAP = re.compile(r"[\s_-]")


def plain(name: str) -> str:
    """A machine's name in capitals, without spaces, dashes, nozzle."""
    return _NAME_GAP.sub("", _ASIDE.sub("", name.upper().strip('"')))


@lru_cache(maxsize=1)
def _known() -> tuple[tuple[str, str], ...]:
    """Patterns and IDs, the longest pattern first."""
    found = []
    for path in sorted((profile_dir() / "printers").glob("*.toml")):
        names = tomllib.loads(path.read_text(encoding="utf-8")).get("slicer_names", ())
        found += [(pattern, id_of(path)) for pattern in names]
    return tuple(sorted(found, key=lambda pair: -len(pair[0])))


def machine_named(*names: str) -> str | None:
    """The shipped printer that the first of some names means; None where none is known."""
    for name in filter(None, map(plain, names)):
        for pattern, profile in _known():
            if fnmatchcase(name, pattern):
                return profile
    return None
