"""The search of the vector closures: false alarms, cells, reach, and runs that need it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from signals.nco import Taps
from ultratight import load, run
from ultratight.results import Run
from ultratight.scenario import Scenario
from ultratight.simulation import fly, new_closure
from ultratight.tracking.knows import Knows
from ultratight.tracking.vector import Vector
from ultratight.tracking.vector_dwell import (
    BIN_HZ,
    CELL_HZ,
    DETECTED,
    N_BIN,
    dwell,
    threshold,
)
from ultratight.tracking.vector_measurements import DOUBT, GONE, doubted, renewed
from ultratight.tracking.vector_search import (
    AGREE,
    CONFIRM_S,
    FOUND,
    LOOKING,
    Search,
    add_spectra,
    agreeing,
    cells,
)
from ultratight.world import World

CALM = {"clock.model": "ideal", "clock.bias_m": 0.0, "clock.drift_mps": 0.0}
WAVELENGTH_M, CHIP_M = 299792458.0 / 1575.42e6, 299792458.0 / 1.023e6
DARK = {"t0_s": 2.0, "cn0_change_db": -45.0}


def static(closure: str, duration_s: float, **change: Any) -> Scenario:
    return load("static", {"receiver.closure": closure, "duration_s": duration_s} | change)


def noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Unit variance in each component."""
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


# -- a cell ---------------------------------------------------------------------------------------


