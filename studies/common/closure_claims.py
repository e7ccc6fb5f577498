"""Claims of `closures`; the bounds were written before the final seeds were flown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import xarray as xr

from common.closure_cells import BLOCKED, INS, OUTAGES_S
from common.closure_measures import Found, middle, spread, useful
from common.ledger import Claim, Must, Quantity
from common.statistics import interval, number, typical
from common.thresholds import gap, threshold

LASHLEY = "Lashley, Bevly & Hung, PLANS 2010, equivalent loops"
THEIRS_DB = {11: 6.2, 5: 2.4}
WITHIN_DB, PREDICTED_DB = 1.5, 2.0
COMMON = 4
"""Unknowns that channels share: three of velocity and the clock's drift"""
Cells = Mapping[tuple[str, str], xr.DataArray]


def pair(cells: Cells, a: tuple[str, str], b: tuple[str, str], name: str,
         must: Must | None = None) -> Quantity:  # fmt: skip
    """Difference of the thresholds of two cells."""
    q = gap({"a": cells[a], "b": cells[b]}, "a", "b", must)
    return replace(q, name=name)


def averaged(satellites: int) -> float:
    """What averaging equal channels over `COMMON` unknowns wins [dB]."""
    return float(10.0 * np.log10(satellites / COMMON))


def vector_gain(f: Found, bench: Mapping[str, xr.DataArray], satellites: int) -> Claim:
    """Loops alone against Lashley's figure, and the receivers beside it."""
    motion = "uniform" if satellites == 11 else f"{satellites} satellites"
    theirs = THEIRS_DB[satellites]
    own = gap(bench, "scalar 11", f"vector 11, {satellites} satellites",
              Must("within", (theirs - WITHIN_DB, theirs + WITHIN_DB)))  # fmt: skip
    return Claim(
        id=f"closures-vector-{satellites}",
        claim=f"A vector loop with {satellites} satellites has a threshold {theirs} dB lower than "
        "equivalent scalar loops",
        source=LASHLEY,
        theirs=f"{theirs} dB",
        ours=(
            replace(own, name="loops alone, white jerk"),
            replace(gap(bench, "scalar 8", f"vector 8, {satellites} satellites"),
                    name="loops alone, white acceleration"),
            number("10 lg(n/4)", averaged(satellites), unit="dB"),
            pair(f.lost, (motion, "scalar FLL"), (motion, "VDFLL"), "receivers, FLL − VDFLL"),
            pair(f.lost, (motion, "scalar"), (motion, "VDFLL"), "receivers, PLL − VDFLL"),
            threshold("VDFLL", f.lost[motion, "VDFLL"]),
        ),
        change="equivalent as `common/closure_bench.py` says; the paper's loops are others",
        why="channels share four unknowns: averaging over them is worth 10 lg(n/4), and the "
        "filter narrows itself with the noise; receivers gain more, as the scalar one's indicator "
        "gives channels up that its loop still holds",
    )  # fmt: skip


