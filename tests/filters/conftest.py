"""Small problems shared by the filter tests: random states, a linear and a correlator-like h."""

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from ultratight.filters.gaussian import Gaussian, Measurement, Prediction


class LinearH:
    """z_i = B_i y_i."""

    def __init__(self, B):
        self.B = B  # (nb, k, d)

    def h(self, y):
        return np.einsum("bkd,bpd->bpk", self.B, y)

    def h_jacobian(self, y):
        return np.einsum("bkd,bd->bk", self.B, y), self.B


class PhaseH:
    """z = (cos y1, sin y1, y0 cos y1): curved and even in the phase y1, as I, Q, S are."""

    def h(self, y):
        c, s = np.cos(y[..., 1]), np.sin(y[..., 1])
        return np.stack([c, s, y[..., 0] * c], axis=-1)

    def h_jacobian(self, y):
        c, s = np.cos(y[..., 1]), np.sin(y[..., 1])
        J = np.zeros((len(y), 3, y.shape[1]))
        J[:, 0, 1], J[:, 1, 1] = -s, c
        J[:, 2, 0], J[:, 2, 1] = c, -y[..., 0] * s
        return self.h(y), J


def random_cov(rng, n, scale=1.0):
    root = rng.standard_normal((n, n))
    return scale**2 * (root @ root.T / n + 0.05 * np.eye(n))


def problem(kind, seed, nb=4, d=2, n=6, scale=1.0):
    """A Gaussian of n states and nb blocks of three numbers; ``scale`` is about the s.d. of y."""
    rng = np.random.default_rng(seed)
    state = Gaussian(rng.standard_normal(n) * 0.3, random_cov(rng, n))
    A = rng.standard_normal((nb, d, n))
    S = A @ state.cov @ A.transpose(0, 2, 1)
    A *= scale / np.sqrt(np.diagonal(S, axis1=1, axis2=2))[:, :, None]
    R = np.stack([random_cov(rng, 3, 0.3) for _ in range(nb)])
    model = LinearH(rng.standard_normal((nb, 3, d))) if kind == "linear" else PhaseH()
    z = model.h((A @ state.mean)[:, None, :])[:, 0] + 0.5 * rng.standard_normal((nb, 3))
    return state, Measurement(z, A, R, model.h, model.h_jacobian, np.arange(nb))


def stacked_noise(R):
    """(nb, k, k) -> block-diagonal (m, m)."""
    nb, k, _ = R.shape
    out = np.zeros((nb * k, nb * k))
    for b in range(nb):
        out[b * k : b * k + k, b * k : b * k + k] = R[b]
    return out


def exact_posterior(P, H, R):
    """P - P H' (H P H' + diag R)^-1 H P, row after row, in rational numbers."""
    P = [[Fraction(float(x)) for x in row] for row in P]
    n = len(P)
    for row, r in zip(H, R, strict=True):
        h = [Fraction(float(x)) for x in row]
        Ph = [sum(P[i][j] * h[j] for j in range(n)) for i in range(n)]
        s = sum(h[i] * Ph[i] for i in range(n)) + Fraction(float(r))
        P = [[P[i][j] - Ph[i] * Ph[j] / s for j in range(n)] for i in range(n)]
    return np.array([[float(x) for x in row] for row in P])


def layout(n):
    """The slices of the 17 states and n - 17 phases."""
    names = ("r", "v", "psi", "accel_bias", "gyro_bias")
    blocks = {name: slice(3 * i, 3 * i + 3) for i, name in enumerate(names)}
    return SimpleNamespace(**blocks, cb=slice(15, 16), cd=slice(16, 17), phase=slice(17, n))


def prediction(n, n_channel, phi=None, q=None, layout_=None, **changes):
    """A quiet 20 ms epoch."""
    base = Prediction(
        np.eye(n) if phi is None else phi,
        1e-4 * np.eye(n) if q is None else q,
        0.0, 0, 0.02, np.array([0.0, 0.0, -9.8]), np.zeros(3), np.eye(3),
        layout(n) if layout_ is None else layout_, n_channel,
    )  # fmt: skip
    return base._replace(**changes)


@pytest.fixture(name="make", scope="session")
def _make():
    return SimpleNamespace(
        problem=problem, LinearH=LinearH, PhaseH=PhaseH, random_cov=random_cov, layout=layout,
        stacked_noise=stacked_noise, prediction=prediction, exact_posterior=exact_posterior,
    )  # fmt: skip
