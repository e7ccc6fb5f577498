"""The digital loops against their theory, each loop run as a plain recursion of its own."""

import numpy as np
import pytest

from ultratight.tracking.loop_filters import (
    BANDWIDTH_PER_W,
    BANDWIDTH_T_LIMIT,
    filter_step,
    frequency_loop,
    phase_loop,
)

pytestmark = pytest.mark.nojit
PHASE_LOOPS = [
    (order, bn, t) for order in (1, 2, 3) for bn, t in ((5.0, 0.02), (18.0, 0.005), (1.0, 0.02))
]


def run_phase_loop(gains, interval_s, phase_in, noise, delay_s=0.0, ticks=20):
    """Mean NCO phase and mean phase error per integration; the NCO is integrated in small ticks.

    phase_in (n, ticks) is the incoming phase at the middle of each tick.
    """
    memory, rate, before, nco = np.zeros(2), 0.0, 0.0, 0.0
    tick = interval_s / ticks
    means, errors = [], []
    for k in range(len(noise)):
        phase = np.empty(ticks)
        for j in range(ticks):
            f = before if (j + 0.5) * tick < delay_s else rate
            phase[j] = nco + 0.5 * f * tick
            nco += f * tick
        means.append(phase.mean())
        errors.append((phase_in[k] - phase).mean())
        before = rate
        rate = filter_step(memory, errors[-1] + noise[k], interval_s, gains)
    return np.array(means), np.array(errors)


@pytest.mark.parametrize(("order", "bandwidth_hz", "interval_s"), PHASE_LOOPS)
@pytest.mark.parametrize("share", [0.0, 0.1])
def test_noise_bandwidth_is_that_of_the_impulse_response(order, bandwidth_hz, interval_s, share):
    # one-sided noise bandwidth of a digital loop: sum of h^2 / (2 T), with h the response of the
    # NCO's mean phase to one noisy measurement; sum of h = H(1) = 1
    _, gains = phase_loop(order, bandwidth_hz, interval_s, share * interval_s)
    n = round(40.0 / (bandwidth_hz * interval_s))  # the slow pair of order 3 rings for long
    noise = np.zeros(n)
    noise[0] = 1.0
    h, _ = run_phase_loop(gains, interval_s, np.zeros((n, 20)), noise, share * interval_s)
    assert h.sum() == pytest.approx(1.0, abs=1e-3)
    assert (h**2).sum() / (2.0 * interval_s) == pytest.approx(bandwidth_hz, rel=0.01)


@pytest.mark.parametrize(("order", "bandwidth_hz", "interval_s"), PHASE_LOOPS)
def test_noise_bandwidth_is_the_integral_over_the_unit_circle(order, bandwidth_hz, interval_s):
    # the same loop written out by hand in z: y = T (1 + 1/z) / (2 (1 - 1/z)) (1/z) F(z) e
    w, _ = phase_loop(order, bandwidth_hz, interval_s)
    back = np.exp(-2j * np.pi * (np.arange(200_000) + 0.5) / 200_000)
    integral = interval_s * 0.5 * (1.0 + back) / (1.0 - back)
    shape = {1: (1.0, 0.0, 0.0), 2: (1.414, 1.0, 0.0), 3: (2.4, 1.1, 1.0)}[order]
    one, two, three = (k * w**p for k, p in zip(shape, (1, 2, 3), strict=True))
    # as Kaplan & Hegarty draw it: accumulators whose input is T e, read in the middle of the step
    middle = integral
    filter_ = one + middle * two + middle * middle * three
    open_loop = integral * back * filter_
    closed = open_loop / (1.0 + open_loop)
    assert np.mean(np.abs(closed) ** 2) / (2.0 * interval_s) == pytest.approx(
        bandwidth_hz, rel=1e-3
    )


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("bandwidth_hz", "interval_s"), [(5.0, 0.02), (2.0, 0.02), (1.0, 0.005)])
def test_noise_bandwidth_of_frequency_loops(order, bandwidth_hz, interval_s):
    _, gains = frequency_loop(order, bandwidth_hz, interval_s)
    memory, f, h = np.zeros(2), 0.0, []
    for k in range(round(20.0 / (bandwidth_hz * interval_s))):
        h.append(f)
        f = filter_step(memory, (1.0 if k == 0 else 0.0) - f, interval_s, gains)
    assert sum(h) == pytest.approx(1.0, abs=1e-3)
    assert np.square(h).sum() / (2.0 * interval_s) == pytest.approx(bandwidth_hz, rel=0.01)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_natural_frequency_tends_to_the_table(order):
    # Kaplan & Hegarty, 2nd ed., table 5.6; the digital loop differs by about 2 Bn T
    w, _ = phase_loop(order, 1.0, 0.001)
    assert w * BANDWIDTH_PER_W[order] == pytest.approx(1.0, rel=0.005)
    wide, _ = phase_loop(order, 100.0, 0.001)
    assert 0.75 < wide / 100.0 * BANDWIDTH_PER_W[order] < 0.9