def order(f: Found) -> list[Claim]:
    """Uniform motion: who holds to lower C/N0."""
    u = "uniform"
    steps = [pair(f.lost, (u, a), (u, b), f"{a} − {b}", Must("above", 0.0, "low"))
             for a, b in (("scalar", "scalar FLL"), ("scalar FLL", "VDFLL"),
                          ("VDFLL", "ultra-tight D"), ("VDFLL", "federated 40 ms"))]  # fmt: skip
    return [
        Claim(
            id="closures-order",
            claim="Thresholds in uniform motion fall from PLL over FLL and VDFLL to the closures "
            "with an INS inside",
            source="this project",
            theirs="the textbooks' order of integration",
            ours=(*steps, *(threshold(c, f.lost[u, c]) for c in ("scalar", "scalar-ins",
                                                                "scalar FLL", "VDFLL", "VDFLL-8",
                                                                *INS))),
            target=True,
            why="no replica of a closure with an INS inside leaves its signal within 20 s at any "
            "C/N0: a tactical INS flies on without signals",
        ),
        Claim(
            id="closures-aiding",
            claim="INS aiding alone gains nothing in uniform motion",
            source="this project",
            theirs="same bandwidth, same noise: within 1 dB",
            ours=(pair(f.lost, (u, "scalar"), (u, "scalar-ins"), "scalar − scalar-ins",
                       Must("within", (-1.0, 1.0))),),
            target=True,
            why="aiding takes away stress, of which there is none; noise is the loop's own",
        ),
        Claim(
            id="closures-useful",
            claim="The ultra-tight closures use their signals down to 5 dB below the VDFLL's "
            "threshold",
            source="this project",
            theirs="velocity error below half of that of the INS alone",
            ours=(
                *(useful(c, f.velocity[u, c], f.alone) for c in INS),
                _useful_gap(f, "ultra-tight C", Must("above", 5.0)),
                _useful_gap(f, "ultra-tight D"),
            ),
            target=True,
            why="holding the signal and gaining from it are two things: below these levels the "
            "INS carries the replicas",
        ),
        Claim(
            id="closures-indicator",
            claim="The closures' own indicators declare a loss where there is one",
            source="this project",
            theirs="own threshold within 1 dB of that by the truth",
            ours=tuple(
                _own_gap(f, c, Must("within", (-1.0, 1.0)) if c not in INS else None)
                for c in ("scalar", "scalar FLL", "VDFLL", *INS)
            ),
            target=True,
            why="a scalar channel is lost because its indicator says so; with an INS inside it "
            "says that nothing is heard, not that the signal has gone",
        ),
    ]  # fmt: skip


def _own_gap(f: Found, closure: str, must: Must | None) -> Quantity:
    cell = "uniform", closure
    q = gap({"own": f.own[cell], "truth": f.lost[cell]}, "own", "truth", must)
    return replace(q, name=f"{closure}, own − truth")


def _useful_gap(f: Found, closure: str, must: Must | None = None) -> Quantity:
    """VDFLL's threshold less the level down to which a closure uses its signals."""
    q = threshold("", f.lost["uniform", "VDFLL"])
    low = useful("", f.velocity["uniform", closure], f.alone).value
    value = None if q.value is None or low is None else q.value - low
    return Quantity(f"VDFLL − {closure} useful", value, None, None, "dB", must)


def errors(f: Found) -> list[Claim]:
    """Velocity and position at 35 dB-Hz, runs in pairs."""

    def ratio(kind: str, a: str, b: str, must: Must) -> Quantity:
        x, y = (f.errors[c][kind].sel(cn0_dbhz=35.0).values for c in (a, b))
        return typical(f"{a} / {b}", x / y, "", must)

    more = Must("above", 1.0, "low")
    return [
        Claim(
            id="closures-velocity",
            claim="Closures with an INS inside have a smaller velocity error than scalar loops",
            source="this project",
            theirs="at 35 dB-Hz, uniform motion",
            ours=tuple(ratio("jump", "scalar", c, more) for c in (*INS, "scalar-ins")),
            target=True,
            why="the INS averages over seconds; a Costas phase turns a PLL's Doppler into "
            "velocities that the differential form does not have",
        ),
        Claim(
            id="closures-velocity-vector",
            claim="A VDFLL has a smaller velocity error than scalar loops",
            source="the case for vector tracking",
            theirs="at 35 dB-Hz, uniform motion",
            ours=(ratio("jump", "scalar", "VDFLL", more),),
            why="the white jerk that carries it through dynamics opens its velocity; a PLL has "
            "the phase, the VDFLL only frequency",
        ),
        Claim(
            id="closures-position",
            claim="Closures that share a state have a smaller position error than scalar loops",
            source="this project",
            theirs="at 35 dB-Hz, uniform motion, last 2.5 s",
            ours=tuple(ratio("position_end", "scalar", c, more) for c in ("VDFLL", *INS)),
            target=True,
            why="code noise is averaged over the whole run where velocity ties epochs together; "
            "a scalar receiver solves each epoch anew",
        ),
    ]  # fmt: skip


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
            why="the others' loops are as narrow as before; geometry counts beside their number",
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
            ours=tuple(number(f"{c}, worst", spread(at[c].sel(outage=long))[1],
                              Must("below", 0.5), "s") for c in INS),
            target=True,
            why="the tactical INS and the TCXO drift by less than 4.8 m/s and 147 m in 30 s",
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
            why="once lost a channel pulls in from where it stands, and its frequency has wandered "
            "on noise",
        ),
        Claim(
            id="closures-outage-vector",
            claim="A VDFLL is back within a second of outages of 1 and 3 s",
            source="this project",
            theirs="median over channels, 40 dB-Hz",
            ours=tuple(middle(f"VDFLL, {s:g} s outage", at["VDFLL"].sel(outage=f"{s:g}"),
                              Must("below", 1.0) if s <= 3.0 else None) for s in OUTAGES_S),
            target=True,
            why="its state flies on along the last acceleration, whose error grows as t squared",
        ),
    ]  # fmt: skip


