"""Receivers that others wrote, on files that we write: gnss-sdr and RTKLIB's rnx2rtkp.

By hand, with the programs installed:

    python tests/receivers/foreign.py SCENARIO --set cn0_dbhz=45 --key PVT.elevation_mask=10

generates a file of the scenario, runs gnss-sdr on it and prints how its fixes compare with the
truth; ``--set`` changes the scenario, ``--key`` the receiver's configuration.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as xml
from pathlib import Path
from string import Template
from typing import NamedTuple

import h5py
import numpy as np

HERE = Path(__file__).parent
C_MPS = 299_792_458.0
TIMEOUT_S = 900.0
RATE_HZ = 2.6e6
START = (2149, 475_220.0)
"""10 s before a frame of the embedded constellation's day"""


def missing() -> str:
    """What to install, in words; empty if all is there."""
    absent = [p for p in ("gnss-sdr", "rnx2rtkp") if shutil.which(p) is None]
    if not absent:
        return ""
    return f"{' and '.join(absent)} not found: on Debian or Ubuntu, apt-get install gnss-sdr rtklib"


class Truth(NamedTuple):
    """What the file holds."""

    samples: Path
    start_tow_s: float
    rate_hz: float
    tow_s: np.ndarray  # (n,) GPS time of week of each row
    r: np.ndarray  # (n, 3) antenna, ECEF [m]
    v: np.ndarray  # (n, 3) [m/s]
    clock_m: np.ndarray  # (n,) receiver clock, positive when ahead
    prns: frozenset[int]

    def at(self, tow_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and clock at GPS times (m,); the rows are 20 ms apart."""
        h = self.tow_s[1] - self.tow_s[0]
        k = np.clip(((tow_s - self.tow_s[0]) / h).astype(int), 0, len(self.tow_s) - 2)
        x = ((tow_s - self.tow_s[k]) / h)[:, None]
        # Hermite: 2 g over 20 ms would be 1 mm from the chord, a velocity nothing worse
        r0, r1, v0, v1 = self.r[k], self.r[k + 1], h * self.v[k], h * self.v[k + 1]
        r = r0 + x * (v0 + x * (3 * (r1 - r0) - 2 * v0 - v1 + x * (2 * (r0 - r1) + v0 + v1)))
        v = self.v[k] + x * (self.v[k + 1] - self.v[k])
        return r, v, np.interp(tow_s, self.tow_s, self.clock_m)


class Fixes(NamedTuple):
    """What gnss-sdr made of it."""

    tow_s: np.ndarray  # (n,) GPS time of week of each fix
    r: np.ndarray  # (n, 3) [m]
    v: np.ndarray  # (n, 3) [m/s]
    clock_m: np.ndarray  # (n,)
    tracked: frozenset[int]  # channels that decoded telemetry
    observed: frozenset[int]  # satellites in the RINEX observations
    ephemerides: frozenset[int]  # complete sets
    false_starts: int  # tracking begun on satellites that are not there, and lost
    first_sample_tow_s: float  # by telemetry: transmission + light time - sample number / rate
    observations: Path
    navigation: Path

    def since(self, tow_s: float) -> Fixes:
        """The fixes from a time on."""
        late = self.tow_s >= tow_s
        arrays = {name: getattr(self, name)[late] for name in ("tow_s", "r", "v", "clock_m")}
        return self._replace(**arrays)


class Errors(NamedTuple):
    """Fixes against the truth."""

    first_fix_s: float
    n_fix: int
    rms_3d_m: float
    mean_m: float
    velocity_rms_mps: float
    velocity_mean_mps: float
    clock_m: float
    """Median of the last second"""
    first_sample_s: float


def generate(
    scenario: str,
    out: Path,
    duration_s: float = 40.0,
    settings: tuple[str, ...] = (),
    start: tuple[int, float] = START,
) -> Truth:
    """Write a file with the command line, int8 of r.m.s. 32 at 2.6 Msps."""
    command = [sys.executable, "-m", "ultratight", "generate", scenario, "--out", str(out)]
    command += ["--duration", f"{duration_s:g}", "--rate", f"{RATE_HZ:g}", "--if-hz", "0"]
    command += ["--format", "ci8", "--start", f"{start[0]}:{start[1]:.10g}", "--json"]
    for text in settings:
        command += ["--set", text]
    done = subprocess.run(command, cwd=HERE.parents[1], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()}")
    made = json.loads(done.stdout)
    return read_truth(Path(made["samples"]), Path(made["truth"]))


def read_truth(samples: Path, path: Path) -> Truth:
    """Truth file beside the samples."""
    with h5py.File(path) as f:
        clock_m = f["clock_m"][:]
        start, rate = (float(np.ravel(f.attrs[n])[0]) for n in ("start_tow_s", "sample_rate_hz"))
        return Truth(
            samples=samples,
            start_tow_s=start,
            rate_hz=rate,
            tow_s=start + f["t_s"][:] - clock_m / C_MPS,
            r=f["r_ea_e"][:],
            v=f["v_ea_e"][:],
            clock_m=clock_m,
            prns=frozenset(int(name.decode()[1:3]) for name in f["channel"][:]),
        )


def run_gnss_sdr(truth: Truth, folder: Path, changes: dict[str, str] | None = None) -> Fixes:
    """Run gnss-sdr in an empty folder; ``changes`` replace or add keys of its configuration."""
    folder.mkdir(parents=True)
    values = {"samples": str(truth.samples.resolve()), "rate": f"{truth.rate_hz:.0f}"}
    text = Template((HERE / "gnss_sdr.conf").read_text()).substitute(values)
    for key, value in (changes or {}).items():
        text = re.sub(rf"(?m)^{re.escape(key)}=.*\n", "", text) + f"{key}={value}\n"
    (folder / "gnss_sdr.conf").write_text(text)
    with (folder / "log.txt").open("w") as log:
        subprocess.run(
            ["gnss-sdr", "--config_file=gnss_sdr.conf", "--log_dir=."],
            cwd=folder,
            stdout=log,
            stderr=subprocess.STDOUT,
            timeout=TIMEOUT_S,
            check=True,
        )
    return _read_fixes(truth, folder)


def _read_fixes(truth: Truth, folder: Path) -> Fixes:
    log = (folder / "log.txt").read_text(errors="replace")
    if not (folder / "pvt.mat").is_file():
        raise RuntimeError(f"gnss-sdr made no fix, see {folder / 'log.txt'}")
    with h5py.File(folder / "pvt.mat") as f:
        pvt = {name: np.ravel(f[name][()]) for name in f}
    begun = re.findall(r"Tracking of GPS L1 C/A signal started .*PRN (\d+)", log)
    observations, navigation = (next(iter(folder.glob(f"*.*{end}"))) for end in "ON")
    sets = xml.parse(folder / "gps_ephemeris.xml").iter("first")
    tracked, first_sample = _telemetry(truth, folder)
    return Fixes(
        tow_s=pvt["RX_time"],
        r=np.stack([pvt[f"pos_{x}"] for x in "xyz"], axis=1),
        v=np.stack([pvt[f"vel_{x}"] for x in "xyz"], axis=1),
        clock_m=pvt["user_clk_offset"] * C_MPS,
        tracked=tracked,
        observed=frozenset(
            int(n) for n in re.findall(r"(?m)^G(\d\d) .*\d\.\d{3}", observations.read_text())
        ),
        ephemerides=frozenset(int(e.text or 0) for e in sets),
        false_starts=sum(int(n) not in truth.prns for n in begun),
        first_sample_tow_s=first_sample,
        observations=observations,
        navigation=navigation,
    )


def _telemetry(truth: Truth, folder: Path) -> tuple[frozenset[int], float]:
    """Satellites that decoded telemetry, and the time of the first sample by their count.

    A subframe that left at TOW is received with sample n; the first sample was taken at
    TOW + light time - n / rate.  The light time is 77.5 ms within 12 ms anywhere on the Earth.
    """
    tracked, moments = set(), []
    for path in folder.glob("telemetry*.mat"):
        with h5py.File(path) as f:
            if "PRN" not in f or f["PRN"].size == 0:
                continue
            tracked.add(int(np.ravel(f["PRN"][()])[-1]))
            tow_s = np.ravel(f["TOW_at_current_symbol_ms"][()])  # in seconds, whatever its name
            count = np.ravel(f["tracking_sample_counter"][()]).astype(float)
            moments.append(np.median(tow_s - count / truth.rate_hz) + 0.0775)
    return frozenset(tracked), float(np.median(moments)) if moments else np.nan


def compare(fixes: Fixes, truth: Truth) -> Errors:
    """Errors of all fixes, the first included."""
    r, v, clock_m = truth.at(fixes.tow_s)
    dr, dv = fixes.r - r, fixes.v - v
    last = fixes.tow_s > fixes.tow_s[-1] - 1.0
    return Errors(
        first_fix_s=float(fixes.tow_s[0] - truth.start_tow_s),
        n_fix=len(fixes.tow_s),
        rms_3d_m=float(np.sqrt((dr**2).sum(axis=1).mean())),
        mean_m=float(np.linalg.norm(dr.mean(axis=0))),
        velocity_rms_mps=float(np.sqrt((dv**2).sum(axis=1).mean())),
        velocity_mean_mps=float(np.linalg.norm(dv.mean(axis=0))),
        clock_m=float(np.median((fixes.clock_m - clock_m)[last])),
        first_sample_s=fixes.first_sample_tow_s - truth.start_tow_s,
    )


def run_rnx2rtkp(fixes: Fixes, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions of rnx2rtkp from gnss-sdr's RINEX files: time of week (n,), ECEF (n, 3)."""
    out = folder / "rtklib.pos"
    subprocess.run(
        ["rnx2rtkp", "-k", str(HERE / "rtklib.conf"), "-o", str(out)]
        + [str(fixes.observations), str(fixes.navigation)],
        capture_output=True,
        timeout=TIMEOUT_S,
        check=True,
    )
    rows = [line.split() for line in out.read_text().splitlines() if not line.startswith("%")]
    table = np.array([[float(x) for x in row[1:5]] for row in rows if row])
    if not len(table):
        raise RuntimeError(f"rnx2rtkp made no position, see {out}")
    return table[:, 0], table[:, 1:4]


def main() -> None:
    """Generate, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scenario")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--duration", type=float, default=40.0)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    parser.add_argument("--key", action="append", default=[])
    parser.add_argument("--keep", type=Path, help="folder for all files; removed by default")
    parser.add_argument("--truth", type=Path, help="take the file that belongs to this truth")
    given = parser.parse_args()
    if absent := missing():
        parser.error(absent)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(given.keep or scratch)
        if given.truth:
            samples = given.truth.with_name(given.truth.name.replace(".truth.nc", ".sigmf-data"))
            truth = read_truth(samples, given.truth)
        else:
            truth = generate(given.scenario, folder / "sky", given.duration, tuple(given.settings))
        for k in range(given.runs):
            changes = dict(text.split("=", 1) for text in given.key)
            fixes = run_gnss_sdr(truth, folder / f"run{k}", changes)
            print(json.dumps(compare(fixes, truth)._asdict()))
            print(f"sent {sorted(truth.prns)}, observed {sorted(fixes.observed)}", end=", ")
            print(f"ephemerides {sorted(fixes.ephemerides)}, false starts {fixes.false_starts}")
            tow_s, r = run_rnx2rtkp(fixes, folder / f"run{k}")
            dr = r - truth.at(tow_s)[0]
            print(f"rnx2rtkp: {len(r)} positions, 3-D rms {np.sqrt((dr**2).sum(1).mean()):.3f} m")


if __name__ == "__main__":
    main()
