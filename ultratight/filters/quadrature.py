"""Points and weights for N(0, I_d): Gauss-Hermite tensors, cubature, unscented."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import prod
from typing import NamedTuple

import numpy as np


class UnitPoints(NamedTuple):
    """A quadrature rule for N(0, I_d), cached."""

    xi: np.ndarray  # (d, p) points
    w: np.ndarray  # (p,) weights, sum 1, possibly negative
    table: np.ndarray  # (d + 1, p) w and xi in one block, for kernels, which take no read-only one
    inner: int  # length of the last axis where the rule is a product with it, else 1


PointFunction = Callable[[int], tuple[np.ndarray, np.ndarray]]
"""Dimension d -> points (p, d) and weights (p,) with the mean 0 and covariance I_d"""


def hermite_nodes(m: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights (m,) for N(0, 1): sqrt(2) eig(J), J(i, i+1) = sqrt(i/2) (Golub-Welsch)."""
    beta = np.sqrt(np.arange(1, m) / 2.0)
    node, vector = np.linalg.eigh(np.diag(beta, 1) + np.diag(beta, -1))
    x, w = np.sqrt(2.0) * node, vector[0] ** 2
    x, w = 0.5 * (x - x[::-1]), 0.5 * (w + w[::-1])  # symmetric to the last bit
    return x, w / w.sum()


def gauss_rule(x: np.ndarray, w: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss rule of m points for the measure that has weights w at the points x (Stieltjes)."""
    alpha, beta = np.zeros(m), np.zeros(m)
    before, now = np.zeros_like(x), np.ones_like(x) / np.sqrt(w.sum())
    for i in range(m):
        alpha[i] = w @ (x * now**2)
        after = (x - alpha[i]) * now - (beta[i - 1] * before if i else 0.0)
        beta[i] = np.sqrt(w @ after**2)
        before, now = now, after / beta[i]
    node, vector = np.linalg.eigh(np.diag(alpha) + np.diag(beta[:-1], 1) + np.diag(beta[:-1], -1))
    return node, vector[0] ** 2 * w.sum()


def gauss_hermite(orders: int | tuple[int, ...], d: int) -> tuple[np.ndarray, np.ndarray]:
    """Tensor Gauss-Hermite rule in d dimensions; ``orders`` per dimension or one for all.

    With different orders note that y = ybar + L xi with L lower triangular: dimension j of y is
    carried by the points of dimensions 0..j.
    """
    per_axis = (orders,) * d if isinstance(orders, int) else orders
    if len(per_axis) != d:
        raise ValueError(f"rule has orders {per_axis} but the projected space has {d} dimensions")
    if prod(per_axis) > 100_000:
        raise ValueError(f"Gauss-Hermite points: {prod(per_axis)}, expected at most 100000")
    axes = [hermite_nodes(m) for m in per_axis]
    points = np.stack(np.meshgrid(*(x for x, _ in axes), indexing="ij"), -1).reshape(-1, d)
    weights = np.ones(1)
    for _, w in axes:
        weights = np.multiply.outer(weights, w).ravel()
    return points, weights


def cubature(d: int) -> tuple[np.ndarray, np.ndarray]:
    """Third-degree spherical-radial rule, 2 d points (Arasaratnam & Haykin, IEEE TAC 54, 2009)."""
    eye = np.sqrt(d) * np.eye(d)
    return np.vstack([eye, -eye]), np.full(2 * d, 0.5 / d)


def unscented(d: int, kappa: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """2 d + 1 points, kappa = 3 - d unless given (Julier & Uhlmann, 1997).

    For d > 3 the central weight kappa/(d + kappa) is negative and Omega may be indefinite.
    """
    kappa = 3.0 - d if kappa is None else kappa
    spread = d + kappa
    if spread <= 0.0:
        raise ValueError(f"unscented rule: kappa = {kappa}, expected more than -{d}")
    eye = np.sqrt(spread) * np.eye(d)
    weights = np.r_[kappa / spread, np.full(2 * d, 0.5 / spread)]
    return np.vstack([np.zeros((1, d)), eye, -eye]), weights


@cache
def unit_points(function: PointFunction, d: int) -> UnitPoints:
    """Points of a rule in d dimensions, computed once; ValueError where they are no such rule."""
    points, weights = function(d)
    w = np.array(weights, dtype=float)
    xi = np.array(np.asarray(points, dtype=float).T, order="C")
    if xi.shape != (d, w.size):
        raise ValueError(f"unit points: shape {xi.T.shape}, expected ({w.size}, {d})")
    moments = (w.sum() - 1.0, xi @ w, (xi * w) @ xi.T - np.eye(d))
    if max(float(np.abs(v).max(initial=0.0)) for v in map(np.asarray, moments)) > 1e-9:
        raise ValueError(f"unit points: moments {moments}, expected those of N(0, I)")
    table = np.vstack([w, xi])
    xi.setflags(write=False)
    w.setflags(write=False)
    return UnitPoints(xi, w, table, _inner(xi, w))


def _inner(xi: np.ndarray, w: np.ndarray) -> int:
    """Largest m such that the points are those of d - 1 dimensions, each with the same m last."""
    same = np.all(xi[:-1] == xi[:-1, :1], axis=0)
    m = w.size if same.all() else int(np.argmin(same))
    if w.size % m or np.any(w == 0.0):
        return 1
    x, v = xi.reshape(len(xi), -1, m), w.reshape(-1, m)
    product = np.all(x[:-1] == x[:-1, :, :1]) and np.all(x[-1] == x[-1, :1])
    shares = v / v.sum(axis=1, keepdims=True)
    return m if product and np.allclose(shares, shares[0], rtol=1e-12, atol=0.0) else 1