def test_the_power_of_a_turning_signal_is_in_its_bin() -> None:
    """20 prompts of amplitude a add up to 20 a^2, in the bin with the sign of the frequency."""
    power = np.zeros((3, N_BIN))
    k = np.arange(20)
    prompts = np.zeros((20, 3), dtype=np.complex128)
    prompts[:, 2] = 1.5 * np.exp(2j * np.pi * 3 * BIN_HZ * k * 1e-3)
    add_spectra(prompts, power)
    assert np.unravel_index(power.argmax(), power.shape) == (2, N_BIN // 2 + 3)
    assert power.max() == pytest.approx(20.0 * 1.5**2)
    assert not power[:2].any()


def test_false_alarms_are_as_stated() -> None:
    """The threshold is a chi-square quantile; the largest of 39 independent and 36 correlated
    powers passes it with 1 - (1 - p / 75)^39 at least and p at most."""
    assert threshold(3, 1e-4) == pytest.approx(chi2.isf(1e-4 / (3 * N_BIN), 6))
    p, bits, n = 0.05, 2, 4000
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(n):
        power = np.zeros((3, N_BIN))
        for _ in range(bits):
            add_spectra(noise(rng, 20, 3), power)
        alarms += power.max() > threshold(bits, p)
    low, high = 1.0 - (1.0 - p / (3 * N_BIN)) ** (3 * (N_BIN // 2 + 1)), p
    four_sigma = 4.0 * np.sqrt(p * (1.0 - p) / n)
    assert low - four_sigma < alarms / n < high + four_sigma


@pytest.mark.parametrize("cn0_dbhz", [22.0, 25.0, 30.0, 40.0])
def test_the_dwell_is_the_shortest_that_detects(cn0_dbhz: float) -> None:
    """Of signals anywhere in a cell 0.9 pass in so many bits: a noncentral chi-square with
    2 C/N0 20 ms per bit less the cell's losses (scipy.stats), and counted with turning prompts."""
    a2, p, spacing = 0.02 * 10.0 ** (cn0_dbhz / 10.0), 1e-4, 0.25
    bits = dwell(a2, spacing, p, 1, 25)
    late = np.linspace(0.0, spacing / 2.0, 1001)
    losses = np.mean((1.0 - late) ** 2)
    for hertz, span_s in ((BIN_HZ, 0.02), (CELL_HZ, 1e-3)):
        losses *= np.mean(np.sinc(np.linspace(-0.5, 0.5, 1001) * hertz * span_s) ** 2)

    def passes(n: int) -> float:
        return float(ncx2.sf(threshold(n, p), 2 * n, 0.04 * 10.0 ** (cn0_dbhz / 10.0) * n * losses))

    assert passes(bits) >= DETECTED
    assert bits == 1 or passes(bits - 1) < DETECTED
    rng, n, hits = np.random.default_rng(8), 150, 0
    k = np.arange(20)
    for _ in range(n):
        hertz, off = rng.uniform(-312.5, 312.5), rng.uniform(-0.375, 0.375)
        level = np.sqrt(2e-3 * 10.0 ** (cn0_dbhz / 10.0)) * np.sinc(hertz * 1e-3)
        taps = level * (1.0 - np.abs(off + np.array([-0.25, 0.0, 0.25])))
        signal = np.exp(2j * np.pi * hertz * 1e-3 * k)[:, None] * taps
        power = np.zeros((3, N_BIN))
        for _ in range(bits):
            add_spectra(signal + noise(rng, 20, 3), power)
        hits += power.max() > threshold(bits, p)
    # the losses differ from place to place: about 0.9, and more where one bit is plenty
    assert hits / n > DETECTED - 0.05 - 3.0 * np.sqrt(0.09 / n)


def test_who_would_find_nothing_away_from_the_centre_waits_there() -> None:
    """20 dB-Hz needs 25 bits without any loss and more with; 40 dB-Hz the least that is asked."""
    assert dwell(2.0, 0.25, 1e-4, 2, 25) == 26
    assert dwell(200.0, 0.25, 1e-4, 2, 25) == 2
    search = Search(np.array([2.0, 200.0]), 0.25, 0.02, 2, 1e-4)
    spread = np.tile(np.diag([0.5**2, 400.0**2]), (2, 1, 1))
    began, _ = search.step(0.0, np.ones(2, dtype=np.bool_), spread)
    assert began == [1]
    assert search.held.tolist() == [False, True]


def test_the_cells_cover_the_ellipse_of_three_sigma() -> None:
    """Their number is the ellipse's area over a cell's; errors of that covariance are in one of
    them with 1 - exp(-9/2)."""
    step = np.array([0.75, CELL_HZ])
    sigma, corr = np.array([8.0, 4000.0]), 0.8
    spread = np.outer(sigma, sigma) * np.array([[1.0, corr], [corr, 1.0]])
    grid = cells(spread, step)
    wide = spread + np.diag(step**2 / 12.0)
    assert len(grid) == pytest.approx(np.pi * 9.0 * np.sqrt(np.linalg.det(wide)) / step.prod(),
                                      rel=0.03)  # fmt: skip
    assert not grid[0].any()
    distance = np.einsum("ni,ij,nj->n", grid, np.linalg.inv(wide), grid)
    assert (np.diff(distance) >= 0.0).all()
    error = np.random.default_rng(2).multivariate_normal(np.zeros(2), spread, 20_000)
    there = {tuple(x) for x in np.rint(grid / step).astype(int).tolist()}
    share = np.mean([tuple(x) in there for x in np.rint(error / step).astype(int).tolist()])
    assert share == pytest.approx(1.0 - np.exp(-4.5), abs=4.0 * np.sqrt(0.011 / 20_000))


@pytest.mark.parametrize("true", [(1.1, 480.0), (-0.7, 90.0), (0.4, -1010.0), (0.0, 0.0)])
def test_it_ends_on_the_signal(true: tuple[float, float]) -> None:
    """A triangle's taps at 40 dB-Hz, relative to a solution that is off: within half a tap's
    distance, and half a bin, of the signal."""
    rng, taps_at = np.random.default_rng(5), np.array([-0.25, 0.0, 0.25])
    search = Search(np.array([200.0]), 0.25, 0.02, 2, 1e-4)
    spread = np.diag([0.5**2, 400.0**2])[None]
    dark, t_s = np.ones(1, dtype=np.bool_), 0.0
    while search.state[0] != FOUND and t_s < 10.0:
        off_chips, off_hz = search.off[:, 0]
        search.step(t_s, dark, spread)
        # a replica that is d late has the code phase of the NCO less d
        level = np.sqrt(2.0 * 1e4 * 1e-3) * np.sinc((true[1] - off_hz) * 1e-3)
        level *= np.maximum(0.0, 1.0 - np.abs(true[0] - off_chips + taps_at))
        t = t_s + 1e-3 * np.arange(20)
        iq = level * np.exp(2j * np.pi * (true[1] - off_hz) * t)[:, None] + noise(rng, 20, 3)
        search.take_in(dumps(t, np.rint(t * 1e3).astype(np.int64), iq))
        t_s += 0.02
    assert search.state[0] == FOUND
    # a quarter of a tap's distance, or of a bin, for the noise
    assert abs(search.off[0, 0] - true[0]) < 0.75 * 0.25
    assert abs(search.off[1, 0] - true[1]) < 0.75 * BIN_HZ


def dumps(t_s: np.ndarray, number: np.ndarray, iq: np.ndarray) -> Taps:
    """Of channel 0, code periods that begin at t_s."""
    n = t_s.size
    z = np.zeros(n)
    return Taps(np.zeros(n, np.int64), number, t_s, t_s + 1e-3, iq, np.ones(n), z, z, z, z)


def test_of_three_that_were_found_the_one_that_contradicts_stays_out() -> None:
    rng = np.random.default_rng(3)
    A = np.zeros((3, 2, 8))
    u = rng.standard_normal((3, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    A[:, 0, :3] = A[:, 1, 3:6] = -u
    A[:, 0, 6] = A[:, 1, 7] = 1.0
    cov = np.diag([100.0**2] * 3 + [10.0**2] * 3 + [1.0, 0.1])
    R = np.tile(np.diag([25.0, 1.0]), (3, 1, 1))
    x = np.linalg.cholesky(cov) @ np.full(8, 0.7)
    z = A @ x
    assert agreeing(z, A, R, cov).all()
    assert agreeing(z[:1], A[:1], R[:1], cov).all()
    z[1, 1] += 6.0 * np.sqrt(A[1, 1] @ cov @ A[1, 1])
    assert agreeing(z, A, R, cov).tolist() == [True, False, True]
    assert not agreeing(z[:2], A[:2], R[:2], cov).any()
    # two channels that obey the model are refused with the stated probability
    draws = rng.standard_normal((2000, 8)) @ np.linalg.cholesky(cov).T
    own = rng.standard_normal((2000, 3, 2)) * np.array([5.0, 1.0])
    refused = sum(not agreeing((A @ d + e)[:2], A[:2], R[:2], cov).any()
                  for d, e in zip(draws, own, strict=True))  # fmt: skip
    assert refused <= 2000 * AGREE + 4.0 * np.sqrt(2000 * AGREE)


# -- a signal that goes ---------------------------------------------------------------------------


@pytest.mark.parametrize("cn0_dbhz", [26.0, 30.0, 40.0])
def test_a_signal_that_goes_is_noticed_and_one_that_stays_is_not_doubted(cn0_dbhz: float) -> None:
    """Page: log-likelihood ratios of more than 12 come from a signal once in exp(12) bits; without
    one each bit adds the Kullback-Leibler divergence on average."""
    rng = np.random.default_rng(4)
    a2 = 2.0 * 0.01 * 10.0 ** (cn0_dbhz / 10.0)
    variance, n = 2.0 * a2 + 2.0, 5000
    product = np.abs(np.prod(np.sqrt(a2) + noise(rng, n, 2), axis=1))
    sums, doubt = np.zeros(n), 0.0
    for k in range(n):
        doubt = sums[k] = doubted(doubt, a2, product[k])
    assert sums.max() < GONE
    assert np.mean(sums > DOUBT) < 0.05
    product = np.abs(np.prod(noise(rng, 500, 40, 2), axis=2))
    divergence = 0.5 * ((1.53 + (a2 - 0.57) ** 2) / variance - 1.0 + np.log(variance / 1.53))
    for row in product:
        doubt, k = 0.0, 0
        while doubt < GONE:
            doubt, k = doubted(doubt, a2, row[k]), k + 1
        assert k <= 4.0 * GONE / divergence + 3.0
    assert renewed(a2, 0.0, 0.0, 0.02)[0] > 0.9 * a2  # the low pass alone would take a second


# -- runs -----------------------------------------------------------------------------------------


def told_wrong(world: World, dr: np.ndarray, dv: np.ndarray, sigma: tuple[float, float]) -> Knows:
    """A first state that is off, and says by how much."""
    told = dict(vars(world.knows))
    told["r_eb_e"], told["v_eb_e"] = told["r_eb_e"] + dr, told["v_eb_e"] + dv
    told["sigma"] = told["sigma"].copy()
    told["sigma"][:3], told["sigma"][3:6] = sigma
    return Knows(**told)


def found(world: World, dr: np.ndarray, dv: np.ndarray, sigma: tuple[float, float]) -> Vector:
    receiver = new_closure(world.scenario, told_wrong(world, dr, dv, sigma))
    assert isinstance(receiver, Vector)
    fly(receiver, world.correlator(), world.imu[0], world.scenario.duration_s)
    return receiver


def errors(world: World, receiver: Vector) -> tuple[float, float]:
    r, v = world.antenna(np.array([receiver.t_s]))
    return float(np.linalg.norm(r[0] - receiver.x[:3])), float(
        np.linalg.norm(v[0] - receiver.x[3:6])
    )


OFF = np.array([0.8, -0.9, 0.7]), np.array([-0.8, 0.7, 0.9])


@pytest.mark.parametrize("closure", ["vdfll", "vdll"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_solution_beyond_the_reach_is_found_again(closure: str, sign: float) -> None:
    """560 m and 111 m/s off, 1.9 chips and 585 Hz: taps reach 0.75 chips, half bits 25 Hz."""
    change = CALM | {"cn0_dbhz": 40.0, "receiver.vector.states": 8}
    dr, dv, sigma = sign * 400.0 * OFF[0], sign * 80.0 * OFF[1], (400.0, 80.0)
    world = World(static(closure, 4.0, **change), 1)
    receiver = found(world, dr, dv, sigma)
    assert sum(kind == "re-acquired" for _, _, kind, _ in receiver.events) >= 2
    assert receiver.heard.all()
    assert not receiver.search.held.any()
    off_m, off_mps = errors(world, receiver)
    assert off_m < 10.0
    assert off_mps < 2.0
    blind = World(static(closure, 4.0, **change, **{"receiver.vector.search_bits": 0}), 1)
    assert errors(blind, found(blind, dr, dv, sigma))[1] > 50.0


@pytest.mark.slow
def test_the_search_works_on_samples() -> None:
    """Five satellites: the same seam, nothing but commands and taps; 140 m and 28 m/s off."""
    change = CALM | {"cn0_dbhz": 45.0, "receiver.vector.states": 8, "max_satellites": 5}
    world = World(static("vdfll", 1.2, **change, **{"correlator.kind": "samples"}), 1)
    receiver = found(world, 100.0 * OFF[0], 20.0 * OFF[1], (100.0, 20.0))
    assert sum(kind == "re-acquired" for _, _, kind, _ in receiver.events) >= 2
    assert receiver.heard.all()
    assert errors(world, receiver)[1] < 3.0


def kinds(r: Run, kind: str) -> list[Any]:
    return [e for e in r.events if e.kind == kind]


@pytest.mark.parametrize("states", [8, 11])
def test_an_outage_of_all_leaves_an_honest_solution_and_is_survived(states: int) -> None:
    """6 s at rest: the acceleration that is held has the sigma of the last update and fades with
    1 s; NEES of position and velocity at the end of the dark within chi-square(6), 1e-4."""
    change = {
        "cn0_dbhz": 40.0, "receiver.vector.states": states,
        "channel.disturbance": [DARK | {"t1_s": 8.0}],
    }  # fmt: skip
    for seed in (1, 2):
        r = run(static("vdfll", 10.5, **change), seed)
        k = int(np.searchsorted(r.t_s, 7.99)) - 1
        error = np.concatenate([(r[f"{x}_eb_e_true"] - r[f"{x}_eb_e"])[k] for x in ("r", "v")])
        assert error @ np.linalg.solve(r["covariance"][k][:6, :6], error) < chi2.isf(1e-4, 6)
        assert np.linalg.norm(error[3:]) < 15.0
        assert kinds(r, "re-acquired")
        assert "search:" in kinds(r, "re-acquired")[0].reason
        late = r.t_s > 10.3
        assert r["contributes"][late].all()
        off = r["nco_carrier_freq"] - r["doppler_true"]
        assert np.abs(off[late]).max() < 25.0
        assert not r["contributes"][(r.t_s > 2.3) & (r.t_s < 8.0)].any()


def test_a_false_alarm_moves_nothing() -> None:
    """In the dark a channel is told that its signal is 2 chips and 200 Hz away: it is not heard
    there, so the solution does not move, and the search goes on."""
    world = World(static("vdfll", 4.0, **{"channel.disturbance": [DARK], "cn0_dbhz": 40.0}), 1)
    receiver = new_closure(world.scenario, world.knows)
    assert isinstance(receiver, Vector)
    correlator = world.correlator()
    imu = world.imu[0]
    fly(receiver, correlator, imu, 3.0)
    assert receiver.search.looking.all()
    x, cov = receiver.x.copy(), receiver.cov.copy()
    receiver.search.state[3], receiver.search.since_s[3] = FOUND, receiver.t_s
    receiver.search.off[:, 3] = 2.0, 200.0
    n = round((CONFIRM_S + 0.06) / receiver.epoch_s)
    for _ in range(n):
        receiver.step(correlator(receiver.steer(receiver.t_s + receiver.epoch_s, imu)))
    assert receiver.search.state[3] == LOOKING
    ahead = np.linalg.norm(receiver.x[:3] - x[:3] - x[3:6] * n * receiver.epoch_s)
    assert ahead <= np.linalg.norm(x[8:]) * (n * receiver.epoch_s) ** 2
    assert (np.diagonal(receiver.cov)[:8] >= np.diagonal(cov)[:8]).all()


def test_a_weak_signal_comes_back_as_without_a_search() -> None:
    """20 dB-Hz: two bits in a cell pass with 0.002, so nobody is carried away from the solution."""
    change = {"cn0_dbhz": 20.0, "channel.disturbance": [DARK | {"t1_s": 5.0}]}
    with_search, without = (
        run(static("vdfll", 6.0, **change, **{"receiver.vector.search_bits": bits}), 21)
        for bits in (2, 0)
    )
    assert not with_search["contributes"][(with_search.t_s > 4.8) & (with_search.t_s < 5.0)].any()
    assert np.array_equal(with_search["r_eb_e"], without["r_eb_e"])


def test_two_that_contradict_wait_for_a_third_and_say_so_once() -> None:
    """Found and heard at 40 dB-Hz, of which the solution expects 100 sigma less."""
    world = World(static("vdfll", 4.0, cn0_dbhz=40.0), 1)
    receiver = new_closure(world.scenario, world.knows)
    assert isinstance(receiver, Vector)
    correlator, imu = world.correlator(), world.imu[0]
    fly(receiver, correlator, imu, 1.0)
    receiver.x[3:6] += np.array([40.0, -30.0, 20.0])
    before = len(receiver.events)
    for i in range(receiver.n_channel):
        receiver.search.hold(i, receiver.t_s)
    for _ in range(round(0.3 / receiver.epoch_s)):
        receiver.step(correlator(receiver.steer(receiver.t_s + receiver.epoch_s, imu)))
    told = [(i, kind) for _, i, kind, _ in receiver.events[before:]]
    assert len(told) == len(set(told)) > 1
    assert "loss of lock" not in {kind for _, kind in told}
    assert receiver.search.refused.any()
    assert {i for i, kind in told if kind == "search"} >= set(
        np.flatnonzero(receiver.search.refused).tolist()
    )
    assert not receiver.heard[receiver.search.refused].any()


def test_same_seed_same_bits() -> None:
    change = {"channel.disturbance": [DARK | {"t1_s": 7.0}]}
    one, two = (run(static("vdfll", 8.0, **change), 7) for _ in range(2))
    for name in one.variables:
        assert np.array_equal(one[name], two[name], equal_nan=one[name].dtype.kind == "f"), name
    assert np.abs(one["search_hz"]).max() > 0.0
