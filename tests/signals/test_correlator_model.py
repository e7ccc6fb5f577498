"""The closed form against brute-force integration, the sinc law, and its own contracts."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.correlator_model import ModelCorrelator
from signals.nco import Nco, Taps
from signals.propagation import SignalState

OFFSETS = np.array([-0.25, 0.0, 0.25])
QUADRATURE = 1e-6  # of the amplitude, promised by the module
Truth = Callable[..., SignalState]
Command = Callable[..., Nco]


def correlator(
    state: SignalState, prn: list[int], offset_chips: np.ndarray = OFFSETS, **options: object
) -> ModelCorrelator:
    chips = np.array([GPS_L1CA.chips(n) for n in prn])
    options = {"seed": 1, "noise": False} | options
    return ModelCorrelator(state, chips, np.array(prn), offset_chips, **options)


def own_correlation(prn: int, lag_chips: np.ndarray) -> np.ndarray:
    """R at any lag by definition: the sum of overlaps of two trains of rectangular chips."""
    chips = GPS_L1CA.chips(prn).astype(int)
    whole = np.floor(lag_chips).astype(int)
    part = lag_chips - whole
    lags, where = np.unique(whole, return_inverse=True)
    at = np.array([chips @ np.roll(chips, k) for k in lags])[where] / 1023
    after = np.array([chips @ np.roll(chips, k + 1) for k in lags])[where] / 1023
    return (1 - part) * at + part * after


def concatenate(parts: list[Taps]) -> Taps:
    return Taps(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def brute_force(state: SignalState, nco: Nco, prn: int, taps: Taps, k: int, n: int) -> np.ndarray:
    """Equation (1) of the module for row k by the midpoint rule with n points."""
    i = int(taps.channel[k])
    edges = np.linspace(taps.t_start_s[k], taps.t_end_s[k], n + 1)
    t = (edges[1:] + edges[:-1]) / 2
    p = np.searchsorted(state.t_s, t, "right") - 1
    dt = t - state.t_s[p]
    code, carrier = (
        (c[i, p] * dt[:, None] ** np.arange(4)).sum(axis=1)
        for c in (state.code_phase_chips, state.carrier_phase_cycles)
    )
    q = np.searchsorted(nco.t_s, t, "right") - 1
    dt = t - nco.t_s[q]
    replica_code = nco.code_phase_chips[q, i] + nco.chip_rate_hz[q, i] * dt
    replica_carrier = nco.carrier_phase_cycles[q, i] + dt * (
        nco.carrier_freq_hz[q, i] + nco.carrier_rate_hz_per_s[q, i] * dt / 2
    )
    symbol = state.symbols[i, np.floor(code / 20460).astype(int) - state.first_symbol]
    gain = symbol * np.sqrt(state.valid[i, p] * 10 ** (state.cn0_dbhz[i, p] / 10))
    turn = gain * np.exp(2j * np.pi * (carrier - replica_carrier))
    length = taps.t_end_s[k] - taps.t_start_s[k]
    lag = code - replica_code
    return np.sqrt(2 * length) * np.array(
        [np.mean(own_correlation(prn, lag + d) * turn) for d in OFFSETS]
    )


@pytest.mark.nojit
@pytest.mark.parametrize("frequency_hz", [0.0, 3.0, 21.0, 130.0, 480.0, 5300.0])
@pytest.mark.parametrize("prn", [7, 17])
def test_constant_errors_give_the_sinc(
    truth: Truth, command: Command, prn: int, frequency_hz: float
) -> None:
    """sqrt(2 C/N0 T) R sinc(f T) exp(j phi_mid): Kaplan & Hegarty, 3rd ed., ch. 8."""
    error_chips, error_cycles = 0.31, 0.13
    state = truth(chips=error_chips, cycles=error_cycles, cn0_dbhz=41.0, duration_s=0.035)
    nco = command([0.0, 5e-3, 12e-3, 0.031], dump_chips=10230)
    nco.carrier_phase_cycles[:] -= frequency_hz * nco.t_s[:-1, None]
    nco.carrier_freq_hz[:] -= frequency_hz
    taps = correlator(state, [prn])(nco)
    length = 0.01
    amplitude = np.sqrt(2 * 10**4.1 * length)
    middle = (taps.t_start_s + taps.t_end_s) / 2
    expected = (
        amplitude
        * np.sinc(frequency_hz * length)
        * np.exp(2j * np.pi * (error_cycles + frequency_hz * middle))[:, None]
        * own_correlation(prn, error_chips + OFFSETS)
    )
    assert taps.number.tolist() == [0, 1, 2]
    np.testing.assert_allclose(taps.iq, expected, atol=QUADRATURE * amplitude)


def test_moving_errors_against_brute_force(truth: Truth, command: Command) -> None:
    """Ramps, jerk, kinks of R (the code drifts over whole chips), pieces that do not align."""
    n = 400_000
    state = truth(
        chips=[-700.4, 4000.9],
        cycles=[3.2, -8000.1],
        doppler_hz=[2500.0, -1800.0],
        rate_hz_per_s=[500.0, -900.0],
        jerk_hz_per_s2=[-1e5, 3e5],
        cn0_dbhz=[45.0, 33.0],
        duration_s=0.05,
    )
    nco = command(
        [0.001, 0.004, 0.0113, 0.0211, 0.0337, 0.0481],
        chips=[-700.0, 4003.1],
        cycles=[0.0, -8000.0],
        doppler_hz=[2460.0, -2300.0],
        rate_hz_per_s=[0.0, 400.0],
        dump_chips=10230,
    )
    nco.chip_rate_hz[:, 0] -= 230.0  # 7 chips in a piece
    prn = [17, 8]
    taps = correlator(state, prn)(nco)
    assert taps.channel.tolist() == [0] * 3 + [1] * 4
    for k, i in enumerate(taps.channel):
        amplitude = np.sqrt(2 * 10 ** (state.cn0_dbhz[i, 0] / 10) * 0.02)
        expected = brute_force(state, nco, prn[i], taps, k, n)
        np.testing.assert_allclose(taps.iq[k], expected, atol=QUADRATURE * amplitude)


def test_data_symbols_and_outages_fall_where_the_truth_has_them(
    truth: Truth, command: Command
) -> None:
    n = 400_000
    state = truth(
        chips=300.0, doppler_hz=900.0, duration_s=0.1, symbols=np.array([[1, -1, 1, 1, -1, -1, 1]])
    )
    state.valid[0, 9:12] = False
    state.cn0_dbhz[0, 3:] = 39.0
    nco = command([0.0, 0.05, 0.1], chips=-3000.0, doppler_hz=910.0, dump_chips=20460)
    nco.code_phase_chips[:] += 0.2
    taps = correlator(state, [7])(nco)
    assert taps.number.tolist() == [0, 1, 2, 3]
    amplitude = np.sqrt(2 * 10**4.5 * 0.02)
    for k in range(4):
        expected = brute_force(state, nco, 7, taps, k, n)
        # the midpoint rule itself misplaces each of three jumps by up to half a point, twice as
        # high as the amplitude
        np.testing.assert_allclose(taps.iq[k], expected, atol=(QUADRATURE + 3 / n) * amplitude)


def test_a_missing_satellite_has_no_mean(truth: Truth, command: Command) -> None:
    state = truth(duration_s=0.02)
    state.valid[:] = False
    state.code_phase_chips[:] = np.nan
    state.carrier_phase_cycles[:] = np.nan
    taps = correlator(state, [7])(command([0.0, 0.02]))
    assert len(taps.iq) >= 19
    assert np.all(taps.iq == 0.0)


def test_bounds_do_not_depend_on_how_commands_are_cut(truth: Truth, command: Command) -> None:
    motion = {"chips": [100.0, -777.7], "doppler_hz": [900.0, -2000.0]}
    state = truth(**motion, duration_s=0.1)
    options = {"dump_chips": [2046, 20460]} | motion
    t_s = np.array([0.0, 4e-3, 11e-3, 20e-3, 37e-3, 61e-3, 62e-3, 0.1])
    at_once = correlator(state, [7, 8], noise=True)(command(t_s, **options))
    stepwise = correlator(state, [7, 8], noise=True)
    parts = [stepwise(command([a, b], **options)) for a, b in pairwise(t_s)]
    together = concatenate(parts)
    order = np.lexsort((together.number, together.channel))
    for name, a, b in zip(Taps._fields, at_once, together, strict=True):
        np.testing.assert_allclose(b[order], a, rtol=0, atol=1e-9, err_msg=name)
    first = at_once.channel == 0
    assert at_once.number[first].tolist() == list(range(1, 50))
    np.testing.assert_allclose(
        at_once.code_start_chips, at_once.number * 2046 * np.where(first, 1, 10)
    )
    np.testing.assert_allclose(at_once.code_end_chips - at_once.code_start_chips,
                               np.where(first, 2046, 20460))  # fmt: skip
    replica = command([0.0, 1.0], **options)
    i = at_once.channel
    for t, cycles in (
        (at_once.t_start_s, at_once.carrier_start_cycles),
        (at_once.t_end_s, at_once.carrier_end_cycles),
    ):
        np.testing.assert_allclose(cycles, replica.carrier_freq_hz[0, i] * t, atol=1e-6)


def test_small_steps_of_the_code_neither_repeat_nor_skip(truth: Truth, command: Command) -> None:
    state = truth(duration_s=0.03)
    model = correlator(state, [7])
    indices = []
    for k in range(30):
        step = 0.4 if k % 2 else -0.4  # the command's own bounds are the integrations' bounds
        taps = model(command([k * 1e-3, (k + 1) * 1e-3], chips=step))
        indices += taps.number.tolist()
        assert np.all(np.abs(taps.t_end_s - taps.t_start_s - 1e-3) < 1e-6)
    # 28, not 29: the replica starts 0.4 chip early, and the last integration is still open
    assert indices == list(range(indices[0], indices[0] + len(indices)))
    assert len(indices) >= 28


@pytest.mark.parametrize("cause", ["valid", "dump_chips", "gap", "jump"])
def test_what_drops_the_open_sums(truth: Truth, command: Command, cause: str) -> None:
    """The first integration after the disturbance is a whole one."""
    state = truth(duration_s=0.1)
    model = correlator(state, [7])
    before = model(command([0.0, 0.03], chips=5.0, dump_chips=20460))
    assert before.number.tolist() == []  # 5 chips late for the multiple at 0, none ended since
    disturbed = command([0.03, 0.035], chips=5.0, dump_chips=20460)
    after = command([0.035, 0.1], chips=5.0, dump_chips=20460)
    if cause == "valid":
        disturbed.valid[0] = False
    elif cause == "dump_chips":
        disturbed.dump_chips[0] = 10230
    elif cause == "gap":
        disturbed = None
    else:
        disturbed.code_phase_chips[:] += 300_000.0
    taps = concatenate(([] if disturbed is None else [model(disturbed)]) + [model(after)])
    np.testing.assert_allclose(taps.t_end_s - taps.t_start_s, 0.02, atol=1e-6)
    assert taps.number.tolist() == [2, 3, 4]
    undisturbed = correlator(state, [7])(command([0.0, 0.1], chips=5.0, dump_chips=20460))
    assert undisturbed.number.tolist() == [1, 2, 3, 4]


def test_bounds_on_samples(truth: Truth, command: Command) -> None:
    fs = 4.3e6
    state = truth(doppler_hz=1000.0, duration_s=0.02)
    nco = command([0.0, 7e-3, 0.02], chips=0.3, doppler_hz=1000.0)
    free = correlator(state, [7])(nco)
    sampled = correlator(state, [7], sample_rate_hz=fs)(nco)
    for a, b in ((free.t_start_s, sampled.t_start_s), (free.t_end_s, sampled.t_end_s)):
        np.testing.assert_allclose(b * fs, np.ceil(a * fs), atol=1e-6)


def test_noise_covariance_is_the_codes_own(truth: Truth, command: Command) -> None:
    """Unit variance per component, R(d_i - d_k) between taps, nothing between anything else."""
    offsets = np.array([0.0, -0.25, 0.25, 0.25, 1.0])  # out of order, one twice, one a chip away
    prn = [7, 17]
    state = truth(chips=[0.0, 0.0], cn0_dbhz=-np.inf, duration_s=6.0)
    model = correlator(state, prn, offsets, noise=True, seed=5)
    taps = model(command(np.arange(0.0, 6.001, 1.0), chips=[0.0, 0.0]))
    first, second = (taps.iq[taps.channel == i][:5990] for i in range(2))
    n = len(first)
    np.testing.assert_array_equal(first[:, 2], first[:, 3])
    for i, x in enumerate((first, second)):
        parts = np.hstack([x.real, x.imag])
        r = own_correlation(prn[i], np.subtract.outer(offsets, offsets))
        expected = np.kron(np.eye(2), r)
        # var of a sample covariance of normals is (r_ii r_kk + r_ik^2) / n
        assert np.all(np.abs(parts.T @ parts / n - expected) < 4.5 * np.sqrt((1 + expected**2) / n))
        lagged = parts[1:].T @ parts[:-1] / n
        assert np.all(np.abs(lagged) < 4.5 / np.sqrt(n))
    cross = np.hstack([first.real, first.imag]).T @ np.hstack([second.real, second.imag]) / n
    assert np.all(np.abs(cross) < 4.5 / np.sqrt(n))


def test_noise_is_common_to_runs_and_keyed_by_what_it_belongs_to(
    truth: Truth, command: Command
) -> None:
    def draws(prn: list[int], seed: int = 1, dump_chips: int = 1023, doppler: float = 0.0) -> Taps:
        state = truth(chips=np.zeros(len(prn)), cn0_dbhz=-np.inf, duration_s=0.1)
        nco = command([0.0, 0.03, 0.1], chips=np.zeros(len(prn)), doppler_hz=doppler,
                      dump_chips=dump_chips)  # fmt: skip
        return correlator(state, prn, noise=True, seed=seed)(nco)

    one = draws([7, 9])
    other = draws([9, 7, 3], doppler=3000.0)  # another order, another replica
    for i, k in ((0, 1), (1, 0)):
        a, b = one.iq[one.channel == i], other.iq[other.channel == k]
        m = min(len(a), len(b))
        np.testing.assert_array_equal(a[:m], b[:m])
    for different in (draws([7], seed=2), draws([9])):
        assert not np.any(different.iq[:90] == one.iq[:90])
    assert not np.any(draws([7], dump_chips=20460).iq[0] == one.iq[0])
    # a tap more leaves the draws of those before it
    state = truth(cn0_dbhz=-np.inf, duration_s=0.1)
    more = correlator(state, [7], np.append(OFFSETS, 0.5), noise=True)(command([0.0, 0.03, 0.1]))
    np.testing.assert_array_equal(more.iq[:, :2], one.iq[one.channel == 0][:, :2])


def test_multiple_access_noise(truth: Truth, command: Command) -> None:
    """Eight satellites at 45 dB-Hz cost each other 0.585 dB: self separation -61.86 dB/Hz."""
    prn = list(range(1, 9))
    state = truth(chips=np.zeros(8), cn0_dbhz=45.0, duration_s=0.05)
    nco = command([0.0, 0.05], chips=np.zeros(8), dump_chips=20460)
    quiet = correlator(state, prn)(nco).iq
    alone = correlator(state, prn, noise=True)(nco).iq - quiet
    taps = correlator(state, prn, noise=True, multiple_access=True)(nco)
    ratio_db = 20 * np.log10(np.abs((taps.iq - quiet) / alone))
    expected_db = 10 * np.log10(1 + 7 * 10**4.5 * 10**-6.186)
    np.testing.assert_allclose(ratio_db, expected_db, atol=1e-3)  # -61.86 dB/Hz is rounded
    assert np.all(taps.noise_var == 1.0)


def test_refusals(truth: Truth, command: Command) -> None:
    state = truth(duration_s=0.1)
    chips = GPS_L1CA.chips(7)[None]
    with pytest.raises(ValueError, match=r"of 1 channels and prn \(2,\): expected one for"):
        ModelCorrelator(state, chips, np.array([7, 8]), OFFSETS, 1)
    with pytest.raises(ValueError, match="offset_chips"):
        ModelCorrelator(state, chips, np.array([7]), np.array([np.nan]), 1)
    short = state._replace(symbols=np.ones((1, 2), np.int8))
    with pytest.raises(ValueError, match="symbols -1 to 0 do not cover"):
        ModelCorrelator(short, chips, np.array([7]), OFFSETS, 1)
    far = state._replace(code_phase_chips=np.full_like(state.code_phase_chips, 1e300))
    with pytest.raises(ValueError, match=r"state.code_phase_chips contains 1e\+300"):
        ModelCorrelator(far, chips, np.array([7]), OFFSETS, 1)
    model = correlator(state, [7])
    with pytest.raises(ValueError, match="inside the truth"):
        model(command([0.05, 0.11]))
    with pytest.raises(ValueError, match="multiples of 1023"):
        model(command([0.0, 0.01], dump_chips=1000))
    with pytest.raises(ValueError, match=r"expected \(1, 1\)"):
        model(command([0.0, 0.01], chips=[0.0, 0.0]))
    spoilt = command([0.0, 0.01])
    spoilt.chip_rate_hz[0, 0] = -1.0
    with pytest.raises(ValueError, match=r"chip_rate_hz is -1\.0: expected > 0"):
        model(spoilt)
    spoilt.carrier_phase_cycles[0, 0] = np.nan
    with pytest.raises(ValueError, match="carrier_phase_cycles of a valid channel is nan"):
        model(spoilt)
    for name, value in (("code_phase_chips", 1e17), ("carrier_freq_hz", -1e300)):
        absurd = command([0.0, 0.01])
        getattr(absurd, name)[0, 0] = value
        with pytest.raises(ValueError, match=f"{name} of a valid channel is -?1e"):
            model(absurd)
    spoilt.valid[0] = False
    assert len(model(spoilt).number) == 0
