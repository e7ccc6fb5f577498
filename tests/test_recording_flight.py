"""A closure flown on a file: from samples and an IMU's data alone, against the file's truth.

The file is 27.6 s long: subframes 1 to 3 begin 1 s into it, the first position comes after 19.1 s,
closures take over 2 s later, and from 22.5 to 25 s the vehicle accelerates with 40 m/s^2.  The IMU
has the errors that the filters hold, biases and white noise, and no others.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray

from signals.recording import Recording
from signals.sigmf_files import open_recording
from ultratight import recording_flight, results, track_commands
from ultratight.__main__ import main
from ultratight.config import InvalidInput
from ultratight.ins.attitude import rotation_from_euler, vector_from_rotation
from ultratight.ins.earth import geodetic_from_ecef, rotation_e_from_n
from ultratight.ins.imu_table import read_increments, write_increments
from ultratight.recording_flight import Attitude, Flown, fly_recording, plan
from ultratight.sky_view import sky_paths
from ultratight.tracking import acquisition, from_samples
from ultratight.tracking.acquisition import Acquisition
from ultratight.tracking.from_samples import Tracks
from ultratight.tracking.navigation import Navigation, navigate

HEADING_DEG = 40.107045659157627
DRIVE = (
    "static", "--duration", "27.6", "--rate", "1.3e6", "--start", "2149:475229", "--imu",
    "--set", "speed_mps=60", "--set", "imu.grade=matched", "--set", "imu.lag_s=0",
    "--set", "profile=[{t0_s=22.5, t1_s=25.0, accel0_mps2=40.0, accel1_mps2=40.0}]",
    "--set", "max_satellites=8",
)  # fmt: skip


class Drive(NamedTuple):
    name: Path
    imu: Path
    recording: Recording
    acquired: list[Acquisition]
    tracks: Tracks
    nav: Navigation
    truth: xarray.Dataset

    def true(self, name: str, t_s: np.ndarray) -> np.ndarray:
        rows = self.truth[name].values.T
        return np.stack([np.interp(t_s, self.truth.t_s.values, row) for row in rows], axis=1)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    name = tmp_path_factory.mktemp("if") / "drive"
    assert main(["generate", *DRIVE, "--out", str(name), "--quiet"]) == 0
    recording = open_recording(name)
    found = [row for row in acquisition.acquire(recording) if row.found]
    tracks = from_samples.track(recording, found, recording.end_sample)
    with xarray.open_dataset(name.with_name("drive.truth.nc"), engine="h5netcdf") as truth:
        return Drive(
            name, name.with_name("drive.imu.csv"), recording, found, tracks,
            navigate(tracks, atmosphere=False), truth.load(),
        )  # fmt: skip


def flown(drive: Drive, closure: str, **options: Any) -> Flown:
    end = drive.recording.end_sample
    if closure in recording_flight.INERTIAL:
        options = {"imu": drive.imu, "grade": "matched", **options}
    planned = plan(closure, end / drive.recording.sample_rate_hz, **options)
    return fly_recording(planned, drive.recording, drive.nav, end, atmosphere=False)


def errors(drive: Drive, of: Flown) -> tuple[np.ndarray, np.ndarray]:
    """Of position and velocity (n, 3); there is no lever arm."""
    t = of.run.t_s
    return of.run["r_eb_e"] - drive.true("r_ea_e", t), of.run["v_eb_e"] - drive.true("v_ea_e", t)


def test_what_is_told_at_the_start_is_true_within_its_sigma(drive: Drive) -> None:
    """Position, velocity, clock, attitude and C/N0; four sigma each."""
    of = flown(drive, "ultra-tight", filter_name="kf")
    knows, at = of.knows, np.array([of.t0_s])
    assert of.t0_s == pytest.approx(drive.nav.positions[0].t_s + 2.0, abs=0.006)
    sigma = knows.sigma
    assert (np.abs(knows.r_eb_e - drive.true("r_ea_e", at)[0]) < 4.0 * sigma[:3]).all()
    assert (np.abs(knows.v_eb_e - drive.true("v_ea_e", at)[0]) < 4.0 * sigma[3:6]).all()
    # the receiver's clock is steered to whole milliseconds
    wound = 1e-3 * 299_792_458.0
    clock = float(np.interp(at[0], drive.truth.t_s, drive.truth.clock_m))
    away = (knows.clock_m - clock + 0.5 * wound) % wound - 0.5 * wound
    assert abs(away) < 4.0 * sigma[15]
    drift = float(np.interp(at[0], drive.truth.t_s, drive.truth.clock_rate_mps))
    # white frequency noise of the TCXO over the 0.1 s of a Doppler is in the truth, not the state
    assert knows.clock_rate_mps == pytest.approx(drift, abs=4.0 * sigma[16] + 0.1)
    lat, lon, _ = geodetic_from_ecef(knows.r_eb_e)
    true = rotation_e_from_n(lat, lon) @ rotation_from_euler(0.0, 0.0, np.radians(HEADING_DEG))
    assert (np.abs(vector_from_rotation(true @ knows.C_b_e.T)) < 4.0 * sigma[6:9]).all()
    assert sigma[6:9].max() < np.radians(1.5)
    np.testing.assert_allclose(knows.cn0_dbhz, 45.0, atol=1.5)
    assert knows.prn.tolist() == drive.tracks.prn.tolist()


@pytest.mark.parametrize(
    ("closure", "options"),
    [
        ("ultra-tight", {"filter_name": "kf"}),
        ("federated", {"filter_name": "kf"}),
        ("federated", {"filter_name": "kf", "changes": ["receiver.federated.update_s=0.1"]}),
        ("vdfll", {}),
        ("vdll", {}),
    ],
)
def test_position_and_velocity_within_the_filters_own_covariance(
    drive: Drive, closure: str, options: dict[str, Any]
) -> None:
    """Each component within 4.5 sigma in all rows, and no better than a third of what it believes.

    Left out are the first 0.5 s, and a vector closure's rows until 1.5 s after the jump, of which
    its random walk of acceleration knows nothing.
    """
    of = flown(drive, closure, **options)
    assert of.run.t_s[-1] == pytest.approx(27.6, abs=0.101)
    assert not of.run.summary["diverged"]
    cov, t = of.run["covariance"], of.run.t_s
    inertial = closure in recording_flight.INERTIAL
    keep = (t > of.t0_s + 0.5) & (inertial | (np.abs(t - 24.0) > 2.5))
    for part, error in zip((slice(0, 3), slice(3, 6)), errors(drive, of), strict=True):
        sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2)[:, part])
        z = (error / sigma)[keep]
        assert np.abs(z).max() < 4.5
        assert np.sqrt(np.mean(z**2)) > 1.0 / 3.0
    lost = of.run.summary["lost_lock_s"]
    assert list(lost) == [f"G{p:02d}:L1CA" for p in drive.tracks.prn.tolist()]
    # a VDLL's carriers are scalar loops: 4 g at once are too much for some of them
    assert closure == "vdll" or set(lost.values()) == {None}


def test_the_ins_carries_a_scalar_closure_through_the_jump(drive: Drive) -> None:
    """Some of the loops that have to follow 4 g alone lose their satellite; aided ones do not."""
    jump = {}
    for closure in ("scalar-ins", "scalar"):
        of = flown(drive, closure)
        _, v = errors(drive, of)
        during = (of.run.t_s > 22.5) & (of.run.t_s < 25.2)
        jump[closure] = float(np.nanmax(np.linalg.norm(v[during], axis=1)))
        lost = {e.kind for e in of.run.events} == {"frequency lock", "phase lock", "loss of lock"}
        assert lost == (closure == "scalar")
    assert jump["scalar-ins"] < 0.3
    assert jump["scalar"] > 3.0 * jump["scalar-ins"]


def test_nothing_later_than_the_start_is_used(drive: Drive) -> None:
    """Tracks that end 60 ms after it, half of a Doppler's span and more, tell the same."""
    whole = flown(drive, "vdfll")
    early = drive.tracks.t_s < whole.t0_s + 0.06
    columns = ("channel", "period", "t_s", "iq", "doppler_hz", "code_phase_chips", "carrier_cycles")
    cut = drive.tracks._replace(**{name: getattr(drive.tracks, name)[early] for name in columns})
    nav = navigate(cut, atmosphere=False)
    assert nav.positions[-1].t_s == pytest.approx(whole.t0_s, abs=1e-6)
    again = fly_recording(
        plan("vdfll", 27.6), drive.recording, nav, drive.recording.end_sample, atmosphere=False
    )
    assert again.t0_s == whole.t0_s
    for name in ("r_eb_e", "v_eb_e", "clock_m", "elements", "cn0_dbhz", "sigma"):
        np.testing.assert_array_equal(getattr(again.knows, name), getattr(whole.knows, name))
    np.testing.assert_array_equal(again.run["v_eb_e"], whole.run["v_eb_e"])


