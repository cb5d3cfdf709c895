"""How deep rays pass below surface that they should have ended on, and how surely."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from amrepair.observe.rays import PIXEL_SIGMA, RangeImage, passed, range_images
from amrepair.scans import Scan

STEP_MM = 0.1  # of the rays, at the plate
SENSOR_MM = np.array([-2000.0, 0.0, 9.0])  # so far away that its rays are level at the plate
SHAVED_MM = 0.6  # rays pass so much below the top of the plate, z = 0 to 10, x from −20


def seen_past_a_plate(*, gone: bool = False) -> tuple[RangeImage, ...]:
    """A wall at x = 100 through and around the plate, whose side stops rays from the left."""
    y, z = np.meshgrid(np.arange(-2.0, 2.0, STEP_MM), np.arange(-15.0, 25.0, STEP_MM))
    stopped = (z > 0.0) & (z < 10.0 - SHAVED_MM) & (not gone)
    ways = np.stack([np.full_like(y, -20.0), y, z], axis=-1).reshape(-1, 3) - SENSOR_MM
    ways *= np.where(stopped.ravel(), 1.0, 2100.0 / 1980.0)[:, None]
    index = np.zeros(len(ways), np.int64)
    return range_images(
        Scan(SENSOR_MM + ways, 0.01, "template", sensors_mm=SENSOR_MM[None], sensor_index=index)
    )


def facing(way: tuple[float, float, float], count: int) -> Float[np.ndarray, "n 3"]:
    return np.tile(np.array(way), (count, 1))


def test_rays_beyond_the_far_side_of_a_sound_part_say_nothing_of_its_depth() -> None:
    """They pass again 10 mm farther down: by bisection from there the plate was gone."""
    images = seen_past_a_plate()
    x, y = np.meshgrid(np.arange(-15.0, 15.0, 1.0), [-0.5, 0.0, 0.5])
    top = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 10.0)])
    found = passed(images, top, facing((0.0, 0.0, 1.0), len(top)))
    assert len(found.which) == len(top)
    assert found.depth_mm.max() < SHAVED_MM
    # a pixel and those around it must pass: at most two pixels are held back
    assert found.depth_mm.min() > SHAVED_MM - 2.5 * images[0].step_mm


def test_what_is_gone_altogether_is_passed_as_deep_as_it_was() -> None:
    top = np.array([[0.0, -0.5, 10.0], [0.0, 0.0, 10.0], [0.0, 0.5, 10.0]])
    found = passed(seen_past_a_plate(gone=True), top, facing((0.0, 0.0, 1.0), 3))
    assert (found.depth_mm > 10.0).all()


def test_a_ray_that_grazes_is_as_unsure_of_depth_as_of_its_place_and_a_square_one_is_not() -> None:
    image = seen_past_a_plate()[0]
    at = np.array([[0.0, 0.0, 9.8]])
    grazed = image.passing_error(at, facing((0.0, 0.0, 1.0), 1))[0]
    pixel_mm = image.pixel * (at[0, 0] - SENSOR_MM[0])
    assert np.isclose(grazed, PIXEL_SIGMA * pixel_mm, rtol=1e-3)
    assert image.passing_error(at, facing((-1.0, 0.0, 0.0), 1))[0] < 1e-3 * grazed
