"""The numbers of the alignment against plain numpy: compiled kernels, covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from amrepair.align import Registration, search_kernels
from amrepair.align.refine import Prior, refine_all
from amrepair.align.refine_kernels import normal_equations
from amrepair.frames import Transform, rotation_from_vector
from amrepair.template import CutTemplate, fit_template
from tests.analytic import box, noisy_scan_points, to_trimesh


def plain(turned, f, gradient, scale, outside=0.0):  # type: ignore[no-untyped-def]
    weight = (scale**2 / (f**2 + scale**2)) ** 2
    if outside:
        weight = np.where(f > 0, np.maximum(weight, outside / np.maximum(f, outside)), weight)
    jacobian = np.concatenate([np.cross(turned, gradient), gradient], axis=1)
    weighted = jacobian * weight[:, None]
    return weighted.T @ jacobian, weighted.T @ f


@pytest.mark.parametrize("outside", [0.0, 0.3])
def test_normal_equations_are_those_of_numpy(outside: float) -> None:
    rng = np.random.default_rng(0)
    turned, gradient = rng.normal(size=(2, 77, 3))
    f = rng.normal(size=77)
    said = (turned, f, gradient, 0.7, outside)
    for made, asked in zip(normal_equations(*said), plain(*said), strict=True):
        assert np.allclose(made, asked, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("known", [None, Prior(np.full(3, 2e-3), np.full(3, 0.05))])
def test_steps_on_a_grid_are_those_of_any_template(known: Prior | None) -> None:
    solid = box((0, 0, 0), (30, 20, 8))
    fitted = fit_template(to_trimesh(solid.body))
    rng = np.random.default_rng(3)
    points = noisy_scan_points(solid.body, spacing_mm=1.0, sigma_mm=0.03, seed=3)[0]
    starts = []
    for size in (0.0, 0.3, 1.0, 40.0):  # the last one beyond the grid
        start = np.eye(4)
        start[:3, :3] = rotation_from_vector(0.05 * size * rng.normal(size=3))
        start[:3, 3] = size * rng.normal(size=3)
        starts.append(start)
    made, asked = (
        refine_all(
            points,
            template,
            starts,
            start_scale_mm=0.5,
            end_scale_mm=0.1,
            sigma_mm=0.03,
            prior=known,
        )
        for template in (fitted, CutTemplate(fitted, 1e3))  # a cut one answers from no grid
    )
    for one, other in zip(made, asked, strict=True):
        assert (one.iterations, one.converged) == (other.iterations, other.converged)
        assert np.allclose(one.matrix, other.matrix, atol=1e-6)
        assert np.allclose(one.residual_mm, other.residual_mm, atol=1e-6)
        assert np.allclose(one.information, other.information, rtol=1e-4, atol=1.0)
    assert made[1].converged
    assert np.abs(made[1].matrix - np.eye(4)).max() < (0.1 if known is None else 1.0)


def test_the_coarse_field_is_trilinear_and_goes_on_beyond_its_border() -> None:
    rng = np.random.default_rng(1)
    shape = np.array([9, 12, 7])
    values = rng.normal(size=tuple(shape)).astype(np.float32)
    points = rng.uniform(-9.0, 9.0, (101, 3)).astype(np.float32)  # some beyond the grid
    turn, place = rotation_from_vector(np.array([0.3, -0.8, 0.5])), np.array([4.1, 5.2, 3.3])
    turned = points.astype(np.float64) @ turn.T

    def asked(at: np.ndarray) -> np.ndarray:
        inside = np.clip(at, 0.0, shape - 1.001)
        found = map_coordinates(values.astype(np.float64), inside.T, order=1)
        return np.asarray(found + np.linalg.norm(at - inside, axis=1))

    f = asked(turned + place)
    step = 1e-5
    gradient = np.stack(
        [asked(turned + place + e) - asked(turned + place - e) for e in step * np.eye(3)], axis=1
    ) / (2.0 * step)
    # beyond the border the field is taken to rise straight away from it
    clipped = np.clip(turned + place, 0.0, shape - 1.001)
    away = turned + place - clipped
    outside = np.linalg.norm(away, axis=1) > 0.0
    assert 0 < outside.sum() < len(points)
    gradient[outside] = away[outside] / np.linalg.norm(away[outside], axis=1, keepdims=True)
    h, b = np.zeros((6, 6)), np.zeros(6)
    total = search_kernels._accumulate(
        np.ascontiguousarray(points.T), turn, place, values.ravel(), shape, 2.0, 1.0, h, b
    )
    hessian, slope = plain(turned, f, gradient, 2.0)
    assert np.allclose(h, np.tril(hessian), rtol=1e-3, atol=1e-3 * np.abs(hessian).max())
    assert np.allclose(b, -slope, rtol=1e-3, atol=1e-3 * np.abs(slope).max())
    assert abs(total - np.minimum(np.abs(f), 1.0).sum()) < 1e-3 * len(points)
    means = search_kernels.misfits(
        np.ascontiguousarray(points.T),
        np.stack([turn, turn]),
        np.stack([place, place + 100.0]),
        values.ravel(),
        shape,
        1.0,
    )
    assert np.allclose(means, [np.minimum(np.abs(f), 1.0).mean(), 1.0], atol=1e-3)


def test_the_covariance_is_the_informations_inverse_and_finite_where_motion_is_free() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    stay = Transform.identity("template", "scanner")
    known = Registration(stay, 0.0, 1.0, root @ root.T, (), "robust", 1)
    assert np.allclose(known.covariance @ known.information, np.eye(6))
    free = Registration(stay, 0.0, 1.0, np.diag([1e6, 1e6, 0.0, 1e4, 1e4, 1e4]), (), "robust", 1)
    assert free.covariance[2, 2] >= 1e5
    assert np.allclose(np.diag(free.covariance)[[0, 3]], [1e-6, 1e-4])
    nothing = Registration(stay, 0.0, 1.0, np.zeros((6, 6)), (), "robust", 1)
    assert np.isfinite(nothing.covariance).all()
