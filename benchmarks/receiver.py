"""Taps in closed form, and one step of the 17-state filter."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numba import njit

from benchmarks import baselines, peers
from benchmarks.harness import Case
from benchmarks.scene import N_CHANNEL, make, signal_state
from signals.codes import GPS_L1CA
from signals.correlator_model import ModelCorrelator
from signals.taps_from_errors import taps_from_errors
from ultratight.filters.conditioning import condition, predict_into

N_TAPS = 12_000
N_STEP = 2_000
N_STATE = 17


def groups() -> Iterator[tuple[str, list[Case]]]:
    """Constant errors in bulk, a command over a trajectory, predict and update."""
    yield "taps in closed form, three taps, noise included", _closed_form()
    yield f"predict and update, {N_STATE} states", _filter()


def _numpy_taps(delay: np.ndarray, phase: np.ndarray, freq: np.ndarray) -> np.ndarray:
    """The textbook's triangle, sinc and correlated noise in numpy."""
    offsets = np.array([-0.5, 0.0, 0.5])
    size = np.sqrt(2.0 * 10.0**4.5 * 0.001)
    r = np.maximum(0.0, 1.0 - np.abs(delay[:, None] + offsets))
    turned = np.exp(2j * np.pi * phase) * np.sinc(freq * 0.001)
    rng = np.random.default_rng(1)
    draw = rng.standard_normal((delay.size, 3)) + 1j * rng.standard_normal((delay.size, 3))
    cov = 1.0 - np.abs(offsets[:, None] - offsets)
    return size * r * turned[:, None] + draw @ np.linalg.cholesky(cov + 1e-12 * np.eye(3)).T


def _closed_form() -> list[Case]:
    rng = np.random.default_rng(1)
    delay, phase, freq = (rng.uniform(-s, s, N_TAPS) for s in (0.3, 0.5, 300.0))
    chips, offsets = GPS_L1CA.chips(7)[None], np.array([-0.5, 0.0, 0.5])
    out = np.empty((N_TAPS, 3), np.complex128)
    scene = make(4e6, 0.02, 0.04)
    state = signal_state(0.04)
    dumps = scene.nco._replace(dump_chips=np.full(N_CHANNEL, 10_230))
    model = ModelCorrelator(state, scene.chips, np.arange(1, N_CHANNEL + 1), offsets, seed=1)
    return [
        Case(
            "numpy, constant errors", lambda: _numpy_taps(delay, phase, freq), N_TAPS,
            "M channel-epochs/s", 1e-6,
        ),
        Case(
            "constant errors in bulk",
            lambda: taps_from_errors(
                delay, phase, freq, 45.0, 0.001, chips, offsets, seed=1, out=out
            ),
            N_TAPS, "M channel-epochs/s", 1e-6, 40.0, baseline="numpy, constant errors",
        ),
        Case(
            "a command of 40 ms, dumps of 10 ms, 12 channels, trajectory in pieces of 5 ms",
            lambda: model(dumps), N_CHANNEL * 4, "M channel-epochs/s", 1e-6,
            calls=20, baseline="numpy, constant errors",
        ),
    ]  # fmt: skip


@njit(nogil=True)
def _steps(
    n: int, mean: np.ndarray, cov: np.ndarray, phi: np.ndarray, q: np.ndarray, z: np.ndarray,
    H: np.ndarray, noise: np.ndarray,
) -> np.ndarray:  # fmt: skip
    x, P, x1, P1 = mean.copy(), cov.copy(), mean.copy(), cov.copy()
    nu = np.empty_like(z)
    for _ in range(n):
        predict_into(x, P, phi, q, x1, P1)
        for j in range(z.size):
            nu[j] = z[j]
            for a in range(x1.size):
                nu[j] -= H[j, a] * x1[a]
        condition(x1, P1, nu, H, noise, x, P)
    return P


def _filter() -> list[Case]:
    rng = np.random.default_rng(1)
    phi = np.eye(N_STATE)
    for a, b in ((0, 3), (3, 6), (6, 9), (3, 12)):  # r v psi b_a b_g cb cd, blocks of three
        phi[a : a + 3, b : b + 3] = rng.standard_normal((3, 3)) * 0.02
    phi[15, 16] = 0.02
    q = np.diag(rng.uniform(1e-6, 1e-5, N_STATE))
    mean, cov = np.zeros(N_STATE), np.diag(rng.uniform(0.5, 2.0, N_STATE))
    cases = []
    for m, target in ((6, 4.0), (24, 6.0)):
        H, z = rng.standard_normal((m, N_STATE)), rng.standard_normal(m)
        H[:, 9:15] = 0.0
        noise = np.repeat(np.eye(3)[None], m // 3, axis=0)
        flat = np.eye(m)
        x1, P1, x2, P2 = mean.copy(), cov.copy(), mean.copy(), cov.copy()

        def calls(H=H, z=z, noise=noise, x1=x1, P1=P1, x2=x2, P2=P2) -> None:
            predict_into(mean, cov, phi, q, x1, P1)
            condition(x1, P1, z, H, noise, x2, P2)

        cases += [
            Case(
                f"numpy, Joseph, m = {m}",
                lambda H=H, z=z, flat=flat: baselines.joseph(mean, cov, phi, q, z, H, flat),
                1.0, "us", 1e6, cost=True, calls=50,
            ),
            Case(
                f"m = {m}, steps in a compiled loop",
                lambda H=H, z=z, noise=noise: _steps(N_STEP, mean, cov, phi, q, z, H, noise),
                N_STEP, "us", 1e6, target, cost=True, baseline=f"numpy, Joseph, m = {m}",
                peer=peers.FILTER[m],
            ),
            Case(
                f"m = {m}, two calls from Python", calls, 1.0, "us", 1e6, target, cost=True,
                calls=500, baseline=f"numpy, Joseph, m = {m}",
            ),
        ]  # fmt: skip
    return cases
