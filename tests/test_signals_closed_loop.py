"""The ultra-tight loop on signals other than L1 C/A: it pulls in, hands over and is consistent.

An IMU that obeys the filter's model, as in `test_closed_loop`: the innovations of each kind of
measurement then have the covariance that the filter says.
"""

from pathlib import Path

import numpy as np
import pytest

import ultratight
from signals.nco import Nco
from ultratight.scenario import InvalidInput
from ultratight.tracking.knows import Knows
from ultratight.world import World

CODES = Path(__file__).parents[2] / "shared" / "data" / "codes" / "galileo_e1_memory_codes.csv"
MATCHED = {
    "imu.accel_scale_factor_ppm": [0.0, 0.0, 0.0], "imu.grade": "matched", "imu.lag_s": 0.0,
    "receiver.filter": "qkf", "duration_s": 12.0,
}  # fmt: skip
GALILEO = {"constellation": "galileo-24", "galileo_codes": str(CODES)}
needs_codes = pytest.mark.skipif(
    not CODES.exists(), reason="needs the reference data folder beside the repository"
)


# above the sub-chip rates of L5, 10.23 MHz, and of TMBOC and CBOC, 12.276 MHz
SAMPLES = {"correlator.kind": "samples", "front_end.sample_rate_hz": 12.5e6}


def scenario(signals, **changes):
    return ultratight.load("uniform", MATCHED | {"signals": signals} | changes)


# (signals, changes, position error [m] that a converged run stays below): code noise scales with
# the chip and with R's slope, 29 m for L5 against 293 m
CASES = [
    pytest.param(["L5Q"], {}, 0.3, id="L5Q"),
    pytest.param(["L1CP"], {"correlator.spacing_chips": 1 / 24}, 1.0, id="L1CP"),
    pytest.param(["L1CP", "L5Q"], {"correlator.spacing_chips": 0.2}, 0.3, id="both"),
    pytest.param(
        ["E1C"], GALILEO | {"correlator.spacing_chips": 1 / 24}, 1.0, id="E1C", marks=needs_codes
    ),
    pytest.param(["L5Q"], SAMPLES, 0.3, id="L5Q from samples", marks=pytest.mark.slow),
    pytest.param(
        ["L1CP"],
        SAMPLES | {"correlator.spacing_chips": 1 / 24},
        1.0,
        id="L1CP from samples",
        marks=pytest.mark.slow,
    ),
    pytest.param(
        ["E1C"],
        GALILEO | SAMPLES | {"correlator.spacing_chips": 1 / 24},
        1.0,
        id="E1C from samples",
        marks=[pytest.mark.slow, needs_codes],
    ),
]


@pytest.mark.parametrize(("signals", "changes", "limit_m"), CASES)
def test_a_pilot_needs_no_data_bits_and_is_tracked(signals, changes, limit_m):
    chosen = scenario(signals, **{"receiver.knows.data_bits": False}, **changes)
    run = ultratight.run(chosen, 3)
    assert run.summary["converged"]
    assert run.summary["fall_backs"] == 0
    assert not any(run.summary["lost_lock_s"].values())
    assert [e.kind for e in run.events] == ["hand-over"]
    assert {name.partition(":")[2] for name in run["channel"]} == set(signals)
    assert len(run["channel"]) == len(signals) * run.summary["n_satellites"]
    assert run.summary["position_rms_end_m"] < limit_m
    assert run.summary["velocity_rms_mps"]["end"] < 0.01
    late = run.t_s > 5.0
    nis = run["nis"][late].sum() / run["n_measurement"][late].sum()
    # numbers of chi-square: 1 +- 4 sqrt(2 / n)
    n = run["n_measurement"][late].sum()
    assert nis == pytest.approx(1.0, abs=4 * np.sqrt(2 / n) + 0.03), nis


