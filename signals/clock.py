"""The receiver's oscillator: bias and rate from its h-parameters, with g-sensitivity.

Sign as everywhere: clock_m = c b, b > 0 when the receiver's clock is ahead of GPS time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from signals.constants import C_MPS, STANDARD_GRAVITY


@dataclass(frozen=True)
class Oscillator:
    """Power spectrum S_y(f) = h0 + h_minus1 / f + h_minus2 / f^2 of the fractional frequency.

    Units are s, 1 and 1/s; all zero is a clock without noise.
    """

    name: str
    h0: float = 0.0
    h_minus1: float = 0.0
    h_minus2: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        for field in ("h0", "h_minus1", "h_minus2"):
            value = getattr(self, field)
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{field} = {value} of {self.name}: expected a number >= 0")

    @property
    def bias_psd(self) -> float:
        """White frequency noise: spectral density that drives the bias, c^2 h0 / 2 [m^2/s]."""
        return C_MPS**2 * self.h0 / 2.0

    @property
    def drift_psd(self) -> float:
        """Random-walk frequency: density that drives the drift, 2 pi^2 c^2 h_minus2 [m^2/s^3]."""
        return 2.0 * np.pi**2 * C_MPS**2 * self.h_minus2


_WINKEL = "J. O. Winkel, Modeling and simulating GNSS signal structures and receivers, 2003, t. 2.1"
_TWO_STATE = "two-state model, S_f = c^2 h0 / 2, S_g = 2 pi^2 c^2 h-2"

OSCILLATORS: dict[str, Oscillator] = {
    oscillator.name: oscillator
    for oscillator in (
        Oscillator("ideal"),
        Oscillator("tcxo", 1e-21, 0.0, 2e-20, _TWO_STATE),
        Oscillator("ocxo", 8e-22, 0.0, 2.5e-22, _TWO_STATE),
        Oscillator("winkel_quartz", 2e-19, 7e-21, 2e-20, _WINKEL),
        Oscillator("winkel_tcxo", 1e-21, 1e-20, 2e-20, _WINKEL),
        Oscillator("winkel_ocxo_1", 8e-20, 2e-21, 4e-23, _WINKEL),
        Oscillator("winkel_ocxo_2", 2.51e-26, 2.51e-23, 2.51e-22, _WINKEL),
        Oscillator("winkel_rubidium_1", 2e-20, 7e-24, 4e-29, _WINKEL),
        Oscillator("winkel_rubidium_2", 1e-23, 1e-22, 1.3e-26, _WINKEL),
        Oscillator("winkel_cesium_1", 1e-19, 1e-25, 2e-32, _WINKEL),
        Oscillator("winkel_cesium_2", 2e-20, 7e-23, 4e-29, _WINKEL),
    )
}


class ClockHistory(NamedTuple):
    """The clock at the nodes (n_node,)."""

    clock_m: np.ndarray  # c b [m]
    clock_rate_mps: np.ndarray  # slope for the cubics between the nodes [m/s]
    drift_mps: np.ndarray  # the drift *state*: random walk and g-sensitive part [m/s]


def simulate(
    oscillator: Oscillator,
    t_s: np.ndarray,
    rng: np.random.Generator,
    bias_m: float = 0.0,
    drift_mps: float = 0.0,
    g_sensitivity_ppb_per_g: float = 0.0,
    specific_force_x: np.ndarray | None = None,
) -> ClockHistory:
    """Draw the clock's bias and rate at uniform nodes.

        b' = d + c gamma f_x / g + white(S_f) [+ flicker],      d' = white(S_g)

    The two states are drawn exactly for the node spacing; flicker frequency noise (h_minus1) by
    fractional differences (Kasdin & Walter 1992), without a past before the first node.  White
    frequency noise has no derivative: the bias is a random walk from node to node and the slope
    given at a node is the central difference of its neighbours' biases, so that Hermite cubics
    pass through the drawn biases.  A clock without noise and force has exactly the slope
    ``drift_mps``.

    Parameters
    ----------
    oscillator
        E.g. ``OSCILLATORS["tcxo"]``.
    t_s : (n_node,)
        Uniform nodes [s].
    rng
        Generator of the clock's own stream (`noise.generator`).
    bias_m, drift_mps
        At the first node.
    g_sensitivity_ppb_per_g
        Fractional frequency per specific force along body x.
    specific_force_x : (n_node - 1,) or (n_node,), optional
        Mean over each interval, hence a step where it steps; or values at the nodes, linear
        between them [m/s^2].  Without it there is no g-sensitive part.

    Raises
    ------
    ValueError
        Nodes that are not uniform, a force of another shape, or a number that is not finite.
    """
    t_s = np.asarray(t_s, dtype=np.float64)
    h = _spacing(t_s)
    for name, value in (
        ("bias_m", bias_m),
        ("drift_mps", drift_mps),
        ("g_sensitivity_ppb_per_g", g_sensitivity_ppb_per_g),
    ):
        if not np.isfinite(value):
            raise ValueError(f"{name} = {value}: expected a finite number")
    n = len(t_s) - 1
    pull, pull_at_nodes = _pulling(g_sensitivity_ppb_per_g, specific_force_x, n)
    s_f, s_g = oscillator.bias_psd, oscillator.drift_psd
    normals = rng.standard_normal((n, 3)).T  # so that a longer run begins like a shorter one
    walk = np.sqrt(s_g * h) * normals[0]
    drift = drift_mps + np.concatenate(([0.0], np.cumsum(walk)))
    # given the drift at both ends, the bias over the interval is Gaussian around the trapezoid
    rest = np.sqrt(s_f * h + s_g * h**3 / 12.0) * normals[1]
    flicker = C_MPS * h * _flicker(oscillator.h_minus1, normals[2])
    steps = h * (drift[:-1] + 0.5 * walk + pull) + rest + flicker
    bias = bias_m + np.concatenate(([0.0], np.cumsum(steps)))
    if np.any(steps != steps[0]):
        # differences of the steps, not of the biases: no rounding at 1e5 m
        slope = np.concatenate(([steps[0]], 0.5 * (steps[1:] + steps[:-1]), [steps[-1]])) / h
    else:
        bias = bias_m + (drift_mps + pull[0]) * (t_s - t_s[0])
        slope = np.full(n + 1, drift_mps + pull[0])
    return ClockHistory(bias, slope, drift + pull_at_nodes)


def _spacing(t_s: np.ndarray) -> float:
    if t_s.ndim != 1 or len(t_s) < 2:
        raise ValueError(f"t_s has shape {t_s.shape}, expected (n_node,) with at least 2 nodes")
    h = float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    if not (h > 0.0 and np.abs(np.diff(t_s) - h).max() <= 1e-9):
        raise ValueError("t_s is not uniform and increasing: its steps differ by more than 1 ns")
    return h


def _pulling(gamma_ppb: float, force: np.ndarray | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """G-sensitive rate [m/s]: mean over each interval (n,) and value from each node on (n + 1,)."""
    if force is None:
        return np.zeros(n), np.zeros(n + 1)
    force = np.asarray(force, dtype=np.float64)
    if force.shape not in ((n,), (n + 1,)):
        raise ValueError(f"specific_force_x has shape {force.shape}, expected ({n},) or ({n + 1},)")
    if not np.isfinite(force).all():
        raise ValueError("specific_force_x contains a number that is not finite")
    rate = C_MPS * 1e-9 * gamma_ppb / STANDARD_GRAVITY * force
    if len(rate) == n:
        return rate, np.append(rate, rate[-1])
    return 0.5 * (rate[1:] + rate[:-1]), rate


def _flicker(h_minus1: float, white: np.ndarray) -> np.ndarray:
    """Fractional frequency with S_y = h_minus1 / f per interval (Kasdin & Walter 1992, alpha 1)."""
    if h_minus1 == 0.0:
        return np.zeros(len(white))
    from scipy.signal import fftconvolve  # slow to import, and seldom needed

    # impulse response of (1 - z^-1)^(-1/2): h_k = h_(k-1) (k - 1/2) / k; with variance q the
    # spectrum is q / (2 pi f) two-sided, q / (pi f) one-sided
    k = np.arange(1, len(white))
    response = np.concatenate(([1.0], np.cumprod((k - 0.5) / k)))
    return fftconvolve(np.sqrt(np.pi * h_minus1) * white, response)[: len(white)]
