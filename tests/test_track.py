"""`ultratight track`: from samples alone to prompts, bits and Dopplers that the truth confirms."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

from signals.lnav_words import find_subframes
from signals.recording import Recording
from signals.sigmf_files import open_recording
from ultratight.__main__ import main
from ultratight.tracking.acquisition import acquire
from ultratight.tracking.from_samples import track

PRNS = [2, 6, 17, 28]
IQ = Path(__file__).parents[2] / "shared" / "data" / "iq"


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.5 s of four satellites at 45 dB-Hz with the navigation message, and their truth."""
    out = tmp_path_factory.mktemp("if") / "sky"
    words = ["generate", "static", "--duration", "1.5", "--format", "ci8", "--rate", "2.5e6"]
    assert main([*words, "--set", f"prns={PRNS}", "--out", str(out), "--quiet"]) == 0
    return out


def test_replicas_and_bits_are_those_of_the_truth(sky: Path) -> None:
    """Code phase modulo a data bit, hence the bit edge; Doppler; every bit up to one sign.

    At 45 dB-Hz the DLL of 1 Hz has 0.004 chips, the PLL's Doppler of 18 Hz some 1.5 Hz a dump.
    """
    recording = open_recording(sky)
    rows = [row for row in acquire(recording) if row.found]
    tracks = track(recording, rows, recording.end_sample)
    assert tracks.prn.tolist() == PRNS
    assert tracks.locked.all()
    assert [kind for _, _, kind, _ in tracks.events] == ["phase lock"] * 4
    with xarray.open_dataset(sky.with_name("sky.truth.nc"), engine="h5netcdf") as truth:
        t, code = truth.t_s.values, truth.code_phase_chips.values
        for i in range(len(PRNS)):
            mine = (tracks.channel == i) & (tracks.t_s > 0.5) & (tracks.t_s < t[-1])
            true_chips = np.interp(tracks.t_s[mine], t, code[:, i])
            away = tracks.code_phase_chips[mine] - true_chips
            away = (away + 10_230.0) % 20_460.0 - 10_230.0
            assert np.abs(away).max() < 0.1
            true_hz = np.interp(tracks.t_s[mine], t, truth.doppler_hz.values[:, i])
            assert np.mean(tracks.doppler_hz[mine] - true_hz) == pytest.approx(0.0, abs=0.5)
            sums, numbers = tracks.bits(i)
            ends = tracks.t_s[tracks.channel == i], tracks.period[tracks.channel == i]
            begin = np.interp(numbers[3:] * 20, ends[1] + 1, ends[0])
            sent = np.floor(np.interp(begin + 0.01, t, code[:, i]) / 20_460).astype(int)
            bits = truth.data_bits.values[i, sent - int(truth.bit.values[0])]
            assert len(bits) > 65
            assert abs(np.sum(np.sign(sums[3:].real) * bits)) == len(bits)


def test_the_bits_are_a_subframe_with_its_time(tmp_path: Path) -> None:
    """From samples to the time of week: ten words with right parity, as `generate` was told."""
    words = ["generate", "static", "--duration", "7.2", "--rate", "2.046e6", "--quiet"]
    words += ["--start", "2149:475223.3", "--set", "prns=[6, 17]", "--out", str(tmp_path / "long")]
    assert main(words) == 0
    recording = open_recording(tmp_path / "long")
    rows = [row for row in acquire(recording, prns=[6, 17]) if row.found]
    tracks = track(recording, rows, recording.end_sample)
    for i in range(2):
        sums, numbers = tracks.bits(i)
        (found,) = find_subframes(np.where(sums.real < 0.0, -1, 1).astype(np.int8))
        assert found.tow_s == 475_224.0
        # it begins 0.7 s into the file, and takes 66 to 90 ms to arrive
        mine = tracks.channel == i
        begins = 20 * int(numbers[found.first_bit])
        received_s = np.interp(begins, tracks.period[mine] + 1, tracks.t_s[mine])
        assert 0.766 < received_s < 0.790


def test_table_json_and_figure(sky: Path, tmp_path: Path, say: Callable[..., Any]) -> None:
    plot = tmp_path / "prompts.png"
    words = ("track", sky, "--prn", "1,2,17", "--duration", 0.3)
    told = json.loads(say(*words, "--json").out)
    assert (told["found"], told["not_synchronised"]) == ([2, 17], [])
    assert told["end_s"] == pytest.approx(0.3, abs=0.002)
    for s in told["satellites"]:
        assert len(s["bits"]) in (13, 14)
        # sqrt(2 C/N0 1 ms) = 7.95 in phase, the noise alone in quadrature
        assert s["prompt_i_rms"] == pytest.approx(7.95, abs=0.7)
        assert s["prompt_q_rms"] == pytest.approx(1.0, abs=0.5)
        assert s["cn0_dbhz"] == pytest.approx(45.0, abs=1.5)
    said = say(*words, "--plot", plot)
    assert said.code == 0
    assert [line.split()[0] for line in said.out.splitlines()[:3]] == ["PRN", "2", "17"]
    assert plot.read_bytes()[:4] == b"\x89PNG"


def test_a_recording_without_satellites_is_not_tracked(
    tmp_path: Path, say: Callable[..., Any]
) -> None:
    raw = tmp_path / "noise.bin"
    noise = 20.0 * np.random.default_rng(1).standard_normal((100_000, 2))
    np.rint(noise).astype(np.int8).tofile(raw)
    said = say("track", raw, "--format", "ci8", "--rate", "2.5e6", "--if-hz", 0)
    assert said.code == 0
    assert "no satellite found" in said.out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--integration-ms", "3"), "integration_s is 0.003: expected 1, 2, 4, 5, 10, 20 ms"),
        (("--bandwidth-hz", "200"), "bandwidth_hz is 200.0: expected at most 80"),
        (("--duration", "0"), "--duration: 0 given, expected more than 0 s"),
        (("--duration", "0.03"), "30 ms to track, expected at least 40 ms, two data bits"),
    ],
)
def test_one_line_for_what_cannot_be_tracked(
    sky: Path, words: tuple[str, str], expected: str, say: Callable[..., Any]
) -> None:
    said = say("track", sky, "--prn", "2", *words)
    assert (said.code, said.out) == (2, "")
    assert expected in said.err


@pytest.mark.skipif(not IQ.exists(), reason="needs the reference data folder beside the repository")
def test_satellites_of_the_real_sky_send_the_same_bits() -> None:
    """Half a second in which the words are common to all satellites (almanac, IS-GPS-200 20.3.3).

    Each channel knows its bits up to one sign and its first one to 20 ms; the first three are
    pull-in.  38 to 48 dB-Hz leave no error.
    """
    recording = Recording(
        IQ / "L1_20211202_084700_4MHz_IQ.bin", 4e6, 0.0, sample_format="ci8", conjugate=True
    )
    rows = [row for row in acquire(recording) if row.found and row.cn0_dbhz > 38.0]
    tracks = track(recording, rows, recording.end_sample)
    assert set(tracks.prn.tolist()) >= {26, 31, 29, 16, 32}
    signs = [np.sign(tracks.bits(i)[0].real[3:]) for i in range(len(tracks.prn))]
    first = signs[0][1:20]
    for other in signs[1:]:
        alike = [abs(np.sum(first * other[k : k + 19])) for k in range(len(other) - 18)]
        assert max(alike) == 19
    rows_of = [tracks.channel == i for i in range(len(tracks.prn))]
    for mine in rows_of:
        late = tracks.iq[mine, 1][250:]
        assert np.mean(late.real**2) > 8.0 * np.mean(late.imag**2)
