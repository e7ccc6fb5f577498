"""Claims of `closures`; the bounds were written before the final seeds were flown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import xarray as xr

from common.closure_cells import INS
from common.closure_event_claims import blocked, jumps, returned
from common.closure_measures import WITHIN_DB, Found, averaged, pair, useful
from common.ledger import Claim, Must, Quantity
from common.statistics import number, typical
from common.thresholds import gap, threshold

LASHLEY = "Lashley, Bevly & Hung, PLANS 2010, equivalent loops"
THEIRS_DB = {11: 6.2, 5: 2.4}
PREDICTED_DB = 2.0


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
        why="four unknowns shared are worth 10 lg(n/4), and the filter narrows itself with the "
        "noise; receivers gain more: the scalar one's indicator gives channels up 5 dB above where "
        "its loop alone would, the VDFLL judges a channel by its C/N0",
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
            why="not the differential form: it sees only the turn of a phase within a bit, a PLL "
            "the phase; federated lines are longer, the coherent form has phase and INS",
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
        why="a linear closure in its steady state: slips and pull-in are not in it; the coherent "
        "form falls back first and is then declared lost as the differential one, and a scale "
        "factor takes a coherent phase long before a replica",
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
