"""IF files for other receivers: they are what their truth says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import sigmf
import xarray
from scipy.special import erfc

from signals import satellites
from signals.codes import GPS_L1CA
from signals.constants import C_MPS, GPS_L1_HZ, OMEGA_EARTH
from signals.correlator import SampleCorrelator
from signals.lnav_words import find_subframes
from signals.navigation_message import decode_navigation
from signals.nco import Nco, Taps
from signals.sample_formats import file_format
from signals.sigmf_files import open_recording
from ultratight import generate
from ultratight.__main__ import main

DBHZ = 45.0
BIT_CHIPS = 20_460
FEW = ["--set", "prns=[2, 6, 17, 28]"]


class Made(NamedTuple):
    told: dict[str, Any]
    truth: xarray.Dataset


@pytest.fixture
def make(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Made]:
    def call(*words: object, name: str = "file") -> Made:
        arguments = ["generate", *words, "--out", tmp_path / name, "--json", "--quiet"]
        assert main([str(w) for w in arguments]) == 0
        told = json.loads(capsys.readouterr().out)
        with xarray.open_dataset(told["truth"], engine="h5netcdf") as truth:
            return Made(told, truth.load())

    return call


def tracked(made: Made) -> tuple[Taps, np.ndarray]:
    """Taps of 20 ms of every satellite, steered by the truth alone, and their data bits."""
    truth = made.truth
    last = int(made.told["duration_s"] / 0.02)
    t = truth.t_s.values[: last + 1]
    code, carrier = truth.code_phase_chips.values, truth.carrier_phase_cycles.values
    doppler, n = truth.doppler_hz.values, len(made.told["prns"])
    nco = Nco(
        t,
        code[:last],
        np.diff(code[: last + 1], axis=0) / 0.02,
        carrier[:last],
        doppler[:last],
        np.diff(doppler[: last + 1], axis=0) / 0.02,
        np.full(n, BIT_CHIPS),
        np.ones(n, bool),
    )
    chips = np.stack([GPS_L1CA.chips(prn) for prn in made.told["prns"]])
    taps = SampleCorrelator(open_recording(made.told["samples"]), chips, np.zeros(1))(nco)
    index = taps.number - int(truth.bit.values[0])
    return taps, truth.data_bits.values[taps.channel, index]


# -- the samples are what the truth says ---------------------------------------------------------

FORMATS = {
    "ci8": ("--if-hz", 0),
    "cf32": ("--if-hz", -250e3),
    "ri8": ("--if-hz", 1.2e6),
    "ci16": ("--rms", 300),
    "ri16": ("--if-hz", 1.2e6),
    "ci2p": ("--if-hz", 1e5),
    "ri2p": ("--if-hz", 1.2e6),
    "cu8": ("--if-hz", 0),
    "ci1pm": ("--if-hz", 1e5),
    "ri1p": ("--if-hz", 1.2e6),
    "ci4ptm": ("--if-hz", 1e5),
}
"""Format: an option"""


STEPS = {1: 0.0, 2: 0.9957, 4: 0.3352}
"""Bits: between thresholds, in sigma; Max (1960)"""


def gain_of_few_bits(bits: int, satellites: float) -> float:
    """Amplitude that odd levels of so many bits leave, over that of the noise alone before them.

    Bussgang (1952): a weak signal in Gaussian noise of variance s^2 passes with the mean slope of
    the steps, sqrt(2/pi) (1 + 2 sum exp(-T_k^2 / 2 s^2)) / s; ``satellites`` is their power over
    the noise's, which for many of them acts as more noise.
    """
    k, s2 = np.arange(1, 2 ** (bits - 1)), 1.0 + satellites
    slope = np.sqrt(2.0 / np.pi / s2) * (
        1.0 + 2.0 * np.exp(-((k * STEPS[bits]) ** 2) / 2.0 / s2).sum()
    )
    return slope / np.sqrt(1.0 + (8.0 * k * erfc(k * STEPS[bits] / np.sqrt(2.0))).sum())


@pytest.mark.parametrize(("bits", "loss_db"), [(1, 1.9612), (2, 0.5495), (4, 0.0504)])
def test_the_loss_of_few_bits_is_the_published_one(bits: int, loss_db: float) -> None:
    """Max (1960), theory/quantization_loss.csv; two bits: Kaplan & Hegarty, 3rd ed., ch. 8."""
    assert -20.0 * np.log10(gain_of_few_bits(bits, 0.0)) == pytest.approx(loss_db, abs=0.0002)


@pytest.mark.parametrize("form", FORMATS)
def test_the_truth_tracks_the_file(make: Callable[..., Made], form: str) -> None:
    """Prompt on the real axis, at sqrt(2 C/N0 T) and unit noise, in every format.

    Over 4 satellites and 2 s, some 390 bits at an amplitude of 35.6: one standard deviation of the
    mean is 0.05, that is 0.012 dB or 1.4 mrad.
    """
    option, value = FORMATS[form]
    made = make("static", "--duration", 2, "--format", form, option, value, *FEW)
    assert (made.told["format"], made.told["prns"]) == (form, [2, 6, 17, 28])
    taps, bits = tracked(made)
    iq = taps.iq[:, 0] * bits
    n = iq.size
    assert n >= 4 * 97
    expected = np.sqrt(2.0 * 10 ** (DBHZ / 10.0) * 0.02)
    if packing := file_format(form).packing:
        satellites = (8.0 if form.startswith("r") else 4.0) * 10 ** (DBHZ / 10.0) / 4e6
        expected *= gain_of_few_bits(packing.bits, satellites)
    sigma = 1.0 / np.sqrt(n)
    measured_db = 20.0 * np.log10(iq.real.mean() / expected)
    # beside the noise: 0.02 dB for what four satellites are less Gaussian than noise
    assert measured_db == pytest.approx(0.0, abs=8.7 * 4.0 * sigma / expected + 0.02)
    assert iq.imag.mean() == pytest.approx(0.0, abs=4.0 * sigma + 0.002 * expected)
    for channel in range(4):
        mine = iq[taps.channel == channel]
        assert mine.real.mean() == pytest.approx(expected, rel=0.015)
        assert abs(np.angle(mine.mean())) < 5.0 / (expected * np.sqrt(mine.size)) + 0.002


def test_satellites_may_differ_and_the_noise_may_be_scaled(make: Callable[..., Made]) -> None:
    weak = ["--set", 'channel.cn0_by_prn_dbhz={"G06"=39}', "--rms", 12]
    made = make("static", "--duration", 2, *FEW, *weak)
    taps, bits = tracked(made)
    level = [20.0 * np.log10((taps.iq[:, 0] * bits).real[taps.channel == c].mean()) for c in (0, 1)]
    # 97 bits: 4 sigma are 0.2 dB at 39 dB-Hz
    assert level[0] - level[1] == pytest.approx(6.0, abs=0.25)
    recording = open_recording(made.told["samples"])
    assert recording.sigma == 12.0
    assert recording.samples(0, 500_000).std() == pytest.approx(12.0, rel=0.03)


def test_doppler_is_positive_when_approaching(make: Callable[..., Made]) -> None:
    """Against the rate of the geometric distance from broadcast ephemerides, by differences."""
    made = make(
        "static", "--duration", 0.1, "--set", "clock.drift_mps=0", "--set", "clock.bias_m=0"
    )
    sky, truth, dt = satellites.embedded(), made.truth, 1.0
    r = truth.r_ea_e.values[0]
    for i, prn in enumerate(made.told["prns"]):
        tow = made.told["start_tow_s"] - 0.075 + np.array([-0.5, 0.5]) * dt
        before, after = np.linalg.norm(sky.at(2149, tow, prn)[0] - r, axis=1)
        expected = -(after - before) / dt * GPS_L1_HZ / C_MPS
        # 0.2 m/s of Sagnac and of the satellite's clock are a Hz
        assert truth.doppler_hz.values[0, i] == pytest.approx(expected, abs=2.0)
    assert np.ptp(truth.doppler_hz.values[0]) > 2_000.0  # both signs, and of some size


def test_code_phases_navigate(make: Callable[..., Made]) -> None:
    """A least-squares fix from the code phases, as any receiver would make it.

    The time of transmission is that of the bit edges; orbits and clocks are the ephemerides'.
    """
    made = make("static", "--duration", 0.5)
    told, truth, row = made.told, made.truth, 20
    t_rx = told["start_tow_s"] + truth.t_s.values[row]
    # bit 0 is under way at the start: 475220 s is a bit edge
    t_tx = told["start_tow_s"] + truth.code_phase_chips.values[row] / 1.023e6
    sky, x = satellites.embedded(), np.zeros(4)
    for _ in range(8):
        rows = []
        for prn, sent in zip(told["prns"], t_tx, strict=True):
            # code phase counts by the satellite's clock
            clock = sky.at(2149, sent, prn)[2]
            r, _, clock, _ = sky.at(2149, sent - clock, prn)
            turn = OMEGA_EARTH * np.linalg.norm(r - x[:3]) / C_MPS
            r = np.array([r[0] + turn * r[1], r[1] - turn * r[0], r[2]])
            away = x[:3] - r
            distance = np.linalg.norm(away)
            rho = C_MPS * (t_rx - sent + clock)
            rows.append([*away / distance, 1.0, rho - distance - x[3]])
        table = np.array(rows)
        x += np.linalg.lstsq(table[:, :4], table[:, 4], rcond=None)[0]
    assert np.linalg.norm(x[:3] - truth.r_ea_e.values[row]) < 0.05  # 0.1 ns of a day's double
    assert x[3] == pytest.approx(truth.clock_m.values[row], abs=0.05)
    assert told["position_lla"] == pytest.approx([39.9, 116.4, 50.0], abs=1e-6)


def test_the_data_bits_are_the_message_at_the_right_time() -> None:
    """What a receiver decodes are the ephemerides that made the orbits, at the time of the HOW."""
    scenario = generate.scenario_for("static", [], 40.0)
    world = generate.FileWorld(scenario, 1)
    first, bits = world.symbols
    decoded = decode_navigation(dict(zip(world.prn.tolist(), bits, strict=True)), 2149)
    prn, rows = decoded.select(2149, scenario.start_tow_s)
    assert prn.tolist() == world.prn.tolist()
    # RINEX has 12 digits
    np.testing.assert_allclose(rows, world.elements, rtol=5e-12, atol=1e-30)
    found = find_subframes(bits[0])
    assert len(found) == 5  # 40.2 s, 4.1 s of which come before the first
    for subframe in found:
        sent = scenario.start_tow_s + (first + subframe.first_bit) * 0.02
        assert sent == pytest.approx(subframe.tow_s, abs=1e-6)


def test_windows_leave_no_trace(make: Callable[..., Made]) -> None:
    """A longer file begins with the bits of a shorter one, and both with those of the world.

    The truth of one window or of the whole run differs by 1e-7 cycles (rounding of the orbit's
    arcs), which moves some samples in 1e6 over a rounding threshold.
    """
    short = make("static", "--duration", 1.31, *FEW, name="short")
    long = make("static", "--duration", 2.2, *FEW, name="long")
    a = np.fromfile(short.told["samples"], np.int8)
    b = np.fromfile(long.told["samples"], np.int8)
    assert a.size == 2 * 5_240_000
    np.testing.assert_array_equal(a, b[: a.size])
    scenario = generate.scenario_for("static", [FEW[1]], 2.2)
    whole = generate.World(scenario, 1).samples.samples(0, 8_800_000).reshape(-1)
    differ = whole != b
    assert differ.mean() < 1e-5
    assert np.abs(whole[differ].astype(int) - b[differ]).max(initial=0) <= 1


def test_the_atmosphere_delays_code_and_advances_carrier() -> None:
    on = ["atmosphere.ionosphere=true", "atmosphere.troposphere=true"]
    clear, iono, both = (
        generate.FileWorld(generate.scenario_for("static", changes, 1.0), 1).signal_between(0, 10)
        for changes in ([], on[:1], on)
    )
    code = (iono.code_phase_chips - clear.code_phase_chips)[..., 0] / 1.023e6 * C_MPS
    carrier = (iono.carrier_phase_cycles - clear.carrier_phase_cycles)[..., 0] / GPS_L1_HZ * C_MPS
    # 8 pm in China, some metres; the same size with opposite signs (IS-GPS-200 20.3.3.5.2.5)
    assert ((-code > 1.0) & (-code < 30.0)).all()
    np.testing.assert_allclose(carrier, -code, atol=1e-5)
    code = (both.code_phase_chips - iono.code_phase_chips)[..., 0] / 1.023e6 * C_MPS
    carrier = (both.carrier_phase_cycles - iono.carrier_phase_cycles)[..., 0] / GPS_L1_HZ * C_MPS
    # 2.4 m at the zenith of sea level, 6 times that at 10 degrees
    assert ((-code > 2.2) & (-code < 15.0)).all()
    np.testing.assert_allclose(carrier, code, atol=1e-5)
    for delayed in (iono, both):
        c = delayed.carrier_phase_cycles
        ends = c @ (0.005 ** np.arange(4))
        np.testing.assert_allclose(ends[:, :-1], c[:, 1:, 0], rtol=0.0, atol=1e-6)


# -- its description -----------------------------------------------------------------------------


def test_sigmf_by_its_own_library(make: Callable[..., Made]) -> None:
    made = make(
        "static", "--duration", 0.2, "--rate", 5e6, "--if-hz", -1e5, "--start", "2149:475230.5"
    )
    told = made.told
    assert (told["rate_hz"], told["if_hz"]) == (5e6, -1e5)
    assert (told["start_week"], told["start_tow_s"]) == (2149, 475_230.5)
    assert told["n_samples"] == 1_000_000
    read = sigmf.sigmffile.fromfile(told["metadata"])
    read.validate()
    assert read.get_global_field("core:sha512") == read.calculate_hash() == told["sha512"]
    assert read.get_global_field("ultratight:atmosphere") == []
    capture = read.get_captures()[0]
    assert capture["core:frequency"] == GPS_L1_HZ + 1e5
    assert capture["core:datetime"] == "2021-03-19T12:00:12.500000Z"
    assert read.get_annotations()[0]["core:freq_upper_edge"] == GPS_L1_HZ + 1.023e6
    folder = Path(told["samples"]).parent
    names = sorted(p.name for p in folder.iterdir())
    assert names == ["file.sigmf-data", "file.sigmf-meta", "file.truth.nc"]
    truth = made.truth
    assert truth.attrs["format"] == "ultratight-if-truth-1"
    assert all(truth[v].attrs["units"] for v in truth.data_vars)
    assert truth.channel.values.tolist() == [f"G{p:02d}:L1CA" for p in told["prns"]]


def test_info_tells_what_is_in_a_file(make: Callable[..., Made], capsys) -> None:
    told = make("static", "--duration", 0.1, "--format", "ci2p", *FEW).told
    assert main(["info", told["samples"], "--json"]) == 0
    seen = json.loads(capsys.readouterr().out)
    assert (seen["format"], seen["n_samples"], seen["rate_hz"]) == ("ci2p", 400_000, 4e6)
    assert list(seen["levels"]) == ["-3", "-1", "1", "3"]
    # beyond 0.9957 sigma lies 0.3194 of a normal distribution, half of it on each side
    assert seen["levels"]["3"] == pytest.approx(0.16, abs=0.01)
    assert seen["rms"][0] == pytest.approx(1.885, rel=0.02)
    assert main(["info", told["samples"]]) == 0
    assert "level -3             0.1" in capsys.readouterr().out
    assert main(["info", told["samples"].replace("file", "none")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


# -- motion --------------------------------------------------------------------------------------


def test_a_trajectory_of_ones_own(make: Callable[..., Made], tmp_path: Path) -> None:
    """A circle of 100 m in 20 s: the file's truth goes through the points, and is tracked."""
    t = np.arange(0.0, 3.01, 0.5)
    east, north = 100 * np.sin(2 * np.pi * t / 20), 100 * (1 - np.cos(2 * np.pi * t / 20))
    lat, lon = 39.9 + np.degrees(north / 6_367_000), 116.4 + np.degrees(east / 4_893_000)
    lines = [f"{a:.3f},{b:.12f},{c:.12f},55.0" for a, b, c in zip(t, lat, lon, strict=True)]
    path = tmp_path / "circle.csv"
    path.write_text("\n".join(["t_s,lat_deg,lon_deg,h_m", *lines]) + "\n")
    zero = ["--set", "clock.bias_m=0", "--set", "clock.drift_mps=0", "--set", "clock.model=ideal"]
    made = make("jump-1", "--duration", 2.5, "--trajectory", path, *FEW, *zero)
    lla = made.truth.lla.values[::25]
    np.testing.assert_allclose(np.degrees(lla[:, 0]), lat[: len(lla)], rtol=0, atol=1e-10)
    np.testing.assert_allclose(lla[:, 2], 55.0, atol=1e-5)
    speed = np.linalg.norm(made.truth.v_ea_e.values, axis=1)
    np.testing.assert_allclose(speed, 10.0 * np.pi, rtol=0.01)
    taps, bits = tracked(made)
    iq = taps.iq[:, 0] * bits
    assert abs(np.angle(iq.mean())) < 0.01