def test_samples_hold_all_signals_of_a_carrier():
    """Replicas that follow the truth find each signal with its own symbols, at sqrt(2 C/N0 T).

    A tap's noise has variance 1 and, as chips of the others are signs at random, at most
    2/3 C/N0 / f_c for each of them (Parkinson & Spilker, vol. 1, ch. 3).
    """
    changes = SAMPLES | {"correlator.spacing_chips": 0.2, "cn0_dbhz": 45.0, "duration_s": 0.4}
    chosen = scenario(["L1CA", "L1CP"], **changes, **{"imu.rate_hz": 100.0})
    w = World(chosen, 3)
    state, n = w.signal, len(w.rows)
    code, carrier = (
        np.swapaxes(x[:, :80], 0, 1) for x in (state.code_phase_chips, state.carrier_phase_cycles)
    )
    nco = Nco(
        state.t_s[:81], code[..., 0], code[..., 1], carrier[..., 0], carrier[..., 1],
        2.0 * carrier[..., 2], w.channels.dump_chips, np.ones(n, bool),
    )  # fmt: skip
    taps = w.correlator()(nco)
    symbol = taps.number * w.channels.dump_chips[taps.channel]
    symbol = symbol // w.channels.symbol_chips[taps.channel] - state.first_symbol
    amplitude = np.sqrt(2.0 * 10**4.5 * (taps.t_end_s - taps.t_start_s))
    prompt = taps.iq[:, 1] * state.symbols[taps.channel, symbol] / amplitude
    variance = 1.0 + (n - 1) * 2.0 / 3.0 * 10**4.5 / 1.023e6
    for i in range(n):
        mine = prompt[taps.channel == i]
        assert len(mine) >= 38
        sigma = np.sqrt(variance / len(mine)) / amplitude.min()
        assert mine.mean().real == pytest.approx(1.0, abs=4.0 * sigma)
        assert mine.mean().imag == pytest.approx(0.0, abs=4.0 * sigma)
    assert {row.label for row in w.rows} == {"L1CA", "L1CP"}


def test_doppler_counts_at_the_least_sample_rate():
    changes = SAMPLES | {"correlator.spacing_chips": 0.2, "front_end.sample_rate_hz": 12.276e6}
    with pytest.raises(
        InvalidInput, match=r"front_end: sample_rate_hz is 12276000\.0: expected >="
    ):
        ultratight.run(scenario(["L1CP"], **changes), 3)


def test_data_of_a_signal_do_not_depend_on_the_others():
    alone = World(scenario(["L1CA"]), 3)
    both = World(scenario(["L1CA", "L5Q"]), 3)
    n = alone.prn.size
    assert both.names[:n] == alone.names
    assert both.names[n:] == [name.replace("L1CA", "L5Q") for name in alone.names]
    np.testing.assert_array_equal(both.elements[n:], alone.elements)
    shift = alone.signal.first_symbol - both.signal.first_symbol
    width = alone.signal.symbols.shape[1]
    np.testing.assert_array_equal(
        both.signal.symbols[:n, shift : shift + width], alone.signal.symbols
    )


def test_what_a_receiver_knows_of_its_signals_survives_a_file(tmp_path):
    knows = World(scenario(["L1CP"], **{"correlator.spacing_chips": 0.2}), 3).knows
    knows.save(tmp_path / "knows.npz")
    loaded = Knows.load(tmp_path / "knows.npz")
    for a, b in zip(knows.channels, loaded.channels, strict=True):
        np.testing.assert_array_equal(a, b)
    with np.load(tmp_path / "knows.npz") as data:
        part = {k: data[k] for k in data.files if k != "channels.overlay"}
    np.savez(tmp_path / "part.npz", **part)
    with pytest.raises(ValueError, match=r"entries \['channels.overlay'\] are missing"):
        Knows.load(tmp_path / "part.npz")


