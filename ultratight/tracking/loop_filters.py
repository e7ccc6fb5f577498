"""Loop filters of first to third order, with the noise bandwidth that was asked for.

The filters are those of Kaplan & Hegarty (2nd ed., table 5.6; 3rd ed., ch. 8).  With natural
frequency w in rad/s they turn an error into a rate by

    order 1   F = w                                  Bn = 0.25 w
    order 2   F = 1.414 w + w^2 / s                  Bn = 0.53 w
    order 3   F = 2.4 w + 1.1 w^2 / s + w^3 / s^2    Bn = 0.7845 w

in digital form with bilinear integrators.  An update takes the mean error of an integration and
commands the rate of the next one.  With the w above such a loop is wider than Bn, by 25-30 % at
Bn T = 0.1, and at last unstable.  Here w is solved for instead: the *digital* loop, its delay
included, has the noise bandwidth Bn; for Bn T -> 0 that is the w above (Stephens & Thomas,
"Controlled-root formulation for digital phase-locked loops", IEEE TAES 31 (1995), on why).

The thermal jitter is then the textbook's, but w is less, by 16 % at Bn T = 0.1, and the delay is
there: dynamics and the oscillator disturb the loop more than the continuous formula with
w = Bn / 0.7845 says.  For the PLL of order 3 with the TCXO (delay 0.5 ms) the r.m.s. phase error
due to the oscillator is that formula's times

    Bn, T    18 Hz, 2 ms    10 Hz, 5 ms    18 Hz, 5 ms    10 Hz, 10 ms    5 Hz, 20 ms
    factor   1.13           1.18           1.29           1.34            1.35

and no other w helps: with that of the table the thermal jitter is 11 % too large at Bn T = 0.1.
The integral of |1 - H|^2 over the oscillator's spectrum, with H of the digital loop, agrees with
measured phase errors: measured / theory, thermal included, is 1.03, 1.00 (18 Hz, 5 ms) and 1.01,
0.99 (10 Hz, 10 ms) at 35, 45 dB-Hz (`tests/tracking/test_scalar.py`).

The error may be one of phase [cycles], frequency [Hz] or delay [chips]: a filter does not mind.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from signals.compiled import kernel

BANDWIDTH_PER_W = {1: 0.25, 2: 0.53, 3: 0.7845}
"""Bn / w in continuous time, by order"""
BANDWIDTH_T_LIMIT = 0.4
"""Largest Bn T: order 3 has a gain margin of 6 to 8 dB there (with w as above: 3 dB to none)"""
_SHAPE = {1: (1.0, 0.0, 0.0), 2: (1.414, 1.0, 0.0), 3: (2.4, 1.1, 1.0)}
_StateSpace = tuple[np.ndarray, np.ndarray, np.ndarray]


def phase_loop(
    order: int, bandwidth_hz: float, interval_s: float, delay_s: float = 0.0
) -> tuple[float, np.ndarray]:
    """Natural frequency w [rad/s] and gains (3,) for `filter_step` of a PLL or DLL.

    Parameters
    ----------
    order : 1, 2 or 3
    bandwidth_hz
        One-sided noise bandwidth Bn.
    interval_s
        T, from update to update.
    delay_s
        From the end of an integration until its command acts; less than T.

    Raises
    ------
    ValueError
        Unknown order, a bandwidth that is not positive, a delay outside [0, T).
    """
    if order not in _SHAPE:
        raise ValueError(f"order is {order}: expected 1, 2 or 3")

    def gains(w: float, t: float) -> np.ndarray:
        a, b, c = _SHAPE[order]
        return np.array([a * w, t * b * w**2, t * c * w**3])

    def loop(wt: float) -> _StateSpace:
        return _phase_state_space(order, gains(1.0, wt), wt, delay_s / interval_s)

    w = _natural_frequency(order, bandwidth_hz, interval_s, delay_s, loop)
    return w, gains(w, interval_s)


def frequency_loop(
    order: int, bandwidth_hz: float, interval_s: float, delay_s: float = 0.0
) -> tuple[float, np.ndarray]:
    """The same for an FLL of order 1 or 2, whose last integrator is the filter's own.

    An FLL of order n - 1 assists a PLL of order n: both push the same integrators.
    """
    if order not in (1, 2):
        raise ValueError(f"order is {order}: expected 1 or 2 for a frequency loop")

    def gains(w: float, t: float) -> np.ndarray:
        a, b, _ = _SHAPE[order]
        return np.array([0.0, t * a * w, t * b * w**2])

    def loop(wt: float) -> _StateSpace:
        return _frequency_state_space(order, gains(1.0, wt), wt, delay_s / interval_s)

    w = _natural_frequency(order, bandwidth_hz, interval_s, delay_s, loop)
    return w, gains(w, interval_s)


def _natural_frequency(
    order: int,
    bandwidth_hz: float,
    interval_s: float,
    delay_s: float,
    loop: Callable[[float], _StateSpace],
) -> float:
    """The w at which the loop's noise bandwidth is Bn, by bisection: it grows with w.

    ``loop`` is given w T; its unit of time is 1 / w, as its states are then of a size.
    """
    if not 0.0 < bandwidth_hz < np.inf:
        raise ValueError(f"bandwidth_hz is {bandwidth_hz}: expected a finite number > 0")
    if bandwidth_hz * interval_s > BANDWIDTH_T_LIMIT + 1e-9:
        raise ValueError(
            f"bandwidth_hz is {bandwidth_hz}: expected at most {BANDWIDTH_T_LIMIT / interval_s:g}, "
            f"{BANDWIDTH_T_LIMIT} / {interval_s} s, for stability"
        )
    if not 0.0 <= delay_s < interval_s:
        raise ValueError(f"delay_s is {delay_s}: expected >= 0 and less than {interval_s}")
    low, high = 0.0, 1.2 * bandwidth_hz * interval_s / BANDWIDTH_PER_W[order]
    for _ in range(50):
        middle = 0.5 * (low + high)
        if noise_bandwidth(*loop(middle)) > bandwidth_hz * interval_s:
            high = middle
        else:
            low = middle
    return low / interval_s


def noise_bandwidth(transition: np.ndarray, drive: np.ndarray, output: np.ndarray) -> float:
    """Bn T of x' = A x + b n, y = c x: half the variance of y for white n of variance 1.

    A (m, m), b (m,), c (m,).  Infinite where the loop is not stable.
    """
    if np.abs(np.linalg.eigvals(transition)).max() >= 1.0 - 1e-9:
        return np.inf
    from scipy.linalg import solve_discrete_lyapunov  # slow to import, and seldom needed

    covariance = solve_discrete_lyapunov(transition, np.outer(drive, drive))
    return 0.5 * float(output @ covariance @ output)


def _phase_state_space(order: int, gains: np.ndarray, interval: float, late: float) -> _StateSpace:
    """Loop around an integrating NCO; x = (NCO phase, rate before, rate now, filter's memory).

    In every interval the old rate still runs for its share ``late``; y is the mean NCO phase.
    """

    def advance(x: np.ndarray, n: float) -> tuple[np.ndarray, float]:
        phase, before, now = x[:3]
        y = phase + interval * (before * late * (1.0 - 0.5 * late) + now * 0.5 * (1.0 - late) ** 2)
        phase += interval * (late * before + (1.0 - late) * now)
        memory = np.zeros(2)
        memory[3 - order :] = x[3:]
        rate = filter_step(memory, n - y, interval, gains)
        return np.array([phase, now, rate, *memory[3 - order :]]), y

    return _linear(advance, 3 + order - 1)


def _frequency_state_space(
    order: int, gains: np.ndarray, interval: float, late: float
) -> _StateSpace:
    """Loop around the filter alone; x = (frequency before, now, filter's memory), y their mean."""

    def advance(x: np.ndarray, n: float) -> tuple[np.ndarray, float]:
        before, now = x[:2]
        y = late * before + (1.0 - late) * now
        memory = np.zeros(2)
        memory[2 - order :] = x[2:]
        rate = filter_step(memory, n - y, interval, gains)
        return np.array([now, rate, *memory[2 - order :]]), y

    return _linear(advance, 2 + order)


def _linear(
    advance: Callable[[np.ndarray, float], tuple[np.ndarray, float]], n_state: int
) -> _StateSpace:
    """A, b, c of a linear system from its answers to unit states and to unit noise."""
    columns, output = zip(*(advance(row, 0.0) for row in np.eye(n_state)), strict=True)
    drive, _ = advance(np.zeros(n_state), 1.0)
    return np.stack(columns, axis=1), drive, np.array(output)


@kernel
def filter_step(memory: np.ndarray, error: float, interval_s: float, gains: np.ndarray) -> float:
    """Commanded rate; memory (2,): rate of the rate, rate.  Gains as `phase_loop` gives them."""
    slope, rate = memory[0], memory[1]
    memory[0] = slope + gains[2] * error
    memory[1] = rate + 0.5 * interval_s * (slope + memory[0]) + gains[1] * error
    return 0.5 * (rate + memory[1]) + gains[0] * error
