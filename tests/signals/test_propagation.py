"""Pseudorange, its rate and the phases at the antenna: laws and independent oracles."""

import numpy as np
import pytest

from signals import satellites
from signals.arcs import arcs
from signals.code_start import code_phase_origin, nominal, symbol_span
from signals.codes import GPS_L1CA, GPS_L1CP, GPS_L2CL, GPS_L5Q
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ, OMEGA_EARTH
from signals.propagation import (
    SignalState,
    elevation_azimuth,
    predict_channels,
    pseudorange,
    signal_state,
)
from signals.satellites import embedded, orbit

TOW = 475_220.0
CHIPS_PER_SYMBOL = 20_460  # IS-GPS-200 3.3.2.2: a data bit is 20 ms of 1.023 Mcps
PRNS, ROWS = embedded().select(2149, TOW)
# 39.9 N 116.4 E, 8000 m (WGS-84, NGA.STND.0036 (4-14)) and its directions
LAT, LON = np.radians([39.9, 116.4])
UP = np.array([np.cos(LAT) * np.cos(LON), np.cos(LAT) * np.sin(LON), np.sin(LAT)])
EAST = np.array([-np.sin(LON), np.cos(LON), 0.0])
NORTH = np.cross(UP, EAST)


def ecef(latitude: float, longitude: float, height: float) -> np.ndarray:
    e2 = 6.69437999014e-3
    n = 6378137.0 / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    flat = (n + height) * np.cos(latitude)
    z = (n * (1 - e2) + height) * np.sin(latitude)
    return np.array([flat * np.cos(longitude), flat * np.sin(longitude), z])


R0 = ecef(LAT, LON, 8000.0)
V0 = 250.0 * EAST + 30.0 * NORTH - 5.0 * UP


