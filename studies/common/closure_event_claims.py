"""Claims of `closures` about what happens: jumps, satellites blocked, outages of all.

The bounds were written before the final seeds were flown.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from common.closure_cells import BLOCKED, INS, OUTAGES_S
from common.closure_measures import WITHIN_DB, Found, averaged, middle, pair, spread
from common.ledger import Claim, Must, Quantity
from common.statistics import interval, number, typical
from common.thresholds import threshold


def jumps(f: Found) -> list[Claim]:
    """10 g for 5 s."""
    jump, hard = "jump", "jump, 3000 ppm"
    best = f.lost[jump, "scalar"].max("cn0_dbhz") * 0.0 + f.lost[jump, "scalar"].isel(cn0_dbhz=-1)
    share = interval("PLL 18 Hz, share lost at 42 dB-Hz", best.values,
                     lambda drawn: drawn.mean(axis=-1), "", Must("above", 0.1))  # fmt: skip
    near = Must("within", (-1.0, 1.0))
    return [
        Claim(
            id="closures-jump",
            claim="A 10 g jump takes the default PLL's lock at any C/N0, and costs an INS-aided "
            "one no threshold",
            source="this project",
            theirs="stress of a step of 515 Hz/s in a loop of 18 Hz against the aid's residual",
            ours=(
                share,
                pair(f.lost, (jump, "scalar-ins"), ("uniform", "scalar-ins"),
                     "scalar-ins, jump − uniform", near),
                pair(f.lost, (hard, "scalar-ins"), ("uniform", "scalar-ins"),
                     "the same with 3000 ppm", near),
                threshold("PLL 50 Hz, 2 ms", f.lost[jump, "scalar, 50 Hz"]),
                pair(f.lost, (jump, "VDFLL"), ("uniform", "VDFLL"), "VDFLL, jump − uniform"),
                threshold("VDFLL", f.lost[jump, "VDFLL"]),
            ),
            target=True,
            why="what is left of 98 m/s2 is scale factor and misalignment; without an IMU the "
            "jump must come through the loop, or through the jerk that a vector filter allows",
        ),
        Claim(
            id="closures-jump-tight",
            claim="No closure with an INS inside loses a replica in the jump, with 3000 ppm or not",
            source="this project",
            theirs="3000 ppm of 98 m/s2 are 8 Hz after 5 s",
            ours=tuple(
                number(f"{c}, {m}: largest share lost", float(f.lost[m, c].mean("run").max()),
                       Must("below", 0.1))
                for m in (jump, hard) for c in INS
            ),
            target=True,
            why="25 Hz are 4.8 m/s: the INS alone would do; what differs is the velocity error",
        ),
        Claim(
            id="closures-fading",
            claim="With 3000 ppm the fading filter has the smaller velocity error than the QKF",
            source="Xu et al. 2017, and study `velocity_jumps`",
            theirs="at 26 dB-Hz here",
            ours=tuple(
                typical(f"{m}: QKF / FIQKF-R, {model}", _ratio(f, m, model), "",
                        Must("above", 1.0, "low") if m == hard else None)
                for m in (jump, hard) for model in "CD"
            ),
            change="regularised fading; a tactical IMU",
            why="the scale factor is the error that fading is for; at low C/N0 its price is noise",
        ),
    ]  # fmt: skip


def _ratio(f: Found, motion: str, model: str) -> np.ndarray:
    at = [f.velocity[motion, c].sel(cn0_dbhz=26.0).values
          for c in (f"ultra-tight {model}", f"{model}, FIQKF-R")]  # fmt: skip
    return np.asarray(at[0] / at[1])


def blocked(f: Found) -> list[Claim]:
    """Eight seconds without two, four, six of eleven satellites."""
    costs = []
    for n in BLOCKED:
        expected = averaged(11) - averaged(11 - n)
        must = Must("within", (expected - WITHIN_DB, expected + WITHIN_DB))
        costs.append(pair(f.lost, (f"{n} blocked", "VDFLL"), ("uniform", "VDFLL"),
                          f"{n} blocked ({expected:.1f} dB)", must))  # fmt: skip
    six = "6 blocked"

    def there(closure: str, must: Must | None) -> Quantity:
        share = f.back[six, closure].isel(cn0_dbhz=-1)
        level = float(share["cn0_dbhz"])
        return interval(f"{closure}, {level:g} dB-Hz", share.values,
                        lambda drawn: drawn.mean(axis=-1), "", must)  # fmt: skip

    return [
        Claim(
            id="closures-blocked",
            claim="Satellites that are blocked cost the VDFLL what averaging loses",
            source="this project",
            theirs="10 lg(11/(11 − n)), within 1.5 dB",
            ours=(*costs, *(threshold(f"VDFLL, {n} blocked", f.lost[f"{n} blocked", "VDFLL"])
                            for n in BLOCKED)),
            target=True,
            why="less: the same five satellites all the time cost little more, and in loops alone "
            "2.2 dB; the five that are left stand all round",
        ),
        Claim(
            id="closures-blocked-scalar",
            claim="Blocked satellites cost scalar loops nothing on the others",
            source="this project",
            theirs="threshold as in uniform motion within 0.5 dB",
            ours=tuple(pair(f.lost, (six, c), ("uniform", c), c, Must("within", (-0.5, 0.5)))
                       for c in ("scalar", "scalar-ins")),
            target=True,
            why="channels know nothing of each other",
        ),
        Claim(
            id="closures-blocked-back",
            claim="Of six satellites blocked for 8 s all are back 6 s later where channels share a "
            "state",
            source="this project",
            theirs="95 % at the highest level flown",
            ours=(*(there(c, Must("above", 0.95)) for c in ("VDFLL", *INS)),
                  *(there(c, None) for c in ("scalar", "scalar-ins"))),
            target=True,
            why="five satellites and the INS keep the replicas of the others where they belong; "
            "a scalar channel has to search",
        ),
    ]  # fmt: skip


def returned(f: Found) -> list[Claim]:
    """Outages of all satellites."""
    at = {c: t.sel(cn0_dbhz=40.0) for c, t in f.outages.items()}
    long = f"{OUTAGES_S[-1]:g}"
    return [
        Claim(
            id="closures-outage-ins",
            claim="After 30 s without any satellite closures with an INS inside are at once on all "
            "their signals",
            source="this project",
            theirs="worst channel within 0.5 s at 40 dB-Hz",
            ours=(
                *(_worst(f"{c}, worst", at[c].sel(outage=long), Must("below", 0.5)) for c in INS),
                *(number(f"{c}, never back after {s:g} s", spread(at[c].sel(outage=f"{s:g}"))[2])
                  for c in INS[2:] for s in OUTAGES_S[2:]),
            ),
            target=True,
            why="the INS drifts by less than 4.8 m/s in 30 s; power that returns is taken from its "
            "first symbol: in the scale of what had sunk to the floor it looked like a large "
            "error, which threw 3 of 8 centralised runs off after 10 s before that was mended",
        ),
        Claim(
            id="closures-outage-scalar",
            claim="Scalar loops need more than a second to be back, INS-aided ones less",
            source="this project",
            theirs="median over channels, 40 dB-Hz",
            ours=tuple(
                middle(f"{c}, {s:g} s outage", at[c].sel(outage=f"{s:g}"), must)
                for c, must in (("scalar", Must("above", 1.0)), ("scalar-ins", Must("below", 1.0)))
                for s in OUTAGES_S
            ),
            target=True,
            why="at 40 dB-Hz a channel that pulls in on noise, scaled by the power it remembers, "
            "stays within reach and begins anew every 2 s; at 30 dB-Hz the same noise drives it "
            "kHz and chips away, and the closure has no code search",
        ),
        Claim(
            id="closures-outage-vector",
            claim="A VDFLL is back within a second of outages of 1 and 3 s",
            source="this project",
            theirs="median over channels, 40 dB-Hz",
            ours=tuple(middle(f"VDFLL, {s:g} s outage", at["VDFLL"].sel(outage=f"{s:g}"),
                              Must("below", 1.0) if s <= 3.0 else None) for s in OUTAGES_S),
            target=True,
            why="clock and velocity drift little in 3 s; after more, channels that the covariance "
            "no longer places within 0.5 chip and 25 Hz search",
        ),
    ]  # fmt: skip


def _worst(name: str, times: xr.DataArray, must: Must) -> Quantity:
    """Of all channels and runs; no number where one is never back."""
    worst = spread(times)[1]
    return Quantity(name, worst if np.isfinite(worst) else None, None, None, "s", must)