def sampled(f: Found) -> Claim:
    """IF samples against the closed form, closure by closure."""
    velocity = f.samples["jump"].transpose("receiver", "run", "correlator")
    ratio = (velocity.sel(correlator="samples") / velocity.sel(correlator="model")).values
    gone = f.samples["off_signal_s"].notnull().sum().item()
    return Claim(
        id="closures-samples",
        claim="On the same IF samples every closure does what it does in closed form",
        source="this project",
        theirs="velocity errors agree within 25 %, nobody loses a channel at 35 dB-Hz",
        ours=(
            *(typical(str(name), of, "", Must("within", (0.75, 1.33)))
              for name, of in zip(f.samples["receiver"].values, ratio, strict=True)),
            number("channels lost", gone, Must("below", 0.0)),
        ),
        target=True,
        why="the closed form has the samples' mean and covariance, not their noise",
    )  # fmt: skip


def predictions(f: Found) -> Claim:
    """`ultratight predict` beside what was flown."""
    ours = []
    for cell, predicted in f.predicted.items():
        flown = threshold("", f.either[cell])
        name = f"{cell[1]}, {cell[0]}: flown − predicted"
        if flown.value is None or flown.low is None or flown.high is None:
            continue
        ours.append(Quantity(name, *(x - predicted if np.isfinite(predicted) else None
                                     for x in (flown.value, flown.low, flown.high)), "dB",
                             Must("within", (-PREDICTED_DB, PREDICTED_DB))))  # fmt: skip
    return Claim(
        id="closures-predict",
        claim="`ultratight predict` gives every threshold within 2 dB",
        source="this project",
        theirs="lost: off the signal by the truth, or declared lost",
        ours=tuple(ours),
        target=True,
        why="jitter and indicators of a linear closure in its steady state; slips, pull-in and the "
        "nonlinear end are not in it",
    )


def all_claims(f: Found, bench: Mapping[str, xr.DataArray], quick: bool) -> list[Claim]:
    """In the order of the page; a quick look has no cells for some."""
    made: list[Callable[[], Claim | list[Claim]]] = [
        lambda: vector_gain(f, bench, 11), lambda: vector_gain(f, bench, 5), lambda: order(f),
        lambda: errors(f), lambda: jumps(f), lambda: blocked(f), lambda: returned(f),
        lambda: sampled(f), lambda: predictions(f),
    ]  # fmt: skip
    claims: list[Claim] = []
    for make in made:
        try:
            one = make()
        except KeyError:
            if not quick:
                raise
            continue
        claims += one if isinstance(one, list) else [one]
    return claims