def test_a_stated_attitude_and_a_later_start(drive: Drive) -> None:
    of = flown(
        drive, "ultra-tight", take_over_s=22.0,
        attitude=Attitude((0.5, -0.5, HEADING_DEG + 1.0), 1.5),
    )  # fmt: skip
    assert of.t0_s == pytest.approx(22.0, abs=0.105)
    np.testing.assert_allclose(of.attitude_deg, (0.5, -0.5, HEADING_DEG + 1.0), atol=1e-6)
    np.testing.assert_allclose(of.knows.sigma[6:9], np.radians(1.5))
    r, _ = errors(drive, of)
    assert np.linalg.norm(r[-1]) < 5.0


@pytest.fixture
def track(
    drive: Drive, monkeypatch: pytest.MonkeyPatch, say: Callable[..., Any]
) -> Callable[..., Any]:
    """`ultratight track` of the file, whose tracks are there already; without their own figures."""
    monkeypatch.setattr(track_commands, "_figures", lambda *_: [])
    monkeypatch.setattr(acquisition, "acquire", lambda *_: drive.acquired)
    monkeypatch.setattr(from_samples, "track", lambda *_: drive.tracks)
    return lambda *words: say("track", drive.name, *words)


def test_the_command_says_and_writes_it(
    drive: Drive, track: Callable[..., Any], say: Callable[..., Any], tmp_path: Path
) -> None:
    words = ("--closure", "ultra-tight", "--imu", drive.imu, "--imu-grade", "matched", "--filter")
    said = track(*words, "kf", "--out", tmp_path, "--plot", tmp_path / "p.png", "--quiet", "--json")
    assert said.code == 0
    told = json.loads(said.out)["flight"]
    assert (told["closure"], told["filter"], told["measurement"]) == (
        "ultra-tight", "kf", "differential",
    )  # fmt: skip
    roll, pitch, heading = told["attitude_deg"]
    assert (roll, pitch, heading) == pytest.approx((0.0, 0.0, HEADING_DEG), abs=3.0)
    assert told["n_position"] == pytest.approx((27.6 - told["take_over_s"]) / 0.1, abs=1.0)
    assert told["last"]["speed_mps"] == pytest.approx(160.0, abs=0.5)
    assert set(told["lost_lock_s"].values()) == {None}
    names = {p.name for p in tmp_path.iterdir()}
    assert {f"drive.ultra-tight.{e}" for e in ("nc", "nmea", "geojson", "kml")} <= names
    assert (tmp_path / "p-ultra-tight.png").read_bytes()[:4] == b"\x89PNG"
    run = results.load(tmp_path / "drive.ultra-tight.nc")
    assert run.t_s[0] > told["take_over_s"]
    shown = say("show", tmp_path / "drive.ultra-tight.nc")
    assert shown.code == 0
    assert "lost_lock_s          {'G0" in shown.out
    line = json.loads((tmp_path / "drive.ultra-tight.geojson").read_text())["features"][0]
    assert len(line["geometry"]["coordinates"]) == told["n_position"]
    text = track("--closure", "vdfll", "--quiet").out.splitlines()
    assert any(t.startswith("vdfll: took over at ") and "8 satellites, 1 sigma" in t for t in text)
    assert "lost lock: never" in text
    said = track("--closure", "scalar", "--quiet")  # channel loops have no covariance
    assert (said.code, "lost lock: " in said.out) == (0, True)
    assert "m above the ellipsoid" in said.out.splitlines()[-1]


