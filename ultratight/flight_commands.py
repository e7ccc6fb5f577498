"""What `ultratight track` says and writes of a closure that it has flown."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

if TYPE_CHECKING:
    from ultratight.position_files import Place
    from ultratight.recording_flight import Attitude, Flown
    from ultratight.results import Run
    from ultratight.tracking.navigation import Navigation

ClosureName = Annotated[
    str | None,
    typer.Option(
        "--closure",
        metavar="NAME",
        help="fly it from the first position on: ultra-tight, federated, scalar-ins, vdfll, vdll "
        "or scalar",
    ),
]
ImuFile = Annotated[
    Path | None,
    typer.Option(
        "--imu",
        metavar="CSV",
        help="of ultra-tight, federated and scalar-ins: columns t_s [s since sample 0], "
        "gyro_x_rad_s, ..._y_, ..._z_, accel_x_mps2, ..._y_, ..._z_; or t_s, dtheta_x_rad, ..., "
        "dv_x_mps, ...; forward-right-down, each row about the interval that ends at its t_s, "
        "no gaps",
    ),
]
Grade = Annotated[
    str | None,
    typer.Option(
        "--imu-grade", metavar="NAME", help="its data sheet: industrial-mems, tactical, ..."
    ),
]
AttitudeText = Annotated[
    str | None,
    typer.Option(
        "--attitude",
        metavar="ROLL,PITCH,HEADING",
        help="deg, where the closure takes over; default: from force and course",
    ),
]
AttitudeSigma = Annotated[
    float, typer.Option("--attitude-sigma-deg", metavar="DEG", help="of what --attitude states")
]
TakeOver = Annotated[
    float | None,
    typer.Option(metavar="S", help="where the closure does; default: 2 s after the first position"),
]


def attitude_of(text: str | None, sigma_deg: float) -> Attitude | None:
    """ROLL,PITCH,HEADING in deg; ValueError for anything else."""
    from ultratight.recording_flight import Attitude

    if text is None:
        return None
    try:
        roll, pitch, heading = (float(cell) for cell in text.split(","))
    except ValueError:
        raise ValueError(f"--attitude: {text} given, expected ROLL,PITCH,HEADING in deg") from None
    return Attitude((roll, pitch, heading), sigma_deg)


def places_of(flown: Flown, interval_ms: int) -> list[Place]:
    """Positions for a map, up to where the closure has nothing left to steer with."""
    from ultratight.position_files import place
    from ultratight.recording_flight import locked

    run, knows = flown.run, flown.knows
    steps = np.diff(run.t_s[:2])
    every = max(1, round(1e-3 * interval_ms / steps[0])) if len(steps) else 1
    used = locked(run).sum(axis=1)
    found = []
    for k in range(every - 1, run.t_s.size, every):
        clock = run["clock_m"][k], *run["v_eb_e"][k], run["clock_rate"][k]
        state = np.array([*run["r_eb_e"][k], *clock])
        if np.isfinite(state).all():
            t_s = float(run.t_s[k])
            tow_s = knows.start_tow_s + t_s - flown.t0_s
            found.append(place(knows.start_week, t_s, tow_s, state, int(used[k])))
    return found


def told(flown: Flown, where: list[Place]) -> dict[str, Any]:
    """What --json prints of the flight."""
    run = flown.run
    sigma = flown.knows.sigma
    attitude = flown.attitude_deg
    return {
        **run.summary,
        "take_over_s": flown.t0_s,
        "attitude_deg": attitude and list(attitude),
        "attitude_sigma_deg": attitude and math.degrees(float(sigma[6:9].max())),
        "first_sigma": {"position_m": _length(sigma[:3]), "velocity_mps": _length(sigma[3:6])},
        "last_sigma": _last_sigma(run),
        "n_position": len(where),
        "last": _without_nan(where[-1]) if where else None,
        "events": [
            {"t_s": e.t_s, "channel": e.channel, "kind": e.kind, "reason": e.reason}
            for e in run.events
        ],
    }


def _without_nan(place: Place) -> dict[str, Any]:
    return {k: None if v != v else v for k, v in place._asdict().items()}


def _length(sigma: np.ndarray) -> float:
    return float(np.sqrt(np.sum(sigma**2)))


def _last_sigma(run: Run) -> dict[str, float] | None:
    """Of position and velocity (3-D), as the closure's filter believes; None without one."""
    if "covariance" not in run:
        return None
    whole = np.flatnonzero(np.isfinite(run["covariance"][:, 0, 0]))
    if not len(whole):
        return None
    sigma = np.sqrt(np.diag(run["covariance"][whole[-1]]))
    return {"position_m": _length(sigma[:3]), "velocity_mps": _length(sigma[3:6])}


def lines(of: dict[str, Any]) -> list[str]:
    """The flight in words."""
    how = ", ".join(str(of[k]) for k in ("closure", "filter", "measurement") if of[k])
    first = of["first_sigma"]
    out = [
        f"{how}: took over at {of['take_over_s']:.3f} s with {len(of['lost_lock_s'])} satellites, "
        f"1 sigma {first['position_m']:.2g} m, {first['velocity_mps']:.2g} m/s"
    ]
    if of["attitude_deg"]:
        roll, pitch, heading = of["attitude_deg"]
        out.append(
            f"attitude there: roll {roll:.2f}, pitch {pitch:.2f}, heading {heading:.2f} deg, "
            f"1 sigma {of['attitude_sigma_deg']:.2g} deg"
        )
    lost = [f"{name} at {t:.2f} s" for name, t in of["lost_lock_s"].items() if t is not None]
    out.append(f"lost lock: {', '.join(lost) or 'never'}")
    out += [
        f"{e['t_s']:9.3f} s  {e['kind']}: {e['reason']}" for e in of["events"] if not e["channel"]
    ]
    last, sigma = of["last"], of["last_sigma"]
    if last:
        doubt = ""
        if sigma:  # channel loops have none
            doubt = f"  1 sigma {sigma['position_m']:.2g} m, {sigma['velocity_mps']:.2g} m/s"
        out.append(
            f"{last['utc']}  {last['lat_deg']:.7f} deg  {last['lon_deg']:.7f} deg  "
            f"{last['height_m']:.2f} m above the ellipsoid  {last['speed_mps']:.2f} m/s"
            f"{doubt}"
        )
    return out


def write_files(flown: Flown, where: list[Place], folder: Path, name: str) -> list[Path]:
    """NAME.CLOSURE.nc, the run; .nmea, .geojson and .kml, if there are positions."""
    from ultratight import position_files

    name = f"{name}.{flown.run.summary['closure']}"
    path = folder / f"{name}.nc"
    flown.run.save(path)
    return [path, *position_files.write(where, folder, name)]


def write_plot(flown: Flown, nav: Navigation, plot: Path, title: str) -> Path:
    """PLOT-CLOSURE."""
    from ultratight import plots_flight
    from ultratight.acquire_commands import write_figure

    path = plot.with_name(f"{plot.stem}-{flown.run.summary['closure']}{plot.suffix}")
    write_figure(path, plots_flight.figure(flown, nav, title))
    return path