@pytest.mark.parametrize("imu", [True, False])
def test_a_trajectory_with_an_imu_is_said_to_have_no_attitude(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], imu: bool
) -> None:
    path = tmp_path / "east.csv"
    path.write_text("t_s,lat_deg,lon_deg,h_m\n" + "".join(f"{t},40,{t}e-4,0\n" for t in range(4)))
    words = ["generate", "jump-1", "--trajectory", str(path), "--duration", "0.1", *FEW]
    assert main([*words, "--out", str(tmp_path / "x"), *(["--imu"] if imu else [])]) == 0
    err = capsys.readouterr().err
    assert ("north-east-down of the first point; give track --attitude 0,0,0" in err) == imu


def test_satellites_set_and_rise() -> None:
    """An hour: some are below the mask at one end and up at the other, and off meanwhile."""
    s = generate.scenario_for("static", ["constellation=nominal-24"], 3_600.0)
    world = generate.FileWorld(s, 1)
    mask = np.radians(s.mask_deg)
    up = world.look_all(np.array([0.0, 3_600.0]))[0] >= mask
    assert (up[0] & ~up[1]).any()
    assert (~up[0] & up[1]).any()
    late = int(np.flatnonzero(~up[0] & up[1])[0])
    assert not world.signal_between(0, 4, up[0]).valid[late].any()
    assert world.signal_between(0, 4, up[1]).valid[late].all()


