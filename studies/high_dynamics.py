"""JPL's high-dynamic trajectory, 25 g and 100 g/s: down to which C/N0 does each closure hold?

Loss probability against C/N0 of a PLL of second and of third order, an FLL, an FLL-assisted PLL, a
Kalman loop, an INS-aided PLL, a VDFLL and the ultra-tight closure, the latter three with a tactical
and a MEMS IMU where they have one; the threshold is where 10 % of the channels are lost.  Settings
of each closure are the best of a search over bandwidth and integration (noise densities where there
is a filter) on seeds of its own; what was tried is in `SEARCH`, all of it is reported.

Computed with the linear rules (third-order Costas loop, 3 sigma + dynamic error <= 45 deg, best
bandwidth): 31.2 dB-Hz at a jerk of 100 g/s; 24.0 where aiding removes 99 % of it and 20 ms of
integration become possible, hence 7 dB, and about 10 dB at 99.9 %.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from common.campaign import Campaign, Study, carry_out
from common.jpl import ALONE, LINE, band, lost, thinned, world
from common.ledger import Claim, Must, Quantity
from common.statistics import number
from common.thresholds import LOSS, gap, threshold
from matplotlib.figure import Figure

from ultratight.plots import COLOURS, STYLES

Change = dict[str, Any]
WORLD = world()
RUNS = {"loops": 6, "aided": 6, "joint": 12}
"""Of four channels each, which are trials of their own but where they share a solution"""
FIRST_SEED = 2001
SEARCH_RUNS, SEARCH_SEED = 1, 9001
LEVELS = {
    "loops": (27.5, 30.0, 32.5, 35.0, 37.5),
    "aided": (17.5, 20.0, 22.5, 25.0, 27.5, 30.0),
    "joint": (15.0, 17.5, 20.0, 22.5, 25.0),
}
SEARCH_LEVELS = {"loops": (30.0, 32.5), "aided": (22.5, 25.0), "joint": (17.5, 20.0, 22.5)}
COMPUTED_DBHZ = 31.2
ON_PAPER_DB = (7.0, 10.0)


def pll(order: int, hz: float, ms: int, **more: Any) -> Change:
    """A phase loop, as wide from the start, with its DLL."""
    return loop(pll_order=order, bandwidth_hz=hz, integration_s=1e-3 * ms, **more)


def loop(**keys: Any) -> Change:
    """Keys of a scalar closure; the DLL is carrier-aided and needs no more than 2 Hz."""
    fixed = {"closure": "scalar", "dll_bandwidth_hz": 2.0}
    return WORLD | ALONE | {f"receiver.{key}": value for key, value in (fixed | keys).items()}


def aided(grade: str, hz: float, ms: int) -> Change:
    """A third-order PLL fed by a free INS."""
    change = pll(3, hz, ms, closure="scalar-ins", assisted_bandwidth_hz=max(hz, 5.0))
    return change | {"imu.grade": grade}


def vector(jerk: float) -> Change:
    """Eleven states on the whole sky."""
    return WORLD | {"receiver.closure": "vdfll", "receiver.vector.jerk_mps3_sqrt_hz": jerk}


def tight(grade: str, name: str, model: str) -> Change:
    """The ultra-tight closure on the whole sky."""
    return WORLD | {
        "imu.grade": grade, "receiver.closure": "ultra-tight", "receiver.filter": name,
        "receiver.measurement": model,
    }  # fmt: skip


MEMS, TACTICAL = "industrial-mems", "tactical"
SEARCH: dict[str, dict[str, dict[str, Change]]] = {
    "loops": {
        "PLL 2": {f"{b} Hz, {t} ms": pll(2, b, t) for b, t in
                  ((90, 2), (60, 2), (75, 2), (75, 5))},
        "PLL 3": {f"{b} Hz, {t} ms": pll(3, b, t) for b, t in
                  ((50, 2), (40, 2), (50, 5), (65, 2), (65, 5), (80, 2))},
        "FLL 2": {f"{b} Hz": loop(carrier_loop="fll", fll_order=2, fll_bandwidth_hz=b,
                                  integration_s=0.005, bandwidth_hz=18.0)
                  for b in (18.0, 13.0, 20.0)},
        "FLL-PLL": {f"{b} Hz, FLL {f:g} Hz": pll(3, b, 2, carrier_loop="fll-pll",
                                                 fll_bandwidth_hz=f)
                    for b, f in ((50, 4.0), (50, 9.0), (65, 4.0), (65, 9.0))},
        "Kalman": {f"{j} m/s3/rtHz, {t} ms": pll(3, 40, t, loop="kalman",
                                                 jerk_mps3_sqrt_hz=float(j))
                   for j, t in ((400, 5), (150, 5), (1000, 5), (400, 2))},
    },
    "aided": {
        f"aided PLL, {name}": {f"{b} Hz, {t} ms": aided(grade, b, t) for b, t in
                               ((12, 20), (8, 20), (12, 10), (18, 10))}
        for name, grade in (("tactical", TACTICAL), ("MEMS", MEMS))
    },
    "joint": {
        "VDFLL": {f"{j} m/s3/rtHz": vector(float(j)) for j in (300, 100, 1000)},
    } | {
        f"ultra-tight, {name}": {f"{f}, {m}": tight(grade, f, m) for f, m in
                                 (("qkf", "differential"), ("qkf", "coherent"),
                                  ("jtq-r", "coherent"), ("jtq-r", "differential"))}
        for name, grade in (("tactical", TACTICAL), ("MEMS", MEMS))
    },
}  # fmt: skip
"""What is tried of each closure, on seeds of its own; a quick look takes the first"""


def _cn0(levels: tuple[float, ...]) -> dict[str, Change]:
    return {f"{x:g}": {"cn0_dbhz": x} for x in levels}


def campaigns() -> dict[str, Campaign]:
    """Searches around the thresholds, and the final runs of the best.

    Before the search is flown the first setting of each closure stands for the best.
    """
    made = {}
    for kind, closures in SEARCH.items():
        weight = 0.6 if kind == "joint" else 0.8
        levels = _cn0(SEARCH_LEVELS[kind])
        for name, settings in closures.items():
            over = {"setting": settings, "cn0_dbhz": levels}
            made[f"search {name}"] = Campaign("uniform", over, SEARCH_RUNS, SEARCH_SEED, weight)
        first = {name: next(iter(settings.values())) for name, settings in closures.items()}
        over = {"receiver": first, "cn0_dbhz": _cn0(LEVELS[kind])}
        made[kind] = Campaign("uniform", over, RUNS[kind], FIRST_SEED, weight)
    return made


def main() -> None:
    """Search, fly, draw, judge."""
    study = Study(__file__, campaigns())
    best: dict[str, str] = {}
    shares: dict[str, xr.DataArray] = {}
    for kind, closures in SEARCH.items():
        for name, settings in closures.items():
            best[name] = next(iter(settings)) if study.quick else search(study, name)
        chosen = {name: settings[best[name]] for name, settings in closures.items()}
        axes = {"receiver": chosen, "cn0_dbhz": study.campaigns[kind].over["cn0_dbhz"]}
        flown = replace(study.campaigns[kind], over=axes)
        study.campaigns[kind] = thinned(flown, cn0_dbhz=2) if study.quick else flown
        share = lost(study.fly(kind))
        share = share.assign_coords(cn0_dbhz=[float(x) for x in share["cn0_dbhz"].values])
        shares |= {name: share.sel(receiver=name) for name in closures}
    study.say("\nthreshold [dB-Hz] (10 % lost), best setting")
    for name, share in shares.items():
        q = threshold(name, share)
        found = "" if q.value is None else f"{q.value:.1f} [{q.low:.1f}, {q.high:.1f}]"
        study.say(f"{q.name:40} {found}  {best[name]}")
    draw(study, shares, best)
    study.conclude([computed(shares, best), aiding(shares), coupling(shares), grades(shares),
                    kinds(shares)])  # fmt: skip


def search(study: Study, name: str) -> str:
    """The setting that loses least over the levels of the search; all of them are told."""
    share = lost(study.fly(f"search {name}")).mean(["cn0_dbhz", "run"])
    told = ", ".join(f"{s.values}: {float(x):.2f}" for s, x in zip(share["setting"], share,
                                                                  strict=True))  # fmt: skip
    study.say(f"search {name}: share lost {told}")
    return str(share["setting"].values[int(np.argmin(share.values))])


# -- what is shown --------------------------------------------------------------------------------


def draw(study: Study, shares: dict[str, xr.DataArray], best: dict[str, str]) -> None:
    """Loss against C/N0 with Wilson's intervals: loops of their own, then those that are aided."""
    page = Figure(figsize=(7.5, 7.6), layout="constrained")
    axes = page.subplots(2, 1, sharex=True)
    for ax, kinds_shown in zip(axes, (("loops",), ("aided", "joint")), strict=True):
        names = [name for kind in kinds_shown for name in SEARCH[kind]]
        for k, name in enumerate(names):
            share = shares[name].transpose("cn0_dbhz", "run")
            p, down, up = band(share.values, 1 if name in SEARCH["joint"] else len(LINE))
            x = share["cn0_dbhz"].values + 0.08 * (k - 2)  # intervals side by side
            ax.errorbar(x, p, (np.maximum(p - down, 0.0), np.maximum(up - p, 0.0)),
                        fmt=STYLES[k % 4], color=COLOURS[k % 7], marker=".", capsize=2.0,
                        linewidth=1.1, elinewidth=0.7, label=f"{name}: {best[name]}")  # fmt: skip
        ax.axhline(LOSS, color="black", linewidth=0.6)
        ax.set_ylabel("channels lost")
        ax.grid(True, alpha=0.3)
        ax.legend(fontsize=7.0, loc="upper right" if names[1:2] != ["PLL 3"] else "lower left")
    axes[0].axvline(COMPUTED_DBHZ, color="black", linewidth=0.8, linestyle=":")
    axes[0].annotate("computed, PLL 3", (COMPUTED_DBHZ, 0.93), (4, 0), fontsize=7.0,
                     textcoords="offset points")  # fmt: skip
    axes[1].set_xlabel("C/N0 [dB-Hz]")
    runs = {share.sizes["run"] for share in shares.values()}
    page.suptitle(
        "JPL trajectory, 25 g and 100 g/s along the line of sight, four satellites in each of "
        f"{' or '.join(map(str, sorted(runs)))} runs",
        fontsize=9.0,
    )
    study.figure("high_dynamics", page)