TIGHT, VECTOR = ("--closure", "ultra-tight"), ("--closure", "vdfll")
MATCHED = (*TIGHT, "--imu", "IMU", "--imu-grade", "matched")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--closure", "tight"), "--closure: tight given, expected one of ultra-tight, federated"),
        (TIGHT, "--imu: nothing given, expected the IMU's data with ultra-tight"),
        (MATCHED[:-2], "--imu-grade: nothing given, expected the data sheet"),
        ((*MATCHED[:-1], "x"), 'imu.grade: "x" given, expected one of'),
        ((*MATCHED, "--filter", "x"), 'receiver.filter: "x"'),
        ((*TIGHT, "--imu", "none.csv", "--imu-grade", "matched"), "none.csv: no such file"),
        ((*VECTOR, "--imu", "IMU"), "expected none with vdfll"),
        ((*VECTOR, "--filter", "kf"), "--filter: kf given, expected none with vdfll"),
        ((*VECTOR, "--set", "cn0_dbhz=40"), "--set: cn0_dbhz given, expected a key of"),
        ((*VECTOR, "--set", "receiver.knows.data_bits=true"), "--set: receiver.knows."),
        ((*VECTOR, "--take-over", "30"), "--take-over: 30 given, expected 0 to 27.6 s"),
        ((*VECTOR, "--take-over", "20"), "--take-over: 20 given, expected 21."),
        (("--filter", "kf"), "--filter: given without --closure, expected both"),
        ((*MATCHED, "--attitude", "1,2"), "--attitude: 1,2 given, expected ROLL,PITCH,HEADING in"),
        (
            (*MATCHED, "--attitude", "1,2,3", "--attitude-sigma-deg", "30"),
            "--attitude-sigma-deg: 30 given, expected more than 0, at most 10",
        ),
        (
            (*MATCHED, "--set", 'receiver.measurement="coherent"'),
            'receiver.measurement: "coherent" without receiver.knows.data_bits given',
        ),
    ],
)  # fmt: skip
def test_one_line_for_what_cannot_be_flown(
    drive: Drive, track: Callable[..., Any], words: tuple[str, ...], expected: str
) -> None:
    said = track(*[drive.imu if w == "IMU" else w for w in words], "--quiet")
    assert (said.code, said.out) == (2, "")
    assert said.err.count("\n") == 1
    assert expected in said.err


