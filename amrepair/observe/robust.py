"""Linear least squares with Gaussian priors that regions of defects do not pull.

The unknowns are in units of their priors' standard deviations, so that every prior is a row of
the identity. The loss is Tukey's biweight, whose scale is lowered step by step (graduated
non-convexity): far from the answer everything counts, at the end only what lies near it.

References
----------
Beaton and Tukey 1974 (the loss); Blake and Zisserman 1987 (graduated non-convexity); Künsch 1989
(deleting blocks where errors hang together).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.arrays import Numbers, Values

BIWEIGHT_EFFICIENT = 4.685  # Tukey's constant: 95 % efficient where the noise is Gaussian
MAD_TO_SIGMA = 1.4826  # of a Gaussian
GRADUATION = 1.4  # the loss is narrowed by this factor a step (Yang et al. 2020 use the same)
STEPS_PER_WIDTH = 3
FINAL_STEPS = 60
SCALE_STEPS = 30
LEAST_SOUND = 0.25  # of what was observed
FINALISTS = 3  # descents that are followed to their end
NARROW = 4.0  # data without any noise are judged by a quarter of what a part is allowed
CONVERGED_RATIO = 1e-6  # of a prior's standard deviation


@dataclass(frozen=True, slots=True)
class Problem:
    """Observations of unknowns that are in units of their priors.

    Attributes
    ----------
    design
        (n, p) how each unknown moves each observation, mm.
    observed_mm
        (n,) what was observed.
    share
        (n,) how many independent observations each is worth, 0 to 1.
    allowed_mm
        What a sound part may deviate by; without any noise the loss is zero-weighted from there on.
    """

    design: Float[np.ndarray, "n p"]
    observed_mm: Values
    share: Values
    allowed_mm: float

    def residual_mm(self, unknown: Float[np.ndarray, " p"]) -> Values:
        """Observed minus modelled."""
        return self.observed_mm - self.design @ unknown

    def noise_mm(self, unknown: Values) -> float:
        """Standard deviation of one observation, by those that the loss would count.

        Counted are the nearest `LEAST_SOUND` of them, and what their noise reaches: of a flat part
        that stopped early most lies too low, and would be taken for noise from above.
        """
        off = np.abs(self.residual_mm(unknown))
        order = np.argsort(off, kind="stable")
        off, reached = off[order], np.cumsum(self.share[order])
        least = int(np.searchsorted(reached, LEAST_SOUND * reached[-1]))
        noise_mm = 0.0
        for _ in range(SCALE_STEPS):
            last = int(np.searchsorted(off, self.width_mm(noise_mm), side="right")) - 1
            middle = off[np.searchsorted(reached, reached[max(last, least)] / 2)]
            before_mm, noise_mm = noise_mm, MAD_TO_SIGMA * float(middle)
            if noise_mm == before_mm:
                break
        return noise_mm

    def width_mm(self, noise_mm: float) -> float:
        """From where on an observation has no say: beyond the noise and what a part may have."""
        return float(np.hypot(BIWEIGHT_EFFICIENT * noise_mm, self.allowed_mm))


@dataclass(frozen=True, slots=True)
class Solution:
    """Where the robust cost is least, and what the observations say about it.

    Attributes
    ----------
    unknown
        (p,) in units of the priors.
    weight
        (n,) what the loss leaves of each observation, 0 to 1.
    sigma_mm
        Standard deviation of one observation, with what a sound part is allowed.
    """

    unknown: Float[np.ndarray, " p"]
    weight: Values
    sigma_mm: float


def solve(problem: Problem, starts: tuple[Values, ...] = ()) -> Solution:
    """Return the best of descents from a graduated answer, from zero and from `starts`.

    The best is judged by the noise alone, without what a sound part is allowed: that most lies
    close together says more than that all lies within the tolerance.
    """
    zero = np.zeros(problem.design.shape[1])
    at = [_graduated(problem), zero, *starts]
    noise_mm = min(problem.noise_mm(unknown) for unknown in at)
    width_mm = problem.width_mm(noise_mm)
    narrow_mm = max(BIWEIGHT_EFFICIENT * noise_mm, problem.allowed_mm / NARROW)
    at = [_descend(problem, unknown, width_mm, STEPS_PER_WIDTH) for unknown in at]
    at.sort(key=lambda unknown: _cost(problem, unknown, narrow_mm))
    at = [_descend(problem, unknown, width_mm, FINAL_STEPS) for unknown in at[:FINALISTS]]
    best = min(at, key=lambda unknown: _cost(problem, unknown, narrow_mm))
    weight = biweight(problem.residual_mm(best), width_mm)
    return Solution(best, weight, width_mm / BIWEIGHT_EFFICIENT)


def starts_by_block(problem: Problem, block: Numbers) -> tuple[Float[np.ndarray, " p"], ...]:
    """Answers of plain least squares that leave out a half, a quarter or an eighth of the blocks.

    Blocks are numbered by halving, so that those of one part of the surface share their first
    digits: one that leaves out a region of defects starts beside the truth.
    """
    sigma_mm = problem.width_mm(0.0) / BIWEIGHT_EFFICIENT
    parts = int(block.max()) + 1
    out = [
        block * count // parts == k for count in (2, 4, 8) if count < parts for k in range(count)
    ]
    return tuple(_step(problem, (~left).astype(float), sigma_mm) for left in out)


def _graduated(problem: Problem) -> Values:
    unknown = np.zeros(problem.design.shape[1])
    width_mm = 2.0 * float(np.abs(problem.observed_mm).max())
    final_mm = problem.width_mm(problem.noise_mm(unknown))
    while width_mm > final_mm:
        unknown = _descend(problem, unknown, width_mm, STEPS_PER_WIDTH)
        width_mm /= GRADUATION
        final_mm = problem.width_mm(problem.noise_mm(unknown))
    return unknown


def _descend(problem: Problem, unknown: Values, width_mm: float, steps: int) -> Values:
    for _ in range(steps):
        weight = biweight(problem.residual_mm(unknown), width_mm)
        before, unknown = unknown, _step(problem, weight, width_mm / BIWEIGHT_EFFICIENT)
        if np.abs(unknown - before).max() < CONVERGED_RATIO:
            break
    return unknown


def _cost(problem: Problem, unknown: Values, width_mm: float) -> float:
    inside = np.minimum((problem.residual_mm(unknown) / width_mm) ** 2, 1.0)
    loss = BIWEIGHT_EFFICIENT**2 / 3 * (1 - (1 - inside) ** 3)  # (r / sigma)² near zero
    return float(problem.share @ loss + unknown @ unknown)


def sigma_by_median(values: Values) -> float:
    """The standard deviation of Gaussian values, by the median of how far off theirs they are."""
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values))))


def biweight(residual_mm: Values, width_mm: float) -> Values:
    """Tukey's weight: 1 at zero, 0 from `width_mm` on."""
    return np.maximum(1 - (residual_mm / width_mm) ** 2, 0.0) ** 2