@pytest.mark.parametrize(("order", "motion"), [(1, "rate"), (2, "acceleration"), (3, "jerk")])
def test_steady_state_error(order, motion):
    # v / w, a / w^2, j / w^3 (Kaplan & Hegarty, 2nd ed., section 5.6.4)
    interval_s, ticks = 0.01, 20
    w, gains = phase_loop(order, 5.0, interval_s)
    t = (np.arange(800 * ticks).reshape(800, ticks) + 0.5) * interval_s / ticks
    power = {"rate": t, "acceleration": t**2 / 2.0, "jerk": t**3 / 6.0}[motion]
    _, error = run_phase_loop(gains, interval_s, power, np.zeros(800), ticks=ticks)
    assert error[-1] == pytest.approx(1.0 / w**order, rel=1e-3)


@pytest.mark.parametrize(("order", "peak"), [(2, 1.0433), (3, 0.4850)])
def test_peak_error_after_a_step_of_acceleration(order, peak):
    # largest value of the step response of 1 / (s^2 + 1.414 s + 1) and of the impulse response of
    # 1 / (s^3 + 2.4 s^2 + 1.1 s + 1), by scipy.signal on a grid of 5 ms
    interval_s, ticks = 0.001, 4
    w, gains = phase_loop(order, 5.0, interval_s)
    t = (np.arange(3000 * ticks).reshape(3000, ticks) + 0.5) * interval_s / ticks
    _, error = run_phase_loop(gains, interval_s, t**2 / 2.0, np.zeros(3000), ticks=ticks)
    assert error.max() * w**2 == pytest.approx(peak, rel=0.03)


@pytest.mark.parametrize("bandwidth_t", [0.2, 0.36])
def test_wide_loops_stay_stable(bandwidth_t):
    _, gains = phase_loop(3, bandwidth_t / 0.02, 0.02)
    noise = np.zeros(300)
    noise[0] = 1.0
    h, _ = run_phase_loop(gains, 0.02, np.zeros((300, 20)), noise)
    assert np.abs(h[-50:]).max() < 1e-3
    assert (h**2).sum() / 2.0 == pytest.approx(bandwidth_t, rel=0.01)


def rings_on(gains, interval_s, delay_s):
    """The loop's answer to one noisy measurement does not die out."""
    noise = np.zeros(400)
    noise[0] = 1.0
    h, _ = run_phase_loop(gains, interval_s, np.zeros((400, 20)), noise, delay_s)
    return not np.abs(h[-50:]).max() < 1e-2


@pytest.mark.parametrize(("share", "table_ends"), [(0.5, 0.36), (0.025, 0.56)])
def test_margin_at_the_widest_bandwidth(share, table_ends):
    # gains may grow by 6.0 or 8.2 dB at the limit; with w of the table the loop is unstable from
    # Bn T = 0.335 (delay T / 2) or 0.537 on: eigenvalues of its state matrix
    _, gains = phase_loop(3, BANDWIDTH_T_LIMIT, 1.0, share)
    assert not rings_on(1.8 * gains, 1.0, share)
    assert rings_on(2.7 * gains, 1.0, share)
    for bn, rings in ((table_ends, True), (table_ends - 0.05, False)):
        w = bn / BANDWIDTH_PER_W[3]
        assert rings_on(np.array([2.4 * w, 1.1 * w**2, w**3]), 1.0, share) is rings


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3, 21.0, 0.02), "expected at most 20"),
        ((4, 5.0, 0.02), "order is 4"),
        ((3, 0.0, 0.02), "bandwidth_hz is 0.0"),
        ((3, np.nan, 0.02), "bandwidth_hz is nan"),
        ((3, 5.0, 0.02, 0.02), "delay_s is 0.02"),
    ],
)
def test_bad_loops_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        phase_loop(*arguments)


def test_a_frequency_loop_has_order_one_or_two():
    with pytest.raises(ValueError, match="order is 3"):
        frequency_loop(3, 5.0, 0.02)
