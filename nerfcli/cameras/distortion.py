"""Distortion of the plane: the polynomial displacement of COLMAP's and OpenCV's models, and its inverse.

    F(q) = q A(s) / B(s) + 2 (p . q) q + s (p + u) + s^2 v,    s = |q|^2,
    A(s) = 1 + a_1 s + a_2 s^2 + ...,    B(s) = 1 + b_1 s + ...

a is `radial`, b the `divisor`, p is `tangential` (OpenCV's p2, p1), u and v are the `prism` terms of second and fourth
order. g(rho) = rho A / B is the radius to which the radial part alone moves the radius rho. Points are (2, N), with
the coordinates first.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.polynomial import polynomial

# Newton's method converges quadratically: after a step of this size, relative to the radius, only rounding is left.
LAST_STEP = 1e-8
# Three steps are mostly enough; if a step fails, the interval or the step is halved, which takes at most this many.
MOST_STEPS = 80
# Coefficients below this fraction of the largest count as zero in root finding, so that no quotient overflows.
NEGLIGIBLE = 1e-200


@dataclass(frozen=True)
class Distortion:
    """The displacement F; a group of terms that the model does not have is ()."""

    radial: tuple[float, ...] = ()
    divisor: tuple[float, ...] = ()
    tangential: tuple[float, ...] = ()
    prism: tuple[float, ...] = ()
    prism_fourth: tuple[float, ...] = ()

    @cached_property
    def reach(self) -> float:
        """The radius of the largest disc about the centre on which F is proved to be one to one; may be infinite.

        F is one to one on a disc where the symmetric part of its Jacobian is positive definite, for then
        (q2 - q1) . (F(q2) - F(q1)) > 0. The radial part has the eigenvalues g' and g / rho, and the other terms lower
        them by at most w = (6 |p| + 2 |u|) rho + 4 |v| rho^3 (Weyl's inequality). So the disc ends at the
        smallest root of g' = w, of g / rho = w, or at the pole B = 0, whichever comes first. Without the other terms
        that is exactly where the radius turns back or becomes infinite.
        """
        return _reach(self)

    def apply(self, plane: np.ndarray) -> np.ndarray:
        """Return F at points (2, N)."""
        square = plane[0] ** 2 + plane[1] ** 2
        moved = self._factor(square) * plane
        if self.tangential:
            p = np.array(self.tangential)
            moved += 2 * (p @ plane) * plane + square * p[:, None]
        if self.prism:
            moved += square * np.array(self.prism)[:, None]
        if self.prism_fourth:
            moved += square**2 * np.array(self.prism_fourth)[:, None]
        return moved

    def jacobian(self, plane: np.ndarray) -> np.ndarray:
        """Return dF / dq at points (2, N); (2, 2, N)."""
        x, y = plane
        square = x * x + y * y
        bend = 2 * self._factor_slope(square)
        diagonal = self._factor(square)
        matrix = np.empty((2, 2, plane.shape[1]))
        matrix[0, 0], matrix[1, 1] = diagonal + bend * x * x, diagonal + bend * y * y
        matrix[0, 1] = matrix[1, 0] = bend * x * y
        if self.tangential:
            p = np.array(self.tangential)
            along = 2 * (p @ plane)
            matrix[0, 0] += along
            matrix[1, 1] += along
            matrix += 2 * (p[None, :, None] * plane[:, None] + p[:, None, None] * plane)
        if self.prism:
            matrix += 2 * np.array(self.prism)[:, None, None] * plane
        if self.prism_fourth:
            matrix += 4 * np.array(self.prism_fourth)[:, None, None] * (square * plane)
        return matrix

    def coefficient_jacobian(self, plane: np.ndarray) -> np.ndarray:
        """Return dF / d coefficients at points (2, N), in the order of the fields; (2, coefficients, N)."""
        square = plane[0] ** 2 + plane[1] ** 2
        bottom = polynomial.polyval(square, (1.0, *self.divisor))
        columns = [plane * square**i / bottom for i in range(1, len(self.radial) + 1)]
        factor = self._factor(square)
        columns += [-plane * factor * square**i / bottom for i in range(1, len(self.divisor) + 1)]
        axes = np.eye(2)[:, :, None]
        for i in range(len(self.tangential)):
            columns.append(2 * plane[i] * plane + square * axes[i])
        for i in range(len(self.prism)):
            columns.append(square * axes[i])
        for i in range(len(self.prism_fourth)):
            columns.append(square**2 * axes[i])
        return np.stack(columns, axis=1) if columns else np.zeros((2, 0, plane.shape[1]))

    def invert(self, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the points (2, N) within `reach` that F moves to the targets, and whether each exists, (N,) bool.

        If a point does not exist, the returned one has no meaning. Exact to rounding.
        """
        goals = _radius(targets)
        radii, found, end = self._radii_from_table(goals)
        radial_only = not (self.tangential or self.prism or self.prism_fourth)
        if radial_only:
            radii[found] = self._polished(radii[found], goals[found], end)
        plane = targets * np.where(goals > 0, radii / np.where(goals > 0, goals, 1.0), 1.0)
        return (plane, found) if radial_only else self._invert_all(targets, plane)

    def _factor(self, square: np.ndarray) -> np.ndarray:
        """Return A / B."""
        factor = polynomial.polyval(square, (1.0, *self.radial))
        return factor / polynomial.polyval(square, (1.0, *self.divisor)) if self.divisor else factor

    def _factor_slope(self, square: np.ndarray) -> np.ndarray:
        """Return the derivative of A / B by s."""
        slope = polynomial.polyval(square, polynomial.polyder((1.0, *self.radial)))
        if not self.divisor:
            return slope
        bottom_slope = polynomial.polyval(square, polynomial.polyder((1.0, *self.divisor)))
        return (slope - self._factor(square) * bottom_slope) / polynomial.polyval(square, (1.0, *self.divisor))

    def _radii_from_table(self, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return radii (N,) within reach with g near the goals, whether g reaches them (N,) bool, and the last radius.

        The table ends where g first exceeds all goals, or at the reach. If g does not reach a goal, its radius is the
        last of the table.
        """
        ends = 2.0 ** np.arange(-100, 101)
        if self.reach < ends[-1]:
            ends = np.concatenate(
                [ends[ends < self.reach / 2], self.reach * (1 - 0.5 ** np.arange(1, 51)), [self.reach]]
            )
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            high_enough = np.append(ends[:-1] * self._factor(ends[:-1] ** 2) > goals.max(initial=0.0), True)
            end = ends[np.argmax(high_enough)]
            # This table starts the inversion of the radial part; Newton's method refines the result.
            knots = np.linspace(0.0, end, 4096)
            heights = knots * self._factor(knots**2)
        finite = np.isfinite(heights)  # at a pole they are not
        return np.interp(goals, heights[finite], knots[finite]), ~(goals >= heights[-1]), float(end)

    def _polished(self, radii: np.ndarray, goals: np.ndarray, end: float) -> np.ndarray:
        """Return the radii (N,) in [0, end] with g = goals, refined from approximate ones.

        Newton's method, with bisection wherever a step would leave the interval that holds the root. g increases in
        this interval, so the root is unique.
        """
        active, polished = np.arange(len(radii)), np.empty_like(radii)
        here, goal, low, high = radii, goals, np.zeros_like(radii), np.full_like(radii, end)
        for _ in range(MOST_STEPS):
            square = here * here
            factor = self._factor(square)
            error = here * factor - goal
            low, high = np.where(error < 0, here, low), np.where(error > 0, here, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                moved = here - error / (factor + 2 * square * self._factor_slope(square))
            inside = (moved >= low) & (moved <= high)
            moved = np.where(inside, moved, (low + high) / 2)
            polished[active] = moved
            left = ~inside | (np.abs(moved - here) > LAST_STEP * moved)
            if not left.any():
                break
            active, here, goal, low, high = active[left], moved[left], goal[left], low[left], high[left]
        return polished

    def _invert_all(self, targets: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Invert all terms together, starting from the solution of the radial ones; return the same as `invert`.

        For the weak tangential and prism terms of real lenses, three steps of Newton's method are exact to rounding.
        Points that have not converged then, near the reach or with strong terms, restart with guarded steps.
        """
        plane = start
        for _ in range(3):
            plane = plane - _solve(self.jacobian(plane), self.apply(plane) - targets)
        found = self._meets(targets, plane)
        hard = np.flatnonzero(~found & (_radius(targets) <= self._largest()))
        if len(hard):
            plane[:, hard] = self._by_guarded_steps(targets[:, hard], start[:, hard])
            found[hard] = self._meets(targets[:, hard], plane[:, hard])
        return plane, found

    def _meets(self, targets: np.ndarray, plane: np.ndarray) -> np.ndarray:
        """Return whether points lie within reach and F moves them to their targets; (N,) bool, False at NaN."""
        off = self.apply(plane) - targets
        close = _radius(off) <= 1e-13 * (1 + _radius(targets))
        # Next to a pole F magnifies the point's own rounding; there, the next Newton step must be negligible instead.
        far = np.flatnonzero(~close)
        step = _solve(self.jacobian(plane[:, far]), off[:, far])
        close[far] = _radius(step) <= 1e-14 * _radius(plane[:, far])
        return close & (_radius(plane) < self.reach)

    def _by_guarded_steps(self, targets: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Solve by Newton's method within reach, halving steps that do not bring the image closer to its target."""
        plane, active, target = start.copy(), np.arange(targets.shape[1]), targets
        here = self._pulled_back(start)
        error = self.apply(here) - target
        fraction = np.ones(len(active))
        for _ in range(MOST_STEPS):
            step = fraction * _solve(self.jacobian(here), error)
            moved = self._pulled_back(here - step)
            error_moved = self.apply(moved) - target
            closer = _radius(error_moved) < _radius(error)
            here, error = np.where(closer, moved, here), np.where(closer, error_moved, error)
            fraction = np.where(closer, 1.0, fraction / 2)
            plane[:, active] = here
            left = _radius(step) > LAST_STEP * _radius(here)
            if not left.any():
                break
            active, here, target = active[left], here[:, left], target[:, left]
            error, fraction = error[:, left], fraction[left]
        return plane

    def _largest(self) -> float:
        """Return an upper bound of |F(q)| for points q within reach."""
        if not np.isfinite(self.reach):
            return np.inf
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            square = np.array(self.reach) ** 2
            radial = self.reach * self._factor(square)
            others = 3 * _size(self.tangential) + _size(self.prism) + _size(self.prism_fourth) * square
            return float((np.abs(radial) + others * square) * (1 + 1e-9))

    def _pulled_back(self, plane: np.ndarray) -> np.ndarray:
        """Move points beyond the reach back along their radius to just within it."""
        if not np.isfinite(self.reach):
            return plane
        return plane * np.minimum(1.0, self.reach * (1 - 1e-12) / np.maximum(_radius(plane), 1e-300))


# The photos of a capture have cameras of their own with the same few lenses.
@lru_cache(maxsize=256)
def _reach(distortion: Distortion) -> float:
    """Return `Distortion.reach`."""
    top, bottom = _in_rho(distortion.radial), _in_rho(distortion.divisor)
    others = 6 * _size(distortion.tangential) + 2 * _size(distortion.prism)
    loss = np.array([0.0, others, 0.0, 4 * _size(distortion.prism_fourth)])
    square = polynomial.polymul(bottom, bottom)
    g = polynomial.polymulx(top)
    slope = polynomial.polysub(
        polynomial.polymul(polynomial.polyder(g), bottom), polynomial.polymul(g, polynomial.polyder(bottom))
    )
    margins = [
        bottom,
        polynomial.polysub(slope, polynomial.polymul(loss, square)),
        polynomial.polysub(polynomial.polymul(top, bottom), polynomial.polymul(loss, square)),
    ]
    return min(_first_root(margin) for margin in margins)


def _in_rho(coefficients: tuple[float, ...]) -> np.ndarray:
    """Return the polynomial 1 + c_1 rho^2 + c_2 rho^4 + ... in rho."""
    spread = np.zeros(2 * len(coefficients) + 1)
    spread[0], spread[2::2] = 1.0, coefficients
    return spread


def _first_root(coefficients: np.ndarray) -> float:
    """Return the smallest positive real root of a polynomial that is 1 at 0; infinite where there is none."""
    trimmed = polynomial.polytrim(coefficients, NEGLIGIBLE * np.abs(coefficients).max())
    roots = polynomial.polyroots(trimmed)
    real = roots.real[(np.abs(roots.imag) <= 1e-8 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


def _size(vector: tuple[float, ...]) -> float:
    return math.hypot(*vector)


def _radius(plane: np.ndarray) -> np.ndarray:
    return np.sqrt(plane[0] * plane[0] + plane[1] * plane[1])


def _solve(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return matrices^-1 vectors for (2, 2, N) and (2, N)."""
    (a, b), (c, d) = matrices
    determinant = a * d - b * c
    x, y = vectors
    return np.stack([d * x - b * y, a * y - c * x]) / determinant