def turned(angle: float, vector: np.ndarray) -> np.ndarray:
    """Vector turned about z by angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])


def inertial_light_time(row: np.ndarray, gps_tow: float, r: np.ndarray) -> tuple[float, np.ndarray]:
    """Light time and direction in the inertial frame that coincides with ECEF at reception."""
    tau = 0.07
    for _ in range(30):
        satellite = np.array(orbit(row, gps_tow - tau)[:3])
        satellite = turned(-OMEGA_EARTH * tau, satellite)
        tau = np.linalg.norm(satellite - r) / C_MPS
    return float(tau), (satellite - r) / np.linalg.norm(satellite - r)


def test_light_time_in_the_inertial_frame():
    # sat at t - tau and antenna at t, both in one non-rotating frame, where light goes straight:
    # limited by the rounding of the time of week, 0.06 ns x 800 m/s = 50 nm
    for row in ROWS:
        clock_m = 1234.5
        rho, _, *u = pseudorange(row, TOW, R0, V0, clock_m, 0.0)
        gps = TOW - clock_m / C_MPS
        tau, direction = inertial_light_time(row, gps, R0)
        satellite_clock = orbit(row, gps - tau)[6]
        assert rho == pytest.approx(C_MPS * (tau - satellite_clock) + clock_m, abs=1e-7, rel=0)
        np.testing.assert_allclose(u, direction, rtol=0, atol=1e-14)


def test_sagnac_effect_has_its_textbook_size():
    # (omega / c) (x_s y_r - y_s x_r) for satellite and receiver in their own ECEF frames (Ashby
    # 2003, Living Rev. Relativity 6, eq. 11); second order is (omega tau)^2 r = 1 mm
    sizes = []
    for row in ROWS:
        rho = pseudorange(row, TOW, R0, np.zeros(3), 0.0, 0.0)[0]
        tau, _ = inertial_light_time(row, TOW, R0)
        x, y, z, *_, clock, _ = orbit(row, TOW - tau)
        straight = np.linalg.norm(np.array([x, y, z]) - R0)
        sizes.append(OMEGA_EARTH / C_MPS * (x * R0[1] - y * R0[0]))
        assert rho + C_MPS * clock - straight == pytest.approx(sizes[-1], abs=1e-3)
    assert min(sizes) < -15.0
    assert max(sizes) > 15.0


def accelerated(t: float) -> tuple[np.ndarray, np.ndarray]:
    a = 60.0 * NORTH - 40.0 * UP
    return R0 + V0 * t + 0.5 * a * t * t, V0 + a * t


def drifting(t: float) -> tuple[float, float]:
    """Clock bias and rate of a bad oscillator: 1 ppm and a ramp."""
    return 5e4 + 300.0 * t + 20.0 * t * t, 300.0 + 40.0 * t


@pytest.mark.parametrize("index", range(0, 13, 2))
def test_rate_is_the_derivative_of_the_pseudorange(index):
    # five-point rule at h = 0.25 s: truncation h^4/30 x 5th derivative (1e-9 m/s^5 for orbit and
    # quadratic motion) is nothing; rounding 1.5 x 2e-8 m / h = 1e-7 m/s
    row = ROWS[index].copy()
    row[satellites.AF1] += 1e-7  # a satellite clock whose (1 - tau_dot) shows

    def rho(t: float) -> tuple[float, float]:
        clock_m, rate = drifting(t)
        r, v = accelerated(t - clock_m / C_MPS)
        return pseudorange(row, TOW + t, r, v, clock_m, rate)[:2]

    h = 0.25
    p = [rho(k * h)[0] for k in (-2, -1, 1, 2)]
    assert rho(0.0)[1] == pytest.approx((p[0] - 8 * p[1] + 8 * p[2] - p[3]) / (12 * h), abs=1e-6)


def test_rate_has_the_terms_that_the_naive_one_lacks():
    # u.(v_s - v) + clock alone is wrong by millimetres to centimetres per second: the test above
    # would not pass without the Sagnac and light-time terms
    row = ROWS[0]
    rate, *u = pseudorange(row, TOW, R0, V0, 0.0, 0.0)[1:]
    out = orbit(row, TOW - 0.08)
    naive = np.dot(u, np.array(out[3:6]) - V0) - C_MPS * out[7]
    assert 1e-3 < abs(rate - naive) < 0.1


@pytest.mark.nojit
def test_clock_enters_with_its_sign():
    # rho = r + clock_m at an earlier GPS time: - rate clock_m / c to first order
    row = ROWS[1]
    base, rate, *_ = pseudorange(row, TOW, R0, np.zeros(3), 0.0, 0.0)
    ahead, ahead_rate, *_ = pseudorange(row, TOW, R0, np.zeros(3), 3000.0, 12.0)
    assert ahead - base == pytest.approx(3000.0 * (1 - rate / C_MPS), abs=1e-6)
    assert ahead_rate - rate == pytest.approx(12.0 * (1 - rate / C_MPS), abs=1e-5)
    # a satellite clock ahead shortens the pseudorange: it sent its chips too early
    early = row.copy()
    early[satellites.AF0] += 1e-6
    assert pseudorange(early, TOW, R0, np.zeros(3), 0.0, 0.0)[0] - base == pytest.approx(
        -299.792458, abs=1e-7
    )


def test_predict_channels_is_pseudorange_of_each():
    n = len(ROWS)
    rho, rate, u = np.empty(n), np.empty(n), np.empty((n, 3))
    for t in (0.0, 17.3, 59.99, 60.01, 110.0):
        predict_channels(arcs(ROWS, TOW, TOW + 110.0), TOW + t, R0, V0, 10.0, -2.0, rho, rate, u)
        for k in range(n):
            expected = pseudorange(ROWS[k], TOW + t, R0, V0, 10.0, -2.0)
            # the orbit's own rounding, a few units of 2^-53 at 2.7e7 m and 3e3 m/s
            assert rho[k] == pytest.approx(expected[0], rel=0, abs=5e-8)
            assert rate[k] == pytest.approx(expected[1], rel=0, abs=2e-9)
            np.testing.assert_allclose(u[k], expected[2:], rtol=0, atol=4e-15)


def smooth(t: float) -> tuple[np.ndarray, np.ndarray]:
    """100 m/s^2 at 3 rad/s across the flight."""
    size, w = 100.0 / 9.0, 3.0
    r = R0 + V0 * t + size * (np.sin(w * t) * NORTH + np.cos(w * t) * UP)
    return r, V0 + size * w * (np.cos(w * t) * NORTH - np.sin(w * t) * UP)


def jump(t: float) -> tuple[np.ndarray, np.ndarray]:
    """0 to 100 m/s^2 upwards when the clock of `world` reads 0.1 s, a node."""
    late = max(t - (0.1 - 503.0 / C_MPS), 0.0)
    return R0 + V0 * t + 50.0 * late**2 * UP, V0 + 100.0 * late * UP


def world(motion, n_node: int = 41, start_tow_s: float = TOW, **change) -> SignalState:
    t = np.arange(n_node) * 5e-3
    clock_m = 500.0 + 30.0 * t
    nodes = [motion(x - b / C_MPS) for x, b in zip(t, clock_m, strict=True)]
    first, n_symbol = symbol_span(start_tow_s, t)
    arguments = {
        "rows": ROWS,
        "start_tow_s": start_tow_s,
        "t_s": t,
        "r_antenna": np.array([r for r, _ in nodes]),
        "v_antenna": np.array([v for _, v in nodes]),
        "clock_m": clock_m,
        "clock_rate_mps": np.full(n_node, 30.0),
        "cn0_dbhz": np.full(len(ROWS), 45.0),
        "symbols": np.ones((len(ROWS), n_symbol), dtype=np.int8),
        "first_symbol": first,
    } | change
    return signal_state(**arguments)


@pytest.mark.parametrize("motion", [smooth, jump])
def test_cubics_follow_the_pseudorange_between_nodes(motion):
    state = world(motion)
    for t in (0.0012, 0.0525, 0.0988, 0.1009, 0.1025, 0.1999):
        p = int(t / 5e-3)
        powers = (t - state.t_s[p]) ** np.arange(4)
        clock_m = 500.0 + 30.0 * t
        r, v = motion(t - clock_m / C_MPS)
        rho, rate = np.array([pseudorange(row, TOW + t, r, v, clock_m, 30.0)[:2] for row in ROWS]).T
        carrier = state.carrier_phase_cycles[:, p] @ powers
        np.testing.assert_allclose(-carrier * C_MPS / GPS_L1_HZ, rho, rtol=0, atol=1e-6)
        code = state.code_phase_chips[:, p] @ powers
        sent = code_phase_origin(TOW) + CA_CHIP_RATE_HZ * t - code
        np.testing.assert_allclose(sent * C_MPS / CA_CHIP_RATE_HZ, rho, rtol=0, atol=1e-6)
        # Doppler: -rho_dot f / c; the slope between nodes carries 1.5 / h times the rounding of
        # the time of week at both ends, 0.03 ns x 800 m/s
        slope = state.carrier_phase_cycles[:, p, 1:] @ (powers[:3] * [1.0, 2.0, 3.0])
        np.testing.assert_allclose(-slope * C_MPS / GPS_L1_HZ, rate, rtol=0, atol=1.5e-5)


def test_pieces_join():
    state = world(smooth)
    powers = 5e-3 ** np.arange(4)
    for cubic in (state.carrier_phase_cycles, state.code_phase_chips):
        end = cubic[:, :-1] @ powers
        np.testing.assert_allclose(end, cubic[:, 1:, 0], rtol=0, atol=1e-7)
        slope = cubic[:, :-1, 1:] @ (powers[:3] * [1.0, 2.0, 3.0])
        np.testing.assert_allclose(slope, cubic[:, 1:, 1], rtol=0, atol=1e-7)


def test_approaching_satellite_has_positive_doppler_and_receding_one_slips():
    # static antenna without clock error: the range alone, from the orbit's own geometry
    t = np.arange(5) * 5e-3
    state = world(
        lambda _: (R0, np.zeros(3)),
        5,
        clock_m=np.zeros(5),
        clock_rate_mps=np.zeros(5),
    )
    for k, row in enumerate(ROWS):
        early, late = (np.linalg.norm(np.array(orbit(row, TOW + x)[:3]) - R0) for x in (-1.0, 1.0))
        approaching = early > late
        doppler = state.carrier_phase_cycles[k, 0, 1]
        phase = state.carrier_phase_cycles[k, :, 0]
        assert (doppler > 0) == approaching
        assert (phase[-1] > phase[0]) == approaching
        # the code of a receding satellite falls behind the nominal chip rate
        slip = state.code_phase_chips[k, :, 0] - CA_CHIP_RATE_HZ * t[:-1]
        assert (slip[-1] > slip[0]) == approaching
        assert doppler == pytest.approx((early - late) / 2 * GPS_L1_HZ / C_MPS, abs=1.0)
        # code and carrier Doppler are in the ratio 1540
        code_doppler = state.code_phase_chips[k, 0, 1] - CA_CHIP_RATE_HZ
        assert doppler == pytest.approx(1540 * code_doppler, abs=1e-6)


@pytest.mark.parametrize("start", [TOW, TOW + 0.0137])
def test_code_phase_is_the_satellites_clock_at_transmission(start):
    # chips are sent at multiples of 1/f of the satellite's own time, a data bit every 20 ms of it
    # (IS-GPS-200 3.3.2.2, 3.3.4): bit number and chip follow from t_tx + b_sv
    state = world(smooth, start_tow_s=start)
    for k, row in enumerate(ROWS):
        for p in (0, 17):
            t = float(state.t_s[p])
            gps = start + t - (500.0 + 30.0 * t) / C_MPS
            tau, _ = inertial_light_time(row, gps, smooth(gps - start)[0])
            satellite_time = gps - tau + orbit(row, gps - tau)[6]
            bits = satellite_time * 50.0 - np.floor(start * 50.0)
            # 1e-4 chip = 0.1 ns, the rounding of a time of week
            assert state.code_phase_chips[k, p, 0] == pytest.approx(
                bits * CHIPS_PER_SYMBOL, abs=3e-4, rel=0
            )


@pytest.mark.nojit
def test_origin_counts_from_the_data_bit():
    assert code_phase_origin(475_220.0) == 0.0
    assert code_phase_origin(475_220.02) == pytest.approx(0.0, abs=1e-3)
    assert code_phase_origin(0.013) == pytest.approx(13 * 1023.0, abs=1e-9)
    # L5 Q: the 20 ms of its whole code; L1C pilot: an overlay chip of 10 ms; L2 CL: 1.5 s
    of = nominal([GPS_L1CA, GPS_L5Q, GPS_L1CP, GPS_L2CL])
    expected = [13 * 1023.0, 13 * 10_230.0, 3 * 1023.0, (20.013 - 19.5) * 511_500.0]
    np.testing.assert_allclose(code_phase_origin(20.013, of), expected, atol=1e-6)


def test_symbols_must_cover_the_run():
    t = np.arange(41) * 5e-3
    first, n = symbol_span(TOW, t)
    state = world(smooth)
    numbers = np.floor(state.code_phase_chips[..., 0] / CHIPS_PER_SYMBOL)
    assert first <= numbers.min()
    assert numbers.max() < first + n
    low, high = int(numbers.min()), int(numbers.max())
    short = np.ones((len(ROWS), high - low), dtype=np.int8)
    with pytest.raises(ValueError, match=f"the run needs {low} to {high}"):
        world(smooth, symbols=short, first_symbol=low)
    with pytest.raises(ValueError, match=f"symbols cover {low + 1} to"):
        world(smooth, first_symbol=low + 1)


def test_cn0_and_masks_per_channel_piece_and_node():
    n = len(ROWS)
    per_node = np.tile(np.linspace(40.0, 50.0, 41), (n, 1))
    mask = np.ones((n, 41), dtype=bool)
    mask[3, 10] = False
    state = world(smooth, cn0_dbhz=per_node, valid=mask)
    np.testing.assert_allclose(state.cn0_dbhz[0, :2], [40.125, 40.375])
    expected = np.ones((n, 40), dtype=bool)
    expected[3, 9:11] = False
    np.testing.assert_array_equal(state.valid, expected)
    np.testing.assert_array_equal(world(smooth, valid=expected).valid, expected)
    assert world(smooth).valid.all()
    one = np.arange(n) != 2
    np.testing.assert_array_equal(world(smooth, valid=one).valid[:, 5], one)
    # an unseen channel needs no C/N0
    unseen = np.where(one, 45.0, np.nan)
    assert np.isnan(world(smooth, valid=one, cn0_dbhz=unseen).cn0_dbhz[2]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t_s": np.arange(41) * 6e-3}, "t_s has steps of 0.006 s"),
        ({"t_s": np.zeros(1)}, "t_s has shape"),
        ({"t_s": np.cumsum(np.tile([4e-3, 5e-3], 21))[:41]}, "t_s is not uniform"),
        ({"rows": ROWS[:, :5]}, r"rows has shape \(13, 5\)"),
        ({"r_antenna": np.zeros((40, 3))}, r"r_antenna has shape \(40, 3\), expected \(41, 3\)"),
        ({"v_antenna": np.full((41, 3), np.nan)}, "v_antenna contains a number that is not"),
        ({"clock_m": np.zeros(4)}, "clock_m has shape"),
        ({"cn0_dbhz": np.zeros(4)}, "cn0_dbhz has shape"),
        ({"cn0_dbhz": np.full(13, np.nan)}, "cn0_dbhz contains a number that is not finite"),
        ({"valid": np.ones((13, 3), dtype=bool)}, "valid has shape"),
        ({"symbols": np.zeros((13, 30), dtype=np.int8)}, "other than"),
        ({"symbols": np.ones((2, 30), dtype=np.int8)}, "symbols has shape"),
    ],
)
def test_bad_input_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        world(smooth, **change)


@pytest.mark.parametrize(
    ("latitude", "longitude", "height"),
    [(39.9, 116.4, 8000.0), (-75.0, -20.0, 0.0), (0.0, 180.0, 2e4), (89.99, 45.0, 4e5)],
)
def test_elevation_and_azimuth_of_geodetic_directions(latitude, longitude, height):
    lat, lon = np.radians([latitude, longitude])
    r = ecef(lat, lon, height)
    # directions by differences of the geodetic coordinates themselves
    step = 1e-5
    north = ecef(lat + step, lon, height) - ecef(lat - step, lon, height)
    east = ecef(lat, lon + step, height) - ecef(lat, lon - step, height)
    up = ecef(lat, lon, height + 1e3) - r
    north, east, up = (x / np.linalg.norm(x) for x in (north, east, up))
    for elevation, azimuth in np.radians([(10, 0), (35, 90), (-4, 200), (60, 300)]):
        u = np.sin(elevation) * up + np.cos(elevation) * (
            np.cos(azimuth) * north + np.sin(azimuth) * east
        )
        el, az = elevation_azimuth(r, u)
        assert el == pytest.approx(elevation, abs=1e-9)
        assert np.cos(az - azimuth) == pytest.approx(1.0, abs=1e-15 * 10)
        assert np.sin(az - azimuth) == pytest.approx(0.0, abs=1e-6 if latitude > 89 else 1e-9)
    assert elevation_azimuth(r, up)[0] == pytest.approx(np.pi / 2, abs=1e-7)


def test_elevation_of_arrays_and_at_the_pole():
    u = np.array([UP, NORTH, EAST])
    el, az = elevation_azimuth(np.tile(R0, (3, 1)), u)
    np.testing.assert_allclose(el, [np.pi / 2, 0.0, 0.0], atol=1e-7)
    np.testing.assert_allclose(az[1:] + 1e-12, [0.0, np.pi / 2], atol=1e-9)
    el, _ = elevation_azimuth(np.array([0.0, 0.0, 6_356_752.3]), np.array([0.0, 0.0, 1.0]))
    assert el == pytest.approx(np.pi / 2, abs=1e-12)


def test_signals_of_one_satellite_share_one_delay():
    # c (time of transmission by the code) and c (carrier phase / f) are the same pseudorange for
    # all signals of a satellite: no ionosphere, no group delays between signals
    signals = [GPS_L1CA, GPS_L5Q, GPS_L1CP, GPS_L2CL]
    of = nominal(signals)
    t = np.arange(41) * 5e-3
    first, n_symbol = symbol_span(TOW, t, of=of)
    ones = np.ones((4, n_symbol), dtype=np.int8)
    change = {"rows": ROWS[[2, 2, 2, 2]], "cn0_dbhz": np.full(4, 45.0), "of": of}
    state = world(smooth, symbols=ones, first_symbol=first, **change)
    alone = world(smooth)
    np.testing.assert_array_equal(state.code_phase_chips[0], alone.code_phase_chips[2])
    np.testing.assert_array_equal(state.carrier_phase_cycles[0], alone.carrier_phase_cycles[2])
    rho = -C_MPS / GPS_L1_HZ * alone.carrier_phase_cycles[2]
    origin = code_phase_origin(TOW, of)
    for k, signal in enumerate(signals):
        by_carrier = -C_MPS / signal.carrier_hz * state.carrier_phase_cycles[k]
        np.testing.assert_allclose(by_carrier, rho, rtol=1e-14, atol=1e-12)
        sent = origin[k] + signal.chip_rate_hz * t[:-1] - state.code_phase_chips[k, :, 0]
        by_code = C_MPS / signal.chip_rate_hz * sent
        np.testing.assert_allclose(by_code, rho[:, 0], rtol=0, atol=1e-5)
    # a symbol number in the range that any channel can receive, for each
    numbers = state.code_phase_chips[..., 0] / of.symbol_chips[:, None]
    assert first <= np.floor(numbers.min())
    assert np.floor(numbers.max()) < first + n_symbol
    low = int(np.floor(numbers.min()))
    with pytest.raises(ValueError, match=f"the run needs {low} to"):
        world(smooth, **change, symbols=ones[:, :1], first_symbol=low + 1)
    with pytest.raises(ValueError, match="of has 4 channels, expected"):
        world(smooth, of=of)
