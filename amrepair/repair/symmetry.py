"""Symmetric parts: a scan fits in several poses, and the place of the damage tells which is true.

Each pose would repair the same hole at another place of the bed. So a person is asked where on the
bed the damage is, unless all poses lead to the same repair.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.align.registration import Registration
from amrepair.deficit import Deficit
from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.repair.site import Site
from amrepair.scans import Scan
from gcode.meshes import box_of_solid

TOLD_PLACES = 6  # a message is read by a person


def registration_of_damage(
    scan: Scan, site: Site, registration: Registration, deficit: Deficit
) -> Registration:
    """The registration under which the damage lies where it was said to lie on the bed.

    A symmetric part fits a scan in several poses, and in each of them the same damage would be
    repaired in another place. Where a person says roughly where it is, that tells them apart.

    Returns
    -------
    The same registration where nothing has to be told apart.

    Raises
    ------
    AlignmentError
        If poses would lead to different repairs and nobody said where the damage is, or what was
        said suits several of them.
    """
    if not registration.symmetric_alternatives or deficit.missing.is_empty():
        return registration
    if site.build_from_template is None:
        return registration  # a scan in the build frame: each pose that fits repairs that place
    repairs = _repairs(site, registration, deficit)
    first = repairs[0]
    ratio = site.options.same_repair_ratio
    others = [one for one in repairs[1:] if not one.is_as(first, ratio)]
    if not others:
        return registration
    told = f"the scan {scan.source} fits its template in {len(repairs)} poses equally well"
    if site.damage_at_mm is None:
        places = " or ".join(one.place for one in (first, *others)[:TOLD_PLACES])
        more = " or …" if len(others) >= TOLD_PLACES else ""
        raise AlignmentError(
            f"{told}, and they would repair different places; say by 'amrepair repair "
            f"--damage-at X,Y' where on the bed the largest damage is ({places}{more}), "
            "or scan in the build frame"
        )
    off_mm = [float(np.linalg.norm(one.at_mm - site.damage_at_mm)) for one in repairs]
    nearest = repairs[int(np.argmin(off_mm))]
    limit_mm = min(off_mm) + site.options.damage_told_within_mm
    rivals = [
        one
        for one, away_mm in zip(repairs, off_mm, strict=True)
        if away_mm < limit_mm and not one.is_as(nearest, ratio)
    ]
    if rivals:
        raise AlignmentError(
            f"{told}, and --damage-at {site.damage_at_mm[0]:g},{site.damage_at_mm[1]:g} does not "
            f"tell {nearest.place} from {rivals[0].place}: one has to be nearer by "
            f"{site.options.damage_told_within_mm:g} mm, as exactly as a hand shows a place; scan "
            "in the build frame"
        )
    if nearest.is_as(first, ratio):
        return registration
    rest = tuple(one.pose for one in repairs if one is not nearest)
    return replace(registration, template_from_scan=nearest.pose, symmetric_alternatives=rest)


@dataclass(frozen=True, slots=True)
class _Repair:
    """What would be filled under one pose, build frame; `at_mm` (2,): its largest piece."""

    pose: Transform
    missing: manifold3d.Manifold
    at_mm: Float[np.ndarray, " 2"]

    @property
    def place(self) -> str:
        """The place as --damage-at takes it."""
        return f"{self.at_mm[0]:.0f},{self.at_mm[1]:.0f}"

    def is_as(self, other: _Repair, ratio: float) -> bool:
        """Whether the two fill the same place: they share at least this ratio of the volume."""
        if self is other:
            return True
        return bool((self.missing ^ other.missing).volume() >= ratio * self.missing.volume())


def _repairs(site: Site, registration: Registration, deficit: Deficit) -> list[_Repair]:
    """The same scanned hole under the best pose, and then under each of the alternatives."""
    assert site.build_from_template is not None
    largest = max(deficit.missing.decompose(), key=lambda piece: piece.volume())
    centre_mm = box_of_solid(largest).mean(axis=0)[None]
    build, template = site.build_from_template, registration.template_from_scan
    repairs = []
    for pose in (template, *registration.symmetric_alternatives):
        motion = build @ pose @ template.inverse() @ build.inverse()
        missing = motion.solid(deficit.missing)
        repairs.append(_Repair(pose, missing, motion.apply(centre_mm)[0, :2]))
    return repairs