def test_imu_data_of_another_frame_or_length_are_refused(drive: Drive, tmp_path: Path) -> None:
    """Forward-left-up; cut short; late by half of the file."""
    imu, other = read_increments(drive.imu), tmp_path / "other.csv"

    def said(**changes: np.ndarray) -> str:
        write_increments(other, imu._replace(**changes))
        with pytest.raises((ValueError, InvalidInput)) as error:
            flown(drive, "ultra-tight", imu=other)
        return str(error.value)

    flip = np.array([1.0, -1.0, -1.0])
    text = said(alpha_ib_b=imu.alpha_ib_b * flip, nu_ib_b=imu.nu_ib_b * flip)
    assert "deg, upside down: expected axes forward-right-down" in text
    n = 5000
    text = said(t_s=imu.t_s[: n + 1], alpha_ib_b=imu.alpha_ib_b[:n], nu_ib_b=imu.nu_ib_b[:n])
    assert "ends at t_s = 24.995, expected 27.600 s, the end of the samples" in text
    assert "expected 19." in said(t_s=imu.t_s + 25.0)
    assert "the GNSS velocities ask for 9.8" in said(nu_ib_b=1.2 * imu.nu_ib_b)


def test_directions_of_the_satellites_are_those_of_the_truth(drive: Drive) -> None:
    """Elevation and azimuth to a hundredth of a degree; a metre of position is 3e-6 deg."""
    paths = sky_paths(drive.nav)
    assert [path.prn for path in paths] == sorted(drive.tracks.prn.tolist())
    for path in paths:
        one = drive.truth.sel(channel=f"G{path.prn:02d}:L1CA")
        for name, values in (("elevation", path.elevation_deg), ("azimuth", path.azimuth_deg)):
            true = np.interp(path.t_s, one.t_s.values, np.degrees(one[name].values) % 360.0)
            np.testing.assert_allclose(values, true, atol=0.01)
    assert sky_paths(drive.nav._replace(positions=[])) == []