def _step(problem: Problem, weight: Values, sigma_mm: float) -> Float[np.ndarray, " p"]:
    weighted = problem.design.T * (weight * problem.share / sigma_mm**2)
    normal = weighted @ problem.design + np.eye(problem.design.shape[1])
    return np.linalg.solve(normal, weighted @ problem.observed_mm)


def covariance(problem: Problem, solution: Solution, block: Numbers) -> Float[np.ndarray, "p p"]:
    """Covariance of the unknowns: by the noise, and by what leaving out a block changes.

    The second part sees what the noise does not: an unknown that one place alone asks for moves
    when that place is left out, and errors that hang together over a block move it as well.
    """
    each = problem.design * (solution.weight * problem.share / solution.sigma_mm**2)[:, None]
    count = int(block.max()) + 1
    information = np.zeros((count, *[problem.design.shape[1]] * 2))
    pull = np.zeros((count, problem.design.shape[1]))
    for k in range(count):
        here = block == k
        information[k] = each[here].T @ problem.design[here]
        pull[k] = each[here].T @ problem.observed_mm[here]
    whole = information.sum(0) + np.eye(problem.design.shape[1])
    left = np.linalg.solve(whole - information, (pull.sum(0) - pull)[:, :, None])[:, :, 0]
    off = left - left.mean(0)
    by_noise = np.linalg.inv(whole)
    return np.asarray(by_noise + (count - 1) / count * off.T @ off)
