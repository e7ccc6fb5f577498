"""The ultra-tight loop on signals other than L1 C/A: it pulls in, hands over and is consistent.

An IMU that obeys the filter's model, as in `test_closed_loop`: the innovations of each kind of
measurement then have the covariance that the filter says.
"""

from pathlib import Path

import numpy as np
import pytest

import ultratight
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
    assert run.summary["position_rms_end_m"] < limit_m
    assert run.summary["velocity_rms_mps"]["end"] < 0.01
    late = run.t_s > 5.0
    nis = run["nis"][late].sum() / run["n_measurement"][late].sum()
    # numbers of chi-square: 1 +- 4 sqrt(2 / n)
    n = run["n_measurement"][late].sum()
    assert nis == pytest.approx(1.0, abs=4 * np.sqrt(2 / n) + 0.03), nis


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
            'correlator.kind: "samples" with signals L5Q given, expected "model", or L1CA alone',
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
