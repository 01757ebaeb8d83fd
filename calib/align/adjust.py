"""The self-calibrating adjustment: Schur-complement Levenberg-Marquardt on arrays.

Why our own: no library at hand holds Brown with b1, b2, a residual field and priors on all of
them, and the valley of a nadir block is so flat that stopping has to be decided by the Newton
decrement, not by a small step. On the models that Ceres has too, tests hold ours against it.

Unknowns: lens (35, those in ``free``), poses (cam_from_world rotation and centre), points, and
where a rolling shutter is allowed for, the way that each camera went while its rows were read.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from calib.align.normal import Factored, Linear, Step, Topology, factored, reduced
from calib.align.rotations import rotation_exp, rotation_log, similarity_tangent
from calib.camera import FloatArray
from calib.field import Lens
from calib.solution import BoolArray, Observations


@dataclass(frozen=True)
class Priors:
    """What is known besides the image measurements.

    centres_m (k, 3) with centre_sigma_m (k, 3): measured camera positions; an infinite sigma
    means not measured. rotations (k, 3, 3) with rotation_sigma_rad (k,): measured attitudes.
    lens_mean, lens_sigma (35,) over ``LENS_NAMES``: infinite sigma means no prior.
    """

    centres_m: FloatArray
    centre_sigma_m: FloatArray
    rotations: FloatArray
    rotation_sigma_rad: FloatArray
    lens_mean: FloatArray
    lens_sigma: FloatArray
    #: (k, 3, 3): inverse covariance of each camera's way during the readout, 1/m2; None: global shutter.
    way_information: FloatArray | None = None


@dataclass(frozen=True)
class State:
    """One set of values of all unknowns.

    ``shutter_m`` (k, 3): way of each camera from the first row to the last; the pose is the middle row's.
    """

    lens: Lens
    rotations: FloatArray
    centres_m: FloatArray
    points_m: FloatArray
    shutter_m: FloatArray | None = None


@dataclass(frozen=True)
class Adjusted:
    """Outcome of one adjustment.

    ``lens_normal`` (p, p): normal matrix of the free lens parameters with poses and points
    eliminated, for unit variance factor. ``chi2``: weighted square sum of everything at the end.
    ``sigma0``: square root of the variance factor, 1 when the a-priori sigmas are right.
    ``point_response`` (m, 3, 35): d points / d lens with the block re-adjusted around it, for held
    parameters too: other models move them.
    """

    state: State
    free: BoolArray
    lens_normal: FloatArray
    residuals_px: FloatArray
    weights: FloatArray
    position_weights: FloatArray
    chi2: float
    sigma0: float
    redundancy: int
    iterations: int
    converged: bool
    point_response: FloatArray | None = None

    @property
    def covariance(self) -> FloatArray:
        """(35, 35) formal covariance of the lens, scaled by sigma0; held parameters are zero."""
        full = np.zeros((len(self.free), len(self.free)))
        if self.free.any():
            scale = 1 / np.sqrt(np.diag(self.lens_normal))
            inverse = scipy.linalg.inv(self.lens_normal * np.outer(scale, scale))
            full[np.ix_(self.free, self.free)] = inverse * np.outer(scale, scale) * self.sigma0**2
        return full


class Adjustment:
    """One block to be adjusted, possibly several times under different lens models."""

    def __init__(
        self,
        obs: Observations,
        n_photos: int,
        n_points: int,
        priors: Priors,
        huber_sigmas: float = 2.5,
        robust_positions: bool = True,
        noise_factor: float = 1.0,
    ) -> None:
        """``noise_factor``: variance factor for correlated noise that ``obs.sigma_px`` contains already.

        It makes image measurements weigh less against the priors; sigma0 is given without it.
        """
        self.obs, self.priors = obs, priors
        self.topology = Topology(obs, n_photos, n_points)
        self.huber = huber_sigmas / np.sqrt(noise_factor)
        self.noise_factor = noise_factor
        self.robust_positions = robust_positions
        self._has_centre = np.isfinite(priors.centre_sigma_m).all(axis=1)
        self._has_rotation = np.isfinite(priors.rotation_sigma_rad)
        self._row: FloatArray | None = None

    def with_priors(self, priors: Priors) -> Adjustment:
        """The same observations under other priors of the lens; the index arrays are shared."""
        other = copy.copy(self)
        other.priors = priors
        return other

    @property
    def per_photo(self) -> int:
        """Unknowns a photo: 6, or 9 with a rolling shutter."""
        return 6 if self.priors.way_information is None else 9

    def _rows(self, lens: Lens) -> FloatArray:
        """When each observation's row was read, -0.5 (first) to 0.5 (last), (n,)."""
        if self._row is None:
            self._row = self.obs.pixels[:, 1] / lens.brown.height - 0.5
        return self._row

    def _look_up_rows(self, state: State) -> None:
        """Rows where the points should have been seen.

        Those measured share the residuals' noise, which then looks like ways forward: 4 cm in 40 photos, two
        sigmas, where nothing but the affinity opposes them.
        """
        if self.per_photo == 6:
            return
        for _ in range(2):
            row = state.lens.project(self._rays(state)[1])[:, 1] / state.lens.brown.height - 0.5
            self._row = np.clip(row, -0.5, 0.5)

    # -- residuals -----------------------------------------------------------------------------

    def _rays(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Points in their cameras (n, 3) and rays (n, 2)."""
        offset = state.points_m[self.obs.point] - state.centres_m[self.obs.photo]
        if state.shutter_m is not None:
            offset -= state.shutter_m[self.obs.photo] * self._rows(state.lens)[:, None]
        in_cam = (state.rotations[self.obs.photo] @ offset[:, :, None])[:, :, 0]
        depth = in_cam[:, 2]
        # A point behind its camera is pushed away from the pole; its residual stays huge.
        safe = np.where(np.abs(depth) < 1e-6, 1e-6, depth)
        return in_cam, in_cam[:, :2] / safe[:, None]

    def residuals_px(self, state: State) -> FloatArray:
        """Measured minus projected, (n, 2)."""
        _, rays = self._rays(state)
        return self.obs.pixels - state.lens.project(rays)

    def depths(self, state: State) -> FloatArray:
        """Depth of every observation's point in front of its camera, (n,)."""
        return self._rays(state)[0][:, 2]

    def _weights(self, residuals_px: FloatArray) -> FloatArray:
        size = np.linalg.norm(residuals_px, axis=1) / self.obs.sigma_px
        weights: FloatArray = np.minimum(1.0, self.huber / np.maximum(size, 1e-12))
        return weights

    def _position_terms(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Normalised position residuals (k, 3) and robust weights (k,)."""
        k = len(state.centres_m)
        normalised = np.zeros((k, 3))
        weights = np.zeros(k)
        has = self._has_centre
        if has.any():
            normalised[has] = (
                self.priors.centres_m[has] - state.centres_m[has]
            ) / self.priors.centre_sigma_m[has]
            size = np.linalg.norm(normalised, axis=1)
            weights[has] = (
                np.minimum(1.0, 3.0 / np.maximum(size[has], 1e-12)) if self.robust_positions else 1.0
            )
        return normalised, weights

    def _rotation_terms(self, state: State) -> FloatArray:
        """Normalised attitude residuals (k, 3): measured minus current, rotation vector."""
        normalised = np.zeros((len(state.rotations), 3))
        has = self._has_rotation
        if has.any():
            turned = self.priors.rotations[has] @ state.rotations[has].transpose(0, 2, 1)
            normalised[has] = rotation_log(turned) / self.priors.rotation_sigma_rad[has, None]
        return normalised

    def _robust_weights(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Huber weights of the image measurements (n,) and of the positions (k,) at ``state``."""
        return self._weights(self.residuals_px(state)), self._position_terms(state)[1]

    def cost(self, state: State, weights: tuple[FloatArray, FloatArray]) -> float:
        """Weighted square sum of image measurements and priors."""
        residual = self.residuals_px(state)
        image = np.sum(weights[0] * np.sum(residual**2, axis=1) / self.obs.sigma_px**2)
        position = np.sum(weights[1] * np.sum(self._position_terms(state)[0] ** 2, axis=1))
        attitude = np.sum(self._rotation_terms(state) ** 2)
        has = np.isfinite(self.priors.lens_sigma)
        lens = np.sum(((state.lens.vector - self.priors.lens_mean)[has] / self.priors.lens_sigma[has]) ** 2)
        shutter = 0.0
        known = self.priors.way_information
        if known is not None and state.shutter_m is not None:
            shutter = float(np.einsum("ki,kij,kj->", state.shutter_m, known, state.shutter_m))
        total = float(image + position + attitude + lens + shutter)
        return total if np.isfinite(total) else np.inf

    # -- normal equations ----------------------------------------------------------------------

    def _linearise(self, state: State, free: BoolArray, weights: tuple[FloatArray, FloatArray]) -> Linear:
        obs, top = self.obs, self.topology
        in_cam, rays = self._rays(state)
        pixels, by_ray, by_lens = state.lens.derivatives(rays)
        residual = obs.pixels - pixels
        root = np.sqrt(weights[0]) / obs.sigma_px
        residual = residual * root[:, None]
        inv_z = 1 / np.where(np.abs(in_cam[:, 2]) < 1e-6, 1e-6, in_cam[:, 2])
        by_cam = np.empty((len(obs), 2, 3))
        by_cam[:, :, :2] = by_ray * inv_z[:, None, None]
        by_cam[:, :, 2] = -np.einsum("nij,nj->ni", by_ray, rays) * inv_z[:, None]
        by_cam *= root[:, None, None]
        by_point = by_cam @ state.rotations[obs.photo]
        q = self.per_photo
        by_pose = np.empty((len(obs), 2, q))
        # d in_cam / d omega = -[in_cam]x, hence by_cam @ -[q]x = cross(q, by_cam rows).
        by_pose[:, :, :3] = np.cross(in_cam[:, None, :], by_cam)
        by_pose[:, :, 3:6] = -by_point
        if q == 9:
            by_pose[:, :, 6:] = -by_point * self._rows(state.lens)[:, None, None]
        by_lens = by_lens[:, :, free] * root[:, None, None]

        p = int(free.sum())
        flat = by_lens.reshape(2 * len(obs), p)
        # One pass of each sparse product serves the matrix and the right side.
        to_the_right = np.concatenate([by_lens, residual[:, :, None]], axis=2)
        pose_sums = top.photo_sums(by_pose, np.concatenate([by_pose, to_the_right], axis=2))
        u_cc, u_cl, g_c = pose_sums[:, :, :q].copy(), pose_sums[:, :, q:-1], pose_sums[:, :, -1].copy()
        point_sums = top.point_sums(by_point, np.concatenate([by_point, to_the_right], axis=2))
        v, w_xl, g_x = point_sums[:, :, :3], point_sums[:, :, 3:-1], point_sums[:, :, -1]
        u_ll = flat.T @ flat
        g_l = flat.T @ residual.ravel()
        w_cx = (
            by_pose[:, 0, :, None] * by_point[:, 0, None, :]
            + by_pose[:, 1, :, None] * by_point[:, 1, None, :]
        )

        normalised, weight = self._position_terms(state)[0], weights[1]
        has = self._has_centre
        inv_sigma = np.zeros_like(normalised)
        inv_sigma[has] = 1 / self.priors.centre_sigma_m[has]
        axes = np.arange(3, 6)
        u_cc[:, axes, axes] += weight[:, None] * inv_sigma**2
        g_c[:, 3:6] += weight[:, None] * normalised * inv_sigma
        ways = self.priors.way_information
        if ways is not None:
            u_cc[:, 6:, 6:] += ways
            if state.shutter_m is not None:
                g_c[:, 6:] -= np.einsum("kij,kj->ki", ways, state.shutter_m)
        turn = np.zeros(top.n_photos)
        turn[self._has_rotation] = 1 / self.priors.rotation_sigma_rad[self._has_rotation]
        axes = np.arange(3)
        u_cc[:, axes, axes] += (turn**2)[:, None]
        g_c[:, :3] += self._rotation_terms(state) * turn[:, None]
        known = np.isfinite(self.priors.lens_sigma)
        inv_lens = np.where(known, 1 / np.where(known, self.priors.lens_sigma, 1.0), 0.0)[free]
        u_ll[np.diag_indices(p)] += inv_lens**2
        mean = np.where(known, self.priors.lens_mean, state.lens.vector)
        g_l += ((mean - state.lens.vector)[free]) * inv_lens**2
        return Linear(u_cc, u_cl, u_ll, v, w_cx, w_xl, g_c, g_l, g_x, by_pose, by_lens, by_point)

    def _acceleration(
        self,
        state: State,
        free: BoolArray,
        weights: tuple[FloatArray, FloatArray],
        lin: Linear,
        solver: Factored,
        step: Step,
    ) -> Step:
        """Second-order part of a step: what the residuals' curvature along it calls for.

        A nadir block's valley is long and bent: straight steps leave it at once. Geodesic
        acceleration (Transtrum & Sethna 2012, eq. 12), the curvature by central differences.
        """
        h = 0.1
        ahead, behind = (self._apply(state, free, step.scaled(sign * h)) for sign in (1, -1))

        def curvature(of: Callable[[State], FloatArray]) -> FloatArray:
            bent: FloatArray = (of(ahead) - 2 * of(state) + of(behind)) / h**2
            return bent

        image = curvature(self.residuals_px) * (np.sqrt(weights[0]) / self.obs.sigma_px)[:, None]
        top = self.topology
        column = image[:, :, None]
        g_c = top.photo_sums(lin.by_pose, column)[:, :, 0]
        g_x = top.point_sums(lin.by_point, column)[:, :, 0]
        g_l = lin.by_lens.reshape(image.size, len(lin.g_l)).T @ image.ravel()
        has, turned = self._has_centre, self._has_rotation
        position = curvature(lambda at: self._position_terms(at)[0])
        g_c[has, 3:6] += weights[1][has, None] * position[has] / self.priors.centre_sigma_m[has]
        attitude = curvature(self._rotation_terms)
        g_c[turned, :3] += attitude[turned] / self.priors.rotation_sigma_rad[turned, None]
        return solver.solve(g_c, g_l, g_x)

    @staticmethod
    def _apply(state: State, free: BoolArray, step: Step) -> State:
        """Add a step, its seven-parameter part as a finite transformation.

        The block as a whole is held only by its geotags. Points that move on tangents while the
        cameras turn on circles would break the images' agreement for a move that costs nothing.
        """
        vector = state.lens.vector
        d_pose, d_point = step.pose, step.point
        vector[free] += step.lens
        middle = state.points_m.mean(axis=0)
        offset, offset_c = state.points_m - middle, state.centres_m - middle
        design = similarity_tangent(np.concatenate([offset, offset_c]))
        moves = np.concatenate([d_point, d_pose[:, 3:6]])
        gauge = np.linalg.lstsq(design.reshape(-1, 7), moves.ravel(), rcond=None)[0]
        rest = moves - design @ gauge
        turn = rotation_exp(gauge[None, 3:6])[0]
        grown = np.exp(gauge[6])
        m = len(offset)
        rest_turn = d_pose[:, :3] + (state.rotations @ gauge[3:6])
        shutter = state.shutter_m
        if d_pose.shape[1] == 9:
            before = np.zeros((len(offset_c), 3)) if shutter is None else shutter
            # What the transformation does to the ways already, to first order, is not done twice.
            rest_shutter = d_pose[:, 6:] - np.cross(gauge[3:6], before) - gauge[6] * before
            shutter = grown * before @ turn.T + rest_shutter
        return State(
            lens=state.lens.with_vector(vector),
            rotations=rotation_exp(rest_turn) @ state.rotations @ turn.T,
            centres_m=middle + gauge[:3] + grown * offset_c @ turn.T + rest[m:],
            points_m=middle + gauge[:3] + grown * offset @ turn.T + rest[:m],
            shutter_m=shutter,
        )

    # -- the loop ------------------------------------------------------------------------------

    def run(
        self,
        start: State,
        free: BoolArray,
        max_iterations: int = 100,
        decrement: float = 1e-3,
        reweightings: int = 4,
        response: bool = False,
        weights: tuple[FloatArray, FloatArray] | None = None,
        damping: float = 1e-4,
        tick: Callable[[], None] | None = None,
    ) -> Adjusted:
        """Adjust from ``start`` with the lens parameters in ``free`` estimated.

        Robust weights are renewed up to ``reweightings`` times and constant in between: a plain
        least-squares problem converges in a few steps where Huber's does not in a hundred.
        Stops when the predicted decrease of chi-square falls below ``decrement`` with next to no
        damping: no parameter can then be further than sqrt(decrement) sigmas from its optimum.

        Args:
            response: also give d points / d lens (for the dome).
            weights: keep these weights of measurements (n,) and positions (k,): models compared by
                their chi-square must weigh alike.
            damping: at the start; next to none where ``start`` is near the optimum.
            tick: called once an iteration (progress, cancel by raising).
        """
        state, iterations, converged = start, 0, False
        fixed = weights is not None
        if weights is None:
            weights = self._robust_weights(state)
        for round_ in range(reweightings + 1):
            before = iterations
            last = fixed or round_ == reweightings
            self._look_up_rows(state)
            # The first weights may come from a poor start: do not follow them far.
            limit = max_iterations if round_ >= 2 or last else min(max_iterations, iterations + 6)
            state, iterations, converged, damping = self._descend(
                state, free, weights, damping, iterations, limit, decrement if last else 10 * decrement, tick
            )
            if last or iterations >= max_iterations or (converged and round_ and iterations - before <= 1):
                break
            weights = self._robust_weights(state)
        return self._finish(state, free, weights, iterations, converged, response)

    def _descend(
        self,
        state: State,
        free: BoolArray,
        weights: tuple[FloatArray, FloatArray],
        damping: float,
        iterations: int,
        max_iterations: int,
        decrement: float,
        tick: Callable[[], None] | None,
    ) -> tuple[State, int, bool, float]:
        """Levenberg-Marquardt with constant weights (damping after Nielsen 1999), from and to a damping."""
        growth, idle = 2.0, 0
        history: list[float] = []
        cost = self.cost(state, weights)
        lin = self._linearise(state, free, weights)
        while iterations < max_iterations:
            iterations += 1
            if tick is not None:
                tick()
            try:
                solver = factored(self.topology, lin, damping)
            except np.linalg.LinAlgError:
                damping, growth = max(damping, 1e-9) * growth, growth * 2
                if damping > 1e8:
                    return state, iterations, False, damping
                continue
            step = solver.solve(lin.g_c, lin.g_l, lin.g_x)
            predicted = float(
                np.sum(lin.g_c * step.pose) + lin.g_l @ step.lens + np.sum(lin.g_x * step.point)
            )
            if predicted < decrement and damping < 1e-5:
                return state, iterations, True, damping
            trial = self._apply(state, free, step)
            trial_cost = self.cost(trial, weights)
            if cost - trial_cost < 0.7 * predicted:
                bent = self._acceleration(state, free, weights, lin, solver, step)
                other = self._apply(state, free, step.plus(bent, 0.5))
                other_cost = self.cost(other, weights)
                if other_cost < trial_cost:
                    trial, trial_cost = other, other_cost
            gain = (cost - trial_cost) / max(predicted, 1e-300)
            # Single points on nearly parallel rays can hop about for ever without moving anything else.
            idle = idle + 1 if cost - trial_cost < decrement and predicted < 20 * decrement else 0
            # In a curved valley every full step overshoots; half a sigma from the floor is near enough
            # when ten steps no longer gain a fraction of one.
            history.append(cost)
            crawling = len(history) > 10 and history[-11] - cost < 0.3 and predicted < 0.5
            if idle >= 4 or crawling:
                return (trial if trial_cost < cost else state), iterations, True, damping
            if trial_cost < cost:
                state, cost = trial, trial_cost
                damping *= max(1 / 9, 1 - (2 * min(gain, 1.5) - 1) ** 3) if gain > 0.05 else 4.0
                damping, growth = max(damping, 1e-12), 2.0
                lin = self._linearise(state, free, weights)
            elif predicted < decrement:
                # The step promises nothing any more and rounding decides: this is the floor.
                return state, iterations, damping < 1e-2, damping
            else:
                damping, growth = damping * growth, growth * 2
                if damping > 1e8:
                    return state, iterations, False, damping
        return state, iterations, False, damping

    def functional_covariance(self, adjusted: Adjusted, gradients: FloatArray) -> FloatArray:
        """Formal covariance (c, c) of linear functions of the points, scaled by sigma0.

        All unknowns take part: lens, poses and points.

        Args:
            adjusted: outcome of a run of this adjustment.
            gradients: (m, 3, c), d function / d point. Functions that a shift, turn or scale of the whole
                block changes are only as good as the priors on its place.

        Raises:
            numpy.linalg.LinAlgError: the block is too weak to be inverted.
        """
        weights = (adjusted.weights, adjusted.position_weights)
        lin = self._linearise(adjusted.state, adjusted.free, weights)
        # Next to no damping: weakly held deformations of the block must stay weak.
        solver = factored(self.topology, lin, 1e-13)
        columns = np.moveaxis(gradients, -1, 0)
        solved = [solver.solve(np.zeros_like(lin.g_c), np.zeros_like(lin.g_l), g).point for g in columns]
        covariance = np.einsum("amj,bmj->ab", columns, np.array(solved))
        symmetric: FloatArray = (covariance + covariance.T) / 2 * adjusted.sigma0**2
        return symmetric

    def mean_way(self, adjusted: Adjusted, directions: FloatArray) -> tuple[float, float]:
        """Mean of the cameras' ways along unit vectors (k, 3), m, and its variance at sigma0 = 1, m2.

        Photos with a zero vector do not count. All unknowns take part.

        Raises:
            numpy.linalg.LinAlgError: the block is too weak to be inverted.
        """
        weights = (adjusted.weights, adjusted.position_weights)
        lin = self._linearise(adjusted.state, adjusted.free, weights)
        solver = factored(self.topology, lin, 1e-13)
        gradient = np.zeros_like(lin.g_c)
        gradient[:, 6:] = directions / max(int(directions.any(axis=1).sum()), 1)
        solved = solver.solve(gradient, np.zeros_like(lin.g_l), np.zeros_like(lin.g_x)).pose
        assert adjusted.state.shutter_m is not None  # adjusted with ways
        mean = float(np.sum(gradient[:, 6:] * adjusted.state.shutter_m))
        return mean, float(np.sum(gradient * solved))

    def _finish(
        self,
        state: State,
        free: BoolArray,
        weights: tuple[FloatArray, FloatArray],
        iterations: int,
        converged: bool,
        response: bool,
    ) -> Adjusted:
        obs, top = self.obs, self.topology
        columns = np.ones_like(free) if response else free
        rest = reduced(top, self._linearise(state, columns, weights), 0.0)
        whole = rest.matrix
        k, p = top.n_photos, int(free.sum())
        q = self.per_photo
        cc, cl, ll = whole[: q * k, : q * k], whole[: q * k, q * k :], whole[q * k :, q * k :]
        scale = 1 / np.sqrt(np.maximum(np.diag(cc), 1e-300))
        factor = scipy.linalg.cho_factor(cc * np.outer(scale, scale) + 1e-14 * np.eye(q * k), lower=True)
        pose_by_lens = -scipy.linalg.cho_solve(factor, cl * scale[:, None]) * scale[:, None]
        normal = ll + cl.T @ pose_by_lens
        normal = ((normal + normal.T) / 2)[np.ix_(free[columns], free[columns])]
        point_response = None
        if response:
            back = -(rest.sparse.T @ pose_by_lens).reshape(-1, 3, len(free)) - rest.b_l
            point_response = rest.inverse_root.transpose(0, 2, 1) @ back
        residual = self.residuals_px(state)
        redundancy = (
            2 * len(obs)
            - self.per_photo * k
            - 3 * top.n_points
            - p
            + 3 * int(self._has_centre.sum())
            + 3 * int(self._has_rotation.sum())
            + int(np.isfinite(self.priors.lens_sigma)[free].sum())
        )
        image = float(np.sum(weights[0] * np.sum(residual**2, axis=1) / obs.sigma_px**2))
        # Position misfits tell of the receiver, not of the image measurements: sigma0 is the images' own.
        image_redundancy = max(2 * len(obs) - q * k - 3 * top.n_points - p + 7, 1)
        # Huber weights shrink the square sum of clean normal noise by a few percent.
        sigma0 = float(np.sqrt(image * self.noise_factor / image_redundancy))
        return Adjusted(
            state=state,
            free=free,
            lens_normal=normal,
            residuals_px=residual,
            weights=weights[0],
            position_weights=weights[1],
            chi2=self.cost(state, weights),
            sigma0=sigma0,
            redundancy=redundancy,
            iterations=iterations,
            converged=converged,
            point_response=point_response,
        )