def test_ionosphere_is_that_of_the_carrier():
    # IS-GPS-200 20.3.3.3.3.2: the delay of L5 is (f_L1 / f_L5)^2 that of L1, late code, early phase
    on = {"atmosphere.ionosphere": True}
    delays = []
    for changes in ({}, on):
        w = World(scenario(["L1CA", "L5Q"], **changes), 3)
        f, n = w.channels, w.prn.size // 2
        code = w.signal.code_phase_chips[:, 0, 0] / f.chip_rate_hz * 299_792_458.0
        phase = w.signal.carrier_phase_cycles[:, 0, 0] * f.wavelength_m
        delays.append((code, phase))
    late, early = delays[0][0] - delays[1][0], delays[1][1] - delays[0][1]
    assert (late > 1.0).all()
    np.testing.assert_allclose(late[n:] / late[:n], (1575.42 / 1176.45) ** 2, rtol=1e-5)
    np.testing.assert_allclose(early, late, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"signals": []}, "signals: nothing given, expected at least one signal"),
        ({"signals": ["L6"]}, 'signals[0]: "L6" given, expected one of'),
        ({"signals": ["L5Q", "L5Q"]}, "signals: L5Q, L5Q given, expected each signal once"),
        ({"signals": ["E5AQ"]}, 'signals: E5AQ given, expected signals of GPS with "embedded"'),
        (
            {"constellation": "galileo-24"},
            'signals: L1CA given, expected signals of Galileo with "galileo-24"',
        ),
        ({"signals": ["E1C"], "constellation": "galileo-24"}, "galileo_codes: nothing given"),
        (
            {"signals": ["L5Q"], "receiver.closure": "scalar"},
            'receiver.closure: "scalar" with signals L5Q given, expected "ultra-tight", or L1CA',
        ),
        (
            {"signals": ["L5Q"], "correlator.kind": "samples"},
            "front_end.sample_rate_hz: 4000000 given, expected at least the chip rate of L5Q, "
            "10230000",
        ),
        (
            {"signals": ["L1CA", "L1CD"], "correlator.spacing_chips": 0.2}
            | SAMPLES
            | {"front_end.sample_rate_hz": 2.04e6},
            "front_end.sample_rate_hz: 2040000 given, expected at least the sub-chip rate of L1CD, "
            "2046000",
        ),
        (
            {"signals": ["L1CP"], "correlator.spacing_chips": 0.2}
            | SAMPLES
            | {"front_end.sample_rate_hz": 12.2e6},
            "front_end.sample_rate_hz: 12200000 given, expected at least the sub-chip rate of "
            "L1CP, 12276000",
        ),
        (
            {"signals": ["L1CA", "L1CD", "L5Q"], "correlator.spacing_chips": 0.2} | SAMPLES,
            "signals: L1CA at 1575.42 MHz and L5Q at 1176.45 MHz given, expected one carrier in "
            'samples, or "model"',
        ),
        (
            {"signals": ["L1CD"], "correlator.spacing_chips": 0.6},
            "correlator.spacing_chips: 0.6 with L1CD given, expected a spacing at which late minus",
        ),
        ({"signals": ["L1CP"], "correlator.spacing_chips": 0.125}, "0.125 with L1CP given"),
        (
            {"signals": ["L5I"], "receiver.knows.data_bits": False},
            "receiver.measurement: ",
        ),
        ({"signals": ["L1CA", "L5I"], "data_bits": "lnav"}, "data_bits: "),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(changes, said):
    with pytest.raises(InvalidInput) as caught:
        ultratight.load("uniform", changes)
    assert len(caught.value.problems) == 1
    assert caught.value.problems[0].startswith(said) or said in caught.value.problems[0]


@needs_codes
def test_a_bad_file_of_memory_codes_is_named_with_its_line(tmp_path):
    text = CODES.read_text().splitlines()
    path = tmp_path / "codes.csv"
    path.write_text("\n".join([*text[:3], text[3][:-1]]))
    chosen = scenario(["E1C"], **GALILEO | {"galileo_codes": str(path)})
    with pytest.raises(InvalidInput, match=r"signals: .*codes\.csv line 4: 1022 digits, expected"):
        World(chosen, 1)
    path.unlink()
    with pytest.raises(InvalidInput, match=r"galileo_codes: .*no such file"):
        ultratight.load("uniform", {"signals": ["E1C"]} | GALILEO | {"galileo_codes": str(path)})