# -- claims ---------------------------------------------------------------------------------------


def computed(shares: dict[str, xr.DataArray], best: dict[str, str]) -> Claim:
    """The best third-order PLL against the linear rules."""
    q = threshold("PLL 3", shares["PLL 3"])
    return Claim(
        id="dynamics-pll",
        claim="The best third-order Costas PLL holds the JPL trajectory down to 31.2 dB-Hz",
        source="linear rules (Kaplan & Hegarty, 3rd ed., ch. 8), computed",
        theirs="31.2 to 31.5 dB-Hz at 100 g/s, 40-52 Hz, 1-5 ms: 3 sigma + stress <= 45 deg",
        ours=(
            Quantity(q.name, q.value, q.low, q.high, q.unit, Must("within", (30.2, 32.5))),
            number("bandwidth found", float(best["PLL 3"].split()[0]), unit="Hz"),
        ),
        why=f"within 1 dB of a rule of thumb; {len(SEARCH['loops']['PLL 3'])} settings tried; a "
        "jerk of 0.5 s ends before its stress is whole",
    )


def aiding(shares: dict[str, xr.DataArray]) -> Claim:
    """What the INS is worth to the same loop."""
    pairs = [gap(shares, "PLL 3", f"aided PLL, {g}", Must("within", ON_PAPER_DB))
             for g in ("tactical", "MEMS")]  # fmt: skip
    return Claim(
        id="dynamics-aiding",
        claim="On this trajectory inertial aiding is worth 7 to 10 dB to a PLL",
        source="linear rules, computed",
        theirs="7.2 dB if 99 % of the jerk is removed, about 10 dB at 99.9 %",
        ours=tuple(pairs),
        why="the rule's threshold falls with bandwidth and with the squaring loss of 5 ms",
    )


