"""What each family of adaptations is expected to do against each disturbance, and did."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from common.adaptation_cells import (
    FAMILIES,
    FLOWN,
    QKF,
    SAMPLED,
    TWIN,
    Flown,
)
from common.adaptation_figures import unit
from common.adaptation_measures import ratio
from common.ledger import Claim, Must, Quantity
from common.statistics import count, number, typical
from common.worlds import MODELS

HELPS, HARMLESS = Must("below", 0.8, "high"), Must("below", 1.25, "high")
QUESTIONS: tuple[tuple[str, str, str, Must], ...] = (
    ("jump", "Q", "Opening Q or the covariance helps against the jump", HELPS),
    ("jump", "R and Q", "Sage-Husa with R and Q helps against the jump", HELPS),
    ("jump", "R", "Estimating R alone helps against the jump", HELPS),
    ("jump", "weights", "Weights per channel help against the jump", HELPS),
    ("no cause", "Q", "Without the cause, opening Q does no harm", HARMLESS),
    ("no cause", "R", "Without the cause, estimating R does no harm", HARMLESS),
    ("no cause", "weights", "Without the cause, weights per channel do no harm", HARMLESS),
    ("power all", "R", "Estimating R helps against a loss of power", HELPS),
    ("power all", "weights", "Weights per channel help against a loss of power", HELPS),
    ("power all", "Q", "Opening Q does no harm when power is lost", HARMLESS),
    ("power all", "R and Q", "Sage-Husa with R and Q does no harm when power is lost", HARMLESS),
    ("fault step", "R", "Estimating R, per channel, helps against a faulty satellite", HELPS),
    ("fault step", "weights", "Weights per channel help against a faulty satellite", HELPS),
    ("fault step", "Q", "Opening Q does no harm beside a faulty satellite", HARMLESS),
)
"""Disturbance, family, claim, what each of its rows has to fulfil"""


def asked(model: str, flown: Flown) -> Iterator[Claim]:
    """One claim per question: every row of the family must fulfil it."""
    for which, family, text, must in QUESTIONS:
        if which not in flown:
            continue
        ds = flown[which]
        ours: list[Quantity] = []
        for label in FAMILIES[family]:
            if label not in FLOWN[model]:
                continue
            ours.append(typical(f"{label} / QKF", ratio(ds, label), "", must))
            held = ds["converged"].sel(filter=label).values
            ours.append(count(f"{label} converged", held, Must("above", 0.9)))
        base = ds.sel(filter=QKF)
        ours.append(typical("QKF", base["merit"].values, unit(which)))
        ours.append(count("QKF converged", base["converged"].values))
        yield Claim(
            id=f"adaptive-{model}-{which}-{family}".replace(" ", "-"),
            claim=f"{text}, model {model}",
            source="this project's aim",
            theirs=f"error at most {must.bound} of the QKF's, every row",
            ours=tuple(ours),
            target=True,
            why=WHY[which, family],
        )


JUMP_R = (
    "the error that the scale factor makes in all channels at once is taken for noise: R grows, "
    "the gain falls, and velocity runs off"
)
POWER = (
    "weaker signals leave the noise of the taps as it is: what is wrong until the amplitude has "
    "followed is the slope, which no R describes"
)
FAULT = "the fault is one channel's alone, and there R or the weight may follow without harm"
WHY = {
    ("jump", "Q"): "the error is one of the motion: a wider velocity covariance takes it in",
    ("jump", "R and Q"): "Q^ takes the error in; R^ alone would shut it out",
    ("jump", "R"): JUMP_R,
    ("jump", "weights"): JUMP_R,
    ("no cause", "Q"): "what is left of the jump is the IMU's lag, 0.08 m/s",
    ("no cause", "R"): "what is left of the jump, 0.08 m/s of lag, is shut out like the rest",
    ("no cause", "weights"): "as for R",
    ("power all", "R"): POWER,
    ("power all", "weights"): POWER,
    ("power all", "Q"): "an amplitude that is lost is a large innovation, taken for motion; that "
    "of a signal that returns is taken from its first symbol",
    ("power all", "R and Q"): "Q^ is wide at all times: the error is larger before, too",
    ("fault step", "R"): FAULT,
    ("fault step", "weights"): FAULT,
    ("fault step", "Q"): "an opened covariance lets the faulty satellite pull the position",
}


def identical(model: str, twins: Flown) -> Claim:
    """The further terms of Wei et al. in closed loop."""
    gaps = [ds["merit"].sel(filter=TWIN) / ds["merit"].sel(filter="Sage-Husa") - 1.0
            for ds in twins.values()]  # fmt: skip
    worst = np.abs(np.concatenate([gap.values for gap in gaps])).max()
    return Claim(
        id=f"adaptive-{model}-improved-1",
        claim=f"Improved 1 is Sage-Husa in the loop too, model {model}",
        source="this project's aim",
        theirs="errors equal to 1 %",
        ours=(number("largest relative difference", worst, Must("below", 0.01)),),
        target=True,
        why=f"its further terms are zero when the gain is made with R^_k; {', '.join(twins)}, "
        f"{next(iter(twins.values())).sizes['run']} seeds",
    )


def price(model: str, flown: Flown) -> Claim:
    """What adaptation costs while nothing happens."""
    runs = [flown[which] for which in ("power all",)]
    return Claim(
        id=f"adaptive-{model}-price",
        claim=f"Before anything happens adaptation costs less than a quarter, model {model}",
        source="this project's aim",
        theirs="velocity error at most 1.25 of the QKF's, every row",
        ours=tuple(
            typical(f"{label} / QKF", np.concatenate([ratio(ds, label, "quiet") for ds in runs]),
                    "", HARMLESS)
            for label in FLOWN[model] if label != QKF
        ),
        target=True,
        why="uniform motion, 4 s to 7 s: an estimated Q is wide at all times, R^ noisy",
    )  # fmt: skip


def serves(model: str, flown: Flown) -> Claim:
    """Is there one row for everything?"""
    ours = []
    for label in FLOWN[model]:
        if label in (QKF, "KF"):
            continue
        found = [(typical("", ratio(ds, label), "").high, which) for which, ds in flown.items()]
        worst, which = max(((np.inf if high is None else high), which) for high, which in found)
        ours.append((worst, which, label))
    _, which, label = min(ours)
    value = typical(f"best row, {label}, at its worst, {which}: over QKF",
                    ratio(flown[which], label), "", HARMLESS)  # fmt: skip
    jump = typical(
        f"{label} / QKF, jump", ratio(flown["jump"], label), "", Must("below", 0.5, "high")
    )
    fault = typical(f"{label} / QKF, 100 m", ratio(flown["fault step"], label), "",
                    Must("below", 0.5, "high"))  # fmt: skip
    return Claim(
        id=f"adaptive-{model}-one-for-all",
        claim=f"One adaptation serves against every disturbance, model {model}",
        source="this project's aim",
        theirs="nowhere worse than 1.25 of the QKF, half its error in jump and fault",
        ours=(value, jump, fault),
        target=True,
        why="chosen on these runs as the row whose worst ratio is least: what shuts a fault out "
        "shuts a jump out too",
    )


def from_samples(flown: dict[str, Flown], sampled: dict[str, Flown]) -> Claim:
    """Do IF samples tell the same story?"""
    same, ratios = [], []
    for model in MODELS:
        for which in sampled[model]:
            for label in SAMPLED:
                a = sampled[model][which].sel(filter=label).isel(run=0)
                b = flown[model][which].sel(filter=label).isel(run=0)
                same.append(bool(a["converged"] == b["converged"]))
                ratios.append(float(a["merit"] / b["merit"]))
    return Claim(
        id="adaptive-samples",
        claim="IF samples tell the same story as the closed form",
        source="this project's aim",
        theirs="the same mean and covariance of taps",
        ours=(count("same outcome", np.array(same), Must("above", 0.9)),
              typical("error, samples / closed form", np.array(ratios), "",
                      Must("within", (0.8, 1.25)))),
        target=True,
        why=f"one seed of every disturbance in both models, {', '.join(SAMPLED)}; other noise",
    )  # fmt: skip
