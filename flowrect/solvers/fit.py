"""A rotation, and a direction of t, fitted to matches by their residuals in pixels.

*5-DoF*: R = exp(ω) R₀ and t̂ = normalise(t̂₀ + B b), with ω the turn (3,) about the right camera's
axes and b (2,) along two axes B across t̂₀; the residual of a match is its Sampson error, the
distance in pixels (to first order) that both ends together must move to satisfy x_rᵀ F x_l = 0.
*3-DoF*: the same with t as given. Wrong matches are held down by Cauchy's loss, whose scale is
graduated from what a bad prior leaves to what good matches leave. Yaw is observed 10 to 20 times
worse than pitch, and the length of t never: see CONVENTIONS.md.

Sources: R. Hartley and A. Zisserman, *Multiple View Geometry*, 2nd ed., 11.4.3 (Sampson error);
A. Blake and A. Zisserman, *Visual Reconstruction*, 1987 (graduated scale).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from flowrect.matches import Matches
from flowrect.solvers.solution import NoSolution, Solution, require_matches
from simgen.geometry import Array, rotation_from_vector, skew, vector_from_rotation

INLIER_PX = 2.0
"""largest Sampson error of a match that supports a pose"""
MIN_SUPPORT = 30
MIN_SHARE = 0.2
"""of supporting matches among all"""
MAX_TURN_DEG = 10.0
"""of a pose against the prior"""
MAX_DIRECTION_DEG = 20.0
"""of t against the prior's; more, since points that are far away or on a plane hardly tell it"""


@dataclass(frozen=True)
class Fit:
    """How a pose is fitted."""

    free_t: bool = True
    """5-DoF; else t stays as given"""
    scales_px: tuple[float, ...] = (8.0, 3.0, 1.0, 0.5)
    """of Cauchy's loss, one after the other"""
    start_deg: float = 1.0
    """the first scale is at least what this turn does in the image's centre: a longer lens sees a
    wrong prior as more pixels"""
    t_sigma_deg: float = 1.0
    """standard deviation of the prior direction of t, about each axis"""
    R_sigma_deg: float = 3.0
    """of the prior rotation: next to nothing where there are matches"""
    max_sigma_deg: float = 0.5
    """largest standard deviation of the turn about any axis: a few matches in one corner agree
    with many poses"""


FIVE_DOF = Fit()
THREE_DOF = Fit(free_t=False)


def fit(
    matches: Matches, K_left: Array, K_right: Array, prior: Array, options: Fit = FIVE_DOF
) -> Solution:
    """Fits a pose to matches, starting from the prior T_right_left (4, 4).

    Raises NoSolution if there are too few matches, or they leave the rotation open.
    """
    require_matches(matches, MIN_SUPPORT)
    problem = _Problem(matches, K_left, K_right, prior, options)
    x = np.zeros(5 if options.free_t else 3)
    first = max(options.scales_px[0], np.deg2rad(options.start_deg) * K_left[1, 1])
    for scale in (first, *options.scales_px[1:]):
        x = least_squares(problem.residuals, x, loss=problem.loss(scale), x_scale=1e-2).x
    R, t = problem.pose(x)
    inliers = np.abs(sampson_px(matches, K_left, K_right, R, t)) < INLIER_PX
    covariance = problem.covariance(x, options.scales_px[-1], inliers)
    sigma_deg = np.rad2deg(np.sqrt(np.diag(covariance)[:3]))
    if sigma_deg.max() > options.max_sigma_deg:
        raise NoSolution(
            f"{inliers.sum()} matches leave the rotation open: {sigma_deg.max():.1f}° about one "
            f"axis, expected at most {options.max_sigma_deg:g}°. Are they all in one place?"
        )
    return Solution(R, t, inliers, covariance)


def require_support(
    solution: Solution, matches: Matches, K_left: Array, K_right: Array, prior: Array
) -> None:
    """NoSolution unless enough matches agree with a pose that is not far from the prior.

    Some matches agree with any pose, by chance; those of two roads, whose horizons and lines are
    alike, with a pose nearby, but half of them behind the cameras.
    """
    seen = matches, K_left, K_right, solution.R, solution.t
    support = (np.abs(sampson_px(*seen)) < INLIER_PX) & (parallax_px(*seen) > -INLIER_PX)
    if support.sum() < max(MIN_SUPPORT, MIN_SHARE * len(matches)):
        raise NoSolution(
            f"only {support.sum()} of {len(matches)} matches lie within {INLIER_PX:g} px of the "
            f"best pose, and before its cameras; expected {MIN_SUPPORT}, and {MIN_SHARE:.0%}. Do "
            "both images show the same scene, and is the prior roughly right?"
        )
    require_nearness(solution, prior)


def require_nearness(solution: Solution, prior: Array) -> None:
    """NoSolution unless the pose lies near the prior T_right_left (4, 4)."""
    turn_deg = np.rad2deg(np.linalg.norm(vector_from_rotation(solution.R @ prior[:3, :3].T)))
    if turn_deg > MAX_TURN_DEG:
        raise NoSolution(
            f"the best pose is {turn_deg:.0f}° away from the prior, expected at most "
            f"{MAX_TURN_DEG:g}°: wrong matches, or a prior that is far off."
        )
    lengths = np.linalg.norm(solution.t) * np.linalg.norm(prior[:3, 3])
    away_deg = np.rad2deg(np.arccos(np.clip(solution.t @ prior[:3, 3] / lengths, -1, 1)))
    if away_deg > MAX_DIRECTION_DEG:
        raise NoSolution(
            f"the right camera of the best pose lies {away_deg:.0f}° away from where the prior has "
            f"it, expected at most {MAX_DIRECTION_DEG:g}°: wrong matches, or a scene that does not "
            "tell, such as a plane or points that are all far away."
        )


