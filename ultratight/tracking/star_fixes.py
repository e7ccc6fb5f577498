"""A bank of attitude filters over the fixes of a star tracker: a whole flight in one compiled call.

The states and the measurement are `ins.star_tracker`'s, moments are taken by a rule of
`filters.rules` over the three angles (linearised: extended Kalman filter; unscented-projected:
unscented transform, which is marginal since z depends on phi alone), predicting and conditioning is
`filters.conditioning`'s.  Models differ in Q and are never mixed (MMAE, see
`filters.multiple_model`); one model alone is a plain filter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from signals.compiled import FAST_SUM, kernel
from ultratight.filters.adaptive import is_semidefinite
from ultratight.filters.conditioning import condition_on, innovation_cov, predict_into
from ultratight.filters.door import covariance, whole, whole_rows
from ultratight.filters.gaussian import LOG_2PI, Gaussian
from ultratight.filters.multiple_model import Bank, bank_of, merge_into, normalise
from ultratight.filters.rules import Rule, get_rule, psd_cholesky, regress, scatter
from ultratight.ins.star_tracker import N_ERRORS, misalign, predicted, slope, wrap


class Epochs(NamedTuple):
    """First fix (0 is the first of z) of each mishap, -1 where there was none."""

    refused: int  # some model's S not positive definite: its update was left out
    P: int  # covariance of the mixture not positive semi-definite
    overflow: int  # a number was not finite: the run ended, what follows is NaN


class StarRun(NamedTuple):
    """The mixture after each fix, its weights, and what each of nh models made of the fix."""

    mean: np.ndarray  # (n, 9)
    variance: np.ndarray  # (n, 9) diagonal of P
    weight: np.ndarray  # (n, nh)
    nis: np.ndarray  # (n, nh) of three angles; NaN without update
    last: Bank
    first: Epochs


class Weighing(NamedTuple):
    """How likelihoods become weights: l <- forgetting l + log likelihood, weights above a floor."""

    floor: float = 1e-3  # 0: none, a model that was ruled out hardly ever returns
    forgetting: float = 1.0
    from_fix: int = 0  # weights rest before


BY_FLOOR = Weighing()
_TURNED = 1e-6  # by how much C' C of a rotation may be off one


def run_star_fixes(
    start: Gaussian,
    C_ins: ArrayLike,
    z: ArrayLike,
    tau_s: float,
    Q: ArrayLike,
    R: ArrayLike,
    rule: Rule | str = "linearised",
    *,
    accel_tau_s: float = math.inf,
    weighing: Weighing = BY_FLOOR,
    passes: int = 1,
) -> StarRun:
    """Filter z (n, 3) [rad], the fixes at the ends of n intervals of tau_s.

    Parameters
    ----------
    start : density of the nine errors at the start, for all models.
    C_ins : (n + 1, 3, 3) attitude of the INS at the start and at each fix.
    z : rows of NaN are fixes that are missing.
    Q : (1 or n, nh, 9) variances that model j adds per interval, in all or in each of them.
    R : (3, 3) of the fixes [rad2].
    accel_tau_s : correlation time of the accelerometers' biases.
    passes : linearisations of the first fix, each at the posterior of the one before.

    Raises
    ------
    ValueError
        Shapes disagree, no model, a number that is not finite, a covariance that is not symmetric
        and positive semi-definite, attitudes that are no rotations, a rule in R^n, options out of
        bounds.
    """
    P0, C, z = _array("start.cov", start.cov), _array("C_ins", C_ins), np.array(z, dtype=float)
    mean, Q, R = _array("start.mean", start.mean), _array("Q", Q), _array("R", R)
    n = len(z)
    shapes = (
        ("z", z, (max(n, 1), 3)), ("start.mean", mean, (N_ERRORS,)),
        ("start.cov", P0, (N_ERRORS, N_ERRORS)), ("C_ins", C, (n + 1, 3, 3)), ("R", R, (3, 3)),
    )  # fmt: skip
    for name, value, expected in shapes:
        if value.shape != expected:
            raise ValueError(f"{name}: shape {value.shape}, expected {expected}")
    if Q.ndim != 3 or len(Q) not in (1, n) or Q.shape[1] < 1 or Q.shape[2] != N_ERRORS:
        raise ValueError(f"Q: shape {Q.shape}, expected (1 or {n}, one model or more, {N_ERRORS})")
    if not Q.min() >= 0.0:
        raise ValueError(f"Q: {Q.min()}, expected variances")
    covariance("start.cov", P0)
    covariance("R", R)
    seen = whole_rows("z", z)
    rule = get_rule(rule) if isinstance(rule, str) else rule
    if rule.space == "full":
        raise ValueError(f"rule: {rule.name!r}, expected one of the projected space")
    if not (0.0 < tau_s < math.inf and accel_tau_s > 0.0):
        raise ValueError(f"tau_s, accel_tau_s: {tau_s}, {accel_tau_s}, expected above 0")
    whole("passes", passes, 1)
    if np.abs(np.swapaxes(C, 1, 2) @ C - np.eye(3)).max() > _TURNED:
        raise ValueError("C_ins: expected rotation matrices")
    nh = Q.shape[1]
    floor, forgetting, from_fix = weighing
    whole("from_fix", from_fix, 0)
    if not (0.0 <= floor < 1.0 / nh and 0.0 < forgetting <= 1.0):
        raise ValueError(f"{weighing}: expected 0 <= floor < 1 / {nh}, 0 < forgetting <= 1")
    bank = bank_of(Gaussian(mean, P0), np.full(nh, 1.0 / nh))
    states, models, first = (n, N_ERRORS), (n, nh), np.full(3, -1)
    x, variance, weight, nis = (np.full(s, np.nan) for s in (states, states, models, models))
    _run(
        *bank, C, z, seen, float(tau_s), Q, R, rule.table(3)[0], math.exp(-tau_s / accel_tau_s),
        float(floor), float(forgetting), int(from_fix), int(passes), x, variance, weight, nis,
        first,
    )  # fmt: skip
    return StarRun(x, variance, weight, nis, bank, Epochs(*(int(k) for k in first)))


def _array(name: str, value: ArrayLike) -> np.ndarray:
    """Contiguous float64, all finite."""
    array = np.ascontiguousarray(value, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers")
    return array


# ---------------------------------------------------------------------------------- kernels


@kernel(fastmath=FAST_SUM)
def _run(
    log_weight: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
    C: np.ndarray,
    z: np.ndarray,
    seen: np.ndarray,
    tau: float,
    Q: np.ndarray,
    R: np.ndarray,
    table: np.ndarray,
    keep: float,
    floor: float,
    forgetting: float,
    from_fix: int,
    passes: int,
    mean_of: np.ndarray,
    variance_of: np.ndarray,
    weight_of: np.ndarray,
    nis_of: np.ndarray,
    first: np.ndarray,
) -> None:
    """All fixes; the bank is left as after the last one."""
    nh, n = mean.shape
    x1, P1, gained = np.empty(n), np.empty((n, n)), np.empty(nh)
    x, P = np.empty(n), np.empty((n, n))
    Phi, q, noise = np.eye(n), np.zeros((n, n)), np.empty((1, 3, 3))
    for i in range(6, n):
        Phi[i, i] = keep
    begun = False
    for k in range(z.shape[0]):
        some = False
        for j in range(nh):
            for i in range(n):
                q[i, i] = Q[k if Q.shape[0] > 1 else 0, j, i]
            phi = misalign(C[k], C[k + 1], tau, mean[j], Phi)
            predict_into(mean[j], cov[j], Phi, q, x1, P1)
            x1[:3] = phi
            gained[j] = np.nan
            if seen[k]:
                nis, gained[j] = _condition(
                    C[k + 1], x1, P1, z[k], R, table, 1 if begun else passes, noise, mean[j],
                    cov[j],
                )  # fmt: skip
                nis_of[k, j] = nis
            if gained[j] == gained[j]:
                some = True
            else:
                mean[j], cov[j] = x1, P1
                if seen[k] and first[0] < 0:
                    first[0] = k
        begun = begun or seen[k]
        if some and k >= from_fix:
            for j in range(nh):
                gained[j] += forgetting * log_weight[j]
            log_weight[:] = normalise(gained, floor)
        weight_of[k] = np.exp(log_weight)
        merge_into(weight_of[k], mean, cov, x, P)
        total = 0.0
        for i in range(n):
            total += abs(x[i]) + abs(P[i, i])
        if not total < np.inf:  # not isfinite, which sums that may be reordered undo
            first[2] = k
            return
        for i in range(n):
            mean_of[k, i], variance_of[k, i] = x[i], P[i, i]
        if first[1] < 0 and not is_semidefinite(P):
            first[1] = k


@kernel(fastmath=FAST_SUM)
def _condition(
    C: np.ndarray,
    x1: np.ndarray,
    P1: np.ndarray,
    z: np.ndarray,
    R: np.ndarray,
    table: np.ndarray,
    passes: int,
    noise: np.ndarray,
    mean: np.ndarray,
    cov: np.ndarray,
) -> tuple[float, float]:
    """Posterior of a prior x1 (9,), P1 (9, 9) in mean, cov; NIS and log likelihood, NaN if none."""
    n, p = x1.size, max(table.shape[1], 1)
    H, G, L, S = np.zeros((3, n)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    Y, Z, room = np.empty((3, p)), np.empty((3, p)), np.empty(p)
    zbar, near, nu = np.empty(3), np.empty((1, 3)), np.empty(3)
    at, spread, nis = x1.copy(), P1, np.nan
    for _ in range(passes):
        if table.shape[1] == 0:
            Y[:, 0] = at[:3]
            predicted(C, Y, Z)
            zbar[:] = Z[:, 0]
            slope(C, at, G)
            noise[:] = 0.0
        else:
            psd_cholesky(spread[:3, :3], L)
            scatter(at[:3], L, table, Y)
            predicted(C, Y, Z)
            regress(L, table, Z, room, zbar, G, noise[0])
        for i in range(3):
            H[i, :3] = G[i]
            near[0, i] = zbar[i] + wrap(z[i] - zbar[i])
        nis = condition_on(x1, P1, at, zbar, H, near, R.reshape((1, 3, 3)), nu, noise, mean, cov)
        if not nis < np.inf:
            return np.nan, np.nan
        at, spread = mean.copy(), cov.copy()
    psd_cholesky(innovation_cov(H, P1, noise), S)
    log_det = 2.0 * np.log(S[0, 0] * S[1, 1] * S[2, 2])
    if not log_det > -np.inf:
        return np.nan, np.nan
    return nis, -0.5 * (nis + log_det + 3.0 * LOG_2PI)
