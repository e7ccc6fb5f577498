"""The real sky: what other receivers found in three recordings, and nothing that is not there.

Dopplers, code starts and C/N0 are those of two other receivers (data README).  What else is found
is there by the orbits: the ground track of GPS repeats each sidereal day, so that broadcast
ephemerides of 2022-01-01 say what stood above Tokyo, where two of the recordings were made, 37 and
30 days before.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from signals.codes import GPS_L1CA
from signals.constants import C_MPS, GPS_L1_HZ
from signals.recording import Recording
from signals.rinex import read_navigation
from ultratight.ins.earth import ecef_from_geodetic
from ultratight.statistics import wilson
from ultratight.tracking.acquisition import Search, acquire, alike

DATA = Path(__file__).parents[3] / "shared" / "data"
pytestmark = pytest.mark.skipif(
    not DATA.exists(), reason="needs the reference data folder beside the repository"
)


class Sky(NamedTuple):
    how: dict[str, Any]
    known: dict[int, tuple[float, float, float]]
    """PRN: Doppler [Hz], time from sample 0 to the next code start [ms], C/N0 [dB-Hz]"""
    more: set[int]
    """Also there"""
    days_before: int
    """2022-01-01"""
    utc_s: float
    """Seconds of the day"""


SKIES = {
    "L1_20211202_084700_4MHz_IQ.bin": Sky(
        {"sample_rate_hz": 4e6, "if_hz": 0.0, "sample_format": "ci8", "conjugate": True},
        {
            26: (650.0, 0.89978, 48.5), 31: (-204.0, 0.28972, 45.9), 29: (-2215.0, 0.41320, 44.7),
            16: (2576.0, 0.98942, 44.3), 32: (-3281.0, 0.69146, 42.0),
        },
        {18, 25}, 30, 8 * 3600 + 47 * 60,
    ),
    "L1_20211125_004000_12MHz_I.bin": Sky(
        {"sample_rate_hz": 12e6, "if_hz": 3e6, "sample_format": "ri8"},
        {
            13: (-241.0, 0.50033, 47.8), 15: (1746.0, 0.77640, 47.0), 20: (-1349.0, 0.68097, 46.2),
            30: (-1862.0, 0.39328, 43.6),
        },
        {2, 5, 11, 18, 28, 29}, 37, 40 * 60,
    ),
    "codc_bladerf_l1_5MHz_ishort.dat": Sky(
        {"sample_rate_hz": 5e6, "if_hz": 0.0, "sample_format": "ci16"},
        {
            27: (-861.0, 0.61195, 53.6), 4: (-1808.0, 0.65096, 46.1), 10: (811.0, 0.38333, 47.6),
            8: (1546.0, 0.30552, 45.9), 7: (-1298.0, 0.54699, 42.3),
        },
        {1, 11, 16, 18}, 0, 0.0,
    ),
}  # fmt: skip
TOKYO_DEG = 35.7, 139.7
ABSENT = (*range(38, 120), *range(159, 183))
"""C/A codes that nothing sends on L1 (IS-GPS-200 table 6-I)"""


@cache
def opened(name: str) -> Recording:
    return Recording(DATA / "iq" / name, **SKIES[name].how)


@pytest.mark.parametrize("name", SKIES)
def test_satellites_of_other_receivers_are_found(name: str) -> None:
    """Doppler within 50 Hz, code phase within 0.15 chips, C/N0 within 3 dB; nothing unexplained."""
    sky = SKIES[name]
    rows = {row.prn: row for row in acquire(opened(name)) if row.found}
    assert set(rows) == set(sky.known) | sky.more
    for prn, (doppler_hz, start_ms, cn0_dbhz) in sky.known.items():
        row = rows[prn]
        assert row.doppler_hz == pytest.approx(doppler_hz, abs=50.0)
        away = (row.code_phase_chips + 1023.0 * start_ms + 511.5) % 1023.0 - 511.5
        assert away == pytest.approx(0.0, abs=0.15)
        assert row.cn0_dbhz == pytest.approx(cn0_dbhz, abs=3.0)


@pytest.mark.parametrize("name", [n for n in SKIES if SKIES[n].days_before])
def test_what_is_found_stood_above_the_horizon(name: str) -> None:
    """Higher than 2 degrees, with one clock drift in all Dopplers.

    In 30 to 37 days the repeating track has drifted by some degrees: 150 Hz.  That satellites were
    set unhealthy does not stop them from sending.
    """
    sky = SKIES[name]
    every = read_navigation(DATA / "orbit" / "brdc0010.22n")
    orbits = replace(every, health=np.zeros_like(every.health))
    sidereal_s = 86_155.0  # two revolutions of GPS with the drift of the node
    tow = 6 * 86_400 + 18 + sky.utc_s - sky.days_before * (86_400 - sidereal_s)
    tow += sidereal_s if tow < 6 * 86_400 else 0.0
    lat, lon = np.radians(TOKYO_DEG)
    r = ecef_from_geodetic(lat, lon, 0.0)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    drift = []
    for row in acquire(opened(name)):
        if row.found:
            r_es_e, v_es_e, _, _ = orbits.at(2190, tow, row.prn)
            line = (r_es_e - r) / np.linalg.norm(r_es_e - r)
            assert np.degrees(np.arcsin(line @ up)) > 2.0
            drift.append(row.doppler_hz + line @ v_es_e * GPS_L1_HZ / C_MPS)
    assert np.abs(drift - np.median(drift)).max() < 150.0


def test_the_same_are_there_at_the_end() -> None:
    """Where the place is not known: same Doppler 180 ms later, at the predicted code phase."""
    name = "codc_bladerf_l1_5MHz_ishort.dat"
    recording, prns = opened(name), sorted(SKIES[name].more)
    n0 = recording.end_sample - round(0.02 * recording.sample_rate_hz)
    search = Search(noncoherent=20)
    before = acquire(recording, prns=prns, search=search)
    after = acquire(recording, prns=prns, search=search, first_sample=n0)
    t = n0 / recording.sample_rate_hz
    for a, b in zip(before, after, strict=True):
        assert (a.found, b.found) == (True, True)
        assert b.doppler_hz == pytest.approx(a.doppler_hz, abs=10.0)
        predicted = a.code_phase_chips + 1.023e6 * (1.0 + a.doppler_hz / GPS_L1_HZ) * t
        away = (b.code_phase_chips - predicted + 511.5) % 1023.0 - 511.5
        assert away == pytest.approx(0.0, abs=0.25)


@pytest.mark.parametrize("name", SKIES)
def test_satellites_that_are_there_share_no_doppler(name: str) -> None:
    assert alike(GPS_L1CA, acquire(opened(name))) == 0


WRONG = [
    ("codc_bladerf_l1_5MHz_ishort.dat", {"if_hz": 20e3}),
    ("codc_bladerf_l1_5MHz_ishort.dat", {"if_hz": -100e3}),
    ("codc_bladerf_l1_5MHz_ishort.dat", {"sample_format": "ci8"}),
    ("L1_20211202_084700_4MHz_IQ.bin", {"sample_format": "ci16"}),
]


@pytest.mark.parametrize(("name", "wrong"), WRONG)
def test_a_wrong_description_that_finds_many_is_told(
    name: str, wrong: dict[str, Any], say: Callable[..., Any]
) -> None:
    """One satellite of 54 dB-Hz, or a line at 0, comes through the codes of satellites not there.

    At the wrong IF the one seen is PRN 27: -861 Hz are 139 modulo 500.
    """
    how = SKIES[name].how | wrong
    options = {"sample_format": "--format", "sample_rate_hz": "--rate", "if_hz": "--if-hz"}
    words = [word for key, option in options.items() for word in (option, how[key])]
    said = say("acquire", DATA / "iq" / name, *words, "--json")
    told = json.loads(said.out)
    (line,) = [w for w in told["warnings"] if "share a Doppler modulo 500 Hz" in w]
    assert f"warning: {line}" in said.err
    n, of = int(line.split()[1]), len(told["found"])
    assert f" {n} of {of} satellites" in line
    at = 139.0 if "if_hz" in wrong else 0.0
    rest = [
        (s["doppler_hz"] - at + 250.0) % 500.0 - 250.0 for s in told["satellites"] if s["found"]
    ]
    assert n <= sum(abs(r) < 4.0 for r in rest)
    assert n >= 0.6 * of


def alarms(name: str, blocks: int, false_alarm: float) -> tuple[int, int]:
    """How often codes that nothing sends are found, beside all that is searched by default."""
    recording = opened(name)
    last = len(recording) - round(0.01 * recording.sample_rate_hz)
    found = [
        row.found
        for n0 in np.linspace(0, last, blocks).astype(int).tolist()
        for row in acquire(
            recording, prns=(*range(1, 33), *ABSENT), first_sample=n0,
            search=Search(false_alarm=false_alarm),
        )
        if row.prn in ABSENT
    ]  # fmt: skip
    return sum(found), len(found)


@pytest.mark.parametrize("name", SKIES)
def test_codes_that_nothing_sends_are_not_found(name: str) -> None:
    """At a stated rate of 1 %, among satellites of up to 54 dB-Hz; 106 codes."""
    k, n = alarms(name, 1, 0.01)
    assert wilson(k, n, 0.99).low < 0.01


@pytest.mark.campaign
@pytest.mark.parametrize("name", SKIES)
def test_false_alarms_on_real_recordings(name: str) -> None:
    """Blocks over the whole recording, at least 1000 trials: below twice the stated 1 %."""
    k, n = alarms(name, 20, 0.01)
    assert n > 1000
    assert wilson(k, n, 0.95).low < 0.01
    assert k / n < 0.02