# -- bad input -----------------------------------------------------------------------------------

BAD = {
    "no duration": ("--out x", "Missing option '--duration'"),
    "duration 0": ("--duration 0 --out x", "--duration: 0 given, expected more than 0"),
    "duration nan": ("--duration nan --out x", "--duration: nan given"),
    "format": ("--duration 1 --out x --format ci4", "format: 'ci4' given, expected one of ci8"),
    "start": ("--duration 1 --out x --start monday", "--start: monday given, expected WEEK:TOW"),
    "start alone": ("--duration 1 --out x --start 2149", "expected WEEK:TOW, e.g. 2149:475220"),
    "other day": ("--duration 1 --out x --start 2200:0", "no satellite has a healthy ephemeris"),
    "rate": ("--duration 1 --out x --rate 1e6", "at least the chip rate"),
    "IF": ("--duration 1 --out x --if-hz 3e6", "less than half the sample rate"),
    "real without IF": ("--duration 1 --out x --format ri8", "ri8: if_hz is 0.0: expected above 0"),
    "rms": ("--duration 1 --out x --rms 0.1", "ci8: sigma is 0.1: expected 1 to 40"),
    "rms of 2 bits": (
        "--duration 1 --out x --rms 1 --format ci2p",
        "--rms: 1 given, expected none: ci2p has fixed levels",
    ),
    "folder": ("--duration 1 --out no-such/x", "no such folder no-such"),
    "no trajectory": ("--duration 1 --out x --trajectory no.csv", 'trajectory: "no.csv" given'),
    "too long": ("--duration 16000 --out x", "is then 2 h from its toe"),
    "mask": ("--duration 1 --out x --set mask_deg=89.9", "no satellite of embedded at or above"),
    "unknown key": ("--duration 1 --out x --set cn0=3", "cn0: unknown key"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_line_and_exit_code_2(
    kind: str, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words, expected = BAD[kind]
    code = main(["generate", "static", *words.split(), "--quiet"])
    said = capsys.readouterr()
    assert (code, said.out, said.err.count("\n")) == (2, "", 1)
    assert expected in said.err
    assert list(tmp_path.iterdir()) == []