def coupling(shares: dict[str, xr.DataArray]) -> Claim:
    """Ultra-tight beyond aiding."""
    return Claim(
        id="dynamics-tight",
        claim="The ultra-tight closure holds to lower C/N0 than the best PLL that an INS aids",
        source="this project",
        theirs="all satellites share one state, no loop of their own",
        ours=(
            gap(shares, "aided PLL, tactical", "ultra-tight, tactical", Must("above", 0.0, "low")),
            gap(shares, "PLL 3", "ultra-tight, tactical"),
            gap(shares, "VDFLL", "ultra-tight, tactical"),
            *(threshold(name, shares[name]) for name in SEARCH["joint"]),
        ),
        target=True,
        why="as in uniform motion: the channels of the whole sky are averaged",
    )


def grades(shares: dict[str, xr.DataArray]) -> Claim:
    """Tactical against MEMS."""
    return Claim(
        id="dynamics-grade",
        claim="A MEMS IMU costs the ultra-tight closure less than 1 dB of threshold here",
        source="this project",
        theirs="14 s of 29 g: what is wrong with the sensors moves the carrier by a few Hz",
        ours=(gap(shares, "ultra-tight, MEMS", "ultra-tight, tactical",
                  Must("below", 1.0)),),
        target=True,
        why="biases and lag are small against the noise of 20 ms at these levels",
    )  # fmt: skip


def kinds(shares: dict[str, xr.DataArray]) -> Claim:
    """The order of the unaided loops."""
    return Claim(
        id="dynamics-order",
        claim="Frequency tracking holds to lower C/N0 than a PLL, and so does a Kalman filter",
        source="Vilnrotter, Hinedi & Kumar 1989, as commonly quoted",
        theirs="approximate ML best, then EKF, cross-product AFC, PLL, within a few dB",
        ours=(
            gap(shares, "PLL 3", "FLL 2", Must("above", 0.0)),
            gap(shares, "PLL 3", "Kalman", Must("above", 0.0)),
            *(threshold(name, shares[name]) for name in SEARCH["loops"]),
        ),
        why="an FLL needs no phase to hold; the Kalman loop's bandwidth follows C/N0",
    )


if __name__ == "__main__":
    carry_out(main)
