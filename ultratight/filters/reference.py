"""The update in plain numpy, from the defining sums: what the compiled path is held to."""

from __future__ import annotations

import numpy as np

from ultratight.filters.gaussian import LOG_2PI, Gaussian, Measurement, Update
from ultratight.filters.rules import Linearisation, Rule


def update_reference(
    gaussian: Gaussian, measurement: Measurement, rule: Rule, iterations: int = 1
) -> Update:
    """`update` in plain numpy with the covariance in Joseph form; needs P positive definite."""
    m0, P0 = gaussian
    z, R = measurement.z.ravel(), measurement.R
    noise_R = np.zeros((z.size, z.size))
    k = R.shape[1]
    for b in range(len(R)):
        noise_R[b * k : b * k + k, b * k : b * k + k] = R[b]
    mean, cov = m0, P0
    for _ in range(iterations):
        zbar, H, Omega = _linearise_reference(Gaussian(mean, cov), measurement, rule)
        nu = z - zbar - H @ (m0 - mean)
        S = H @ P0 @ H.T + Omega[0] + noise_R
        K = np.linalg.solve(S, H @ P0).T
        mean = m0 + K @ nu
        I_KH = np.eye(m0.size) - K @ H
        cov = I_KH @ P0 @ I_KH.T + K @ (Omega[0] + noise_R) @ K.T
    nis = float(nu @ np.linalg.solve(S, nu))
    log_likelihood = -0.5 * (nis + np.linalg.slogdet(S)[1] + z.size * LOG_2PI)
    return Update(mean, cov, nu, S, K, log_likelihood, nis, H, 1.0, iterations)


def predict_root_reference(root: np.ndarray, phi: np.ndarray, q_root: np.ndarray) -> np.ndarray:
    """Lower root (n, n) of Phi L L' Phi' + Q by the library's QR; signs of columns are free."""
    return np.transpose(np.linalg.qr(np.vstack([(phi @ root).T, q_root.T]))[1])


def condition_root_reference(
    mean: np.ndarray, root: np.ndarray, nu: np.ndarray, H: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Posterior mean and root by one array of all m rows, and the NIS; noise (m, m).

    QR of [[N^(1/2), H L], [0, L]]' gives [[S^(1/2), 0], [K S^(1/2), L+]].
    """
    m, n = H.shape
    array = np.block([[np.linalg.cholesky(noise), H @ root], [np.zeros((n, m)), root]])
    R = np.transpose(np.linalg.qr(array.T)[1])
    e = np.linalg.solve(R[:m, :m], nu)
    return mean + R[m:, :m] @ e, R[m:, m:], float(e @ e)


def _linearise_reference(density: Gaussian, measurement: Measurement, rule: Rule) -> Linearisation:
    """`Rule.linearise` from the defining sums."""
    (mean, cov), A = density, measurement.A
    nb, d, n = A.shape
    if rule.points is None:
        zbar, J = measurement.h_jacobian(A @ mean)
        H = np.einsum("bqj,bjn->bqn", J, A).reshape(-1, n)
        return Linearisation(zbar.ravel(), H, np.zeros((1, len(H), len(H))))
    full = rule.space == "full"
    points, w = rule.points(n if full else d)
    if full:
        dx = points @ np.linalg.cholesky(cov).T
        Z = measurement.h(np.einsum("bjn,pn->bpj", A, mean + dx))
        Z = Z.transpose(1, 0, 2).reshape(len(w), -1)
        dz = Z - w @ Z
        H = np.linalg.solve(cov, (dx.T * w) @ dz).T
        return Linearisation(w @ Z, H, ((dz.T * w) @ dz - H @ cov @ H.T)[None])
    S = A @ cov @ A.transpose(0, 2, 1)
    dy = np.einsum("bij,pj->bpi", np.linalg.cholesky(S), points)
    Z = measurement.h(np.ascontiguousarray((A @ mean)[:, None, :] + dy))
    zbar = np.einsum("p,bpk->bk", w, Z)
    dz = Z - zbar[:, None, :]
    C = np.einsum("p,bpi,bpk->bik", w, dy, dz)
    G = np.linalg.solve(S, C).transpose(0, 2, 1)
    k = Z.shape[2]
    Omega = np.zeros((1, nb * k, nb * k))
    for b in range(nb):
        block = slice(b * k, b * k + k)
        Omega[0, block, block] = (dz[b].T * w) @ dz[b] - G[b] @ S[b] @ G[b].T
    return Linearisation(zbar.ravel(), (G @ A).reshape(-1, n), Omega)