def sampson_px(matches: Matches, K_left: Array, K_right: Array, R: Array, t: Array) -> Array:
    """Signed Sampson error (N,) [px] of matches under X_right = R X_left + t."""
    F = np.linalg.inv(K_right).T @ skew(t) @ R @ np.linalg.inv(K_left)
    ones = np.ones((len(matches), 1))
    left, right = np.hstack([matches.uv_left, ones]), np.hstack([matches.uv_right, ones])
    line_right, line_left = left @ F.T, right @ F
    square = (line_right[:, :2] ** 2).sum(1) + (line_left[:, :2] ** 2).sum(1)
    return np.asarray((right * line_right).sum(1) / np.sqrt(np.maximum(square, 1e-30)))


def parallax_px(matches: Matches, K_left: Array, K_right: Array, R: Array, t: Array) -> Array:
    """How far right ends (N,) [px] lie from where a point at infinity would be, on to nearer ones.

    Along the epipolar line, under X_right = R X_left + t; negative behind the cameras.
    """
    rays_left, _ = matches.rays(K_left, K_right)
    towards, epipole = rays_left @ (K_right @ R).T, K_right @ t
    infinite = towards[:, :2] / towards[:, 2:]
    nearer = epipole[:2] - epipole[2] * infinite  # d(uv) / d(1 / z), up to its scale
    length = np.maximum(np.linalg.norm(nearer, axis=1), 1e-30)
    return np.asarray(((matches.uv_right - infinite) * nearer).sum(1) / length)


class _Problem:
    """The residuals of x = ω, or (ω, b)."""

    def __init__(
        self, matches: Matches, K_left: Array, K_right: Array, prior: Array, options: Fit
    ) -> None:
        self.matches, self.K_left, self.K_right = matches, K_left, K_right
        self.R_0, self.length = prior[:3, :3], float(np.linalg.norm(prior[:3, 3]))
        self.t_0 = prior[:3, 3] / self.length
        self.across = _across(self.t_0)
        self.sigma = np.deg2rad([options.R_sigma_deg] * 3 + [options.t_sigma_deg] * 2)

    def pose(self, x: Array) -> tuple[Array, Array]:
        t = self.t_0 + self.across @ x[3:] if len(x) > 3 else self.t_0
        return rotation_from_vector(x[:3]) @ self.R_0, t / np.linalg.norm(t) * self.length

    def residuals(self, x: Array) -> Array:
        """Of the matches [px], then of the prior, in its standard deviations."""
        errors = sampson_px(self.matches, self.K_left, self.K_right, *self.pose(x))
        return np.concatenate([errors, x / self.sigma[: len(x)]])

    def loss(self, scale: float) -> Callable[[Array], Array]:
        """SciPy's rho: Cauchy's by weight for matches, squares for the prior; with derivatives."""
        num = len(self.matches)

        def rho(z: Array) -> Array:
            found = np.stack([z, np.ones_like(z), np.zeros_like(z)])
            shrunk = 1 + z[:num] / scale**2
            cauchy = scale**2 * np.log(shrunk), 1 / shrunk, -1 / (scale * shrunk) ** 2
            found[:, :num] = self.matches.weight * np.stack(cauchy)
            return found

        return rho

    def covariance(self, x: Array, scale: float, inliers: NDArray[np.bool_]) -> Array:
        """(5, 5) of (ω, b) [rad²], about the solution; that of the prior for what is not fitted.

        Source: P. Huber, *Robust Statistics*, 7.6: (JᵀJ)⁻¹ mean(ψ²) / mean(ψ')² of an M-estimator;
        here of the inliers, with what the prior adds.
        """
        if not inliers.any():
            raise NoSolution("no match agrees with the pose that was fitted")
        step = 1e-6 * np.eye(len(x))
        r = self.residuals(x)[: len(inliers)][inliers]
        J = np.stack([self.residuals(x + d) - self.residuals(x - d) for d in step], axis=1) / 2e-6
        J = J[: len(inliers)][inliers]
        q, weight = (r / scale) ** 2, self.matches.weight[inliers]
        psi, slope = r / (1 + q), (1 - q) / (1 + q) ** 2
        factor = np.average(slope, weights=weight) ** 2 / np.average(psi**2, weights=weight)
        precision = factor * (J * weight[:, None]).T @ J
        full = np.diag(self.sigma**2)
        prior = np.diag(self.sigma[: len(x)] ** -2)
        full[: len(x), : len(x)] = np.linalg.inv(precision + prior)
        return full


def _across(t: Array) -> Array:
    """Two unit axes (3, 2) across t (3,): for a horizontal rig about y and z."""
    least = np.argsort(np.abs(t), kind="stable")[:2]
    axes = np.eye(3)[:, np.sort(least)]
    axes -= t[:, None] * (t @ axes)
    return np.asarray(np.linalg.qr(axes)[0] * np.sign(np.diag(np.linalg.qr(axes)[1])))
