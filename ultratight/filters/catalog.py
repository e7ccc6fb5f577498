"""The papers' names mapped to recipes: a rule, how often relinearised, is the model believed.

``make_filter("fiqkf-r")`` gives what the receiver calls once per epoch.  A filter of one's own
needs no base class: anything with `Filter.step` and `Filter.reset` serves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from ultratight.filters import own
from ultratight.filters.adaptive import SageHusa
from ultratight.filters.classified import AEKF, GATE, REKF, Classified
from ultratight.filters.door import check_step, finite, whole
from ultratight.filters.factored import PLAIN, make_pair
from ultratight.filters.fading import AS_PRINTED, BLOCK, CLAMPED, FITTED, Fading, FadingOptions
from ultratight.filters.gaussian import (
    Filter,
    Gaussian,
    Measurement,
    Prediction,
    Update,
)
from ultratight.filters.interval import IntervalQ, VelocityQ, intersect_boxes, intersect_printed
from ultratight.filters.jump_triggered import IO, J1, JTQ, JTQ_E, JTQ_R, JumpOptions
from ultratight.filters.multiple_model import IMM3, MMAE, ImmOptions
from ultratight.filters.robust import Ishakf
from ultratight.filters.rules import Rule, get_rule

__all__ = [
    "CATALOG",
    "Filter",
    "Gaussian",
    "Measurement",
    "Prediction",
    "Recipe",
    "RecipeFilter",
    "Update",
    "make_filter",
]

XU = "Xu, Zeng & Huang, Geom. Inf. Sci. Wuhan Univ. 42(12), 2017"
OURS = "regularised form of " + XU


class Several(Protocol):
    """Options of a filter that carries several hypotheses, or makes them when it must."""

    def make(self, rule: Rule, iterations: int) -> Filter:
        """The filter with these options."""
        ...


@dataclass(frozen=True)
class Recipe:
    """A filter in words; every field is an answer to one question."""

    description: str
    source: str
    rule: str = "gh7"  # row of `rules.RULES`
    iterations: int = 1  # at most so many linearisations per update
    fading: FadingOptions | None = None
    intersect: Callable[[Gaussian, Update], Update] | None = None  # applied to the update
    interval_q: IntervalQ | None = None  # applied before the prediction
    velocity_q: VelocityQ | None = None  # so is this
    noise: SageHusa | Ishakf | None = None  # R and Q from innovations, or R from residuals
    weights: Classified | None = None  # R raised for suspect residuals
    form: str = PLAIN  # row of `factored.FORMS`: a factor of P is kept in place of P
    states: int = 17  # 20: with three accelerometer scale factors
    several: Several | None = None  # a bank of hypotheses in place of one Gaussian


_QKF = "quadrature filter, Gauss-Hermite in the projected space of each channel"
_INTQ = "bound of 3000 ppm on scale factor as covariance"
_INT2 = "bounds of 3000 ppm and 10 ms latency as covariance"
_INT3 = "bounds of 3000 ppm, 10 ms and 1 ppb/g (oscillator) as covariance"
_20 = "with accelerometer scale factors as states"
_VRW = "velocity random walk added at all times"
BY_SCALE = IntervalQ(latency_s=0.0)
BY_CLOCK = IntervalQ(g_sensitivity_ppb_per_g=1.0)
_EKF = "extended Kalman filter"
DUAN = "Duan, Gong, Xu & Zhao, improved Sage-Husa filter for trajectory data; reconstructed"
GUO = "Guo, Liu, Shi & Sun, adaptive classified fault-tolerant EKF; reconstructed from its text"
SOKEN = "Soken & Hajiyev, ISA Transactions 49 (2010); multiple scale factors"
YU = "after Yu (2012), as Guo et al. describe it"
WEI = "Wei, Qin, Zhang & Zhang, J. Chinese Inertial Technology 20(6), 2012"
_IMM = "Blom & Bar-Shalom, IEEE TAC 33 (1988)"
_JTQ = "relinearised quadrature filter, opened when the measured specific force jumps"
_SIZES = "ours; a surprise per 100 m/s2 of 2 m/s2, 1 m/s and 3 m/s of clock drift (1 sigma)"
CATALOG: dict[str, Recipe] = {
    "kf": Recipe("extended Kalman filter", "Groves, 2nd ed., ch. 3 and 14", "linearised"),
    "qkf": Recipe(f"{_QKF}, 7 points", XU),
    "qkf3": Recipe(f"{_QKF}, 3 points", XU, "gh3"),
    "qkf5": Recipe(f"{_QKF}, 5 points", XU, "gh5"),
    "qkf7": Recipe(f"{_QKF}, 7 points", XU, "gh7"),
    "ckf": Recipe(
        "third-degree cubature in R^n", "Arasaratnam & Haykin, IEEE TAC 54 (2009)", "cubature"
    ),
    "ukf": Recipe(
        "unscented in R^n, kappa = 3 - n; S may be indefinite", "Julier & Uhlmann (1997)",
        "unscented",
    ),
    "fiqkf": Recipe(
        "as printed: all-state fading, no gate, interval (40)-(42); diverges at 50 Hz", XU,
        fading=AS_PRINTED, intersect=intersect_printed,
    ),
    "fiqkf-fading": Recipe(
        "fading as printed, without the interval part; diverges at 50 Hz", XU, fading=AS_PRINTED
    ),
    "qkf-interval-printed": Recipe(
        "interval (40)-(42) alone: a halved gain", XU, intersect=intersect_printed
    ),
    "fiqkf-r": Recipe(
        "fading of position, velocity, clock and phases behind a 3-sigma gate", OURS, fading=BLOCK
    ),
    "fiqkf-c": Recipe(
        "fading of all states behind the gate, variances clamped at the first", OURS,
        fading=CLAMPED,
    ),
    "fiqkf-r-box": Recipe(
        "fiqkf-r with the 3-sigma boxes of prior and posterior intersected", OURS,
        fading=BLOCK, intersect=intersect_boxes,
    ),
    "ls-fade": Recipe(
        "as fiqkf-r, lambda fitted to 20 epochs of innovations; loses the first second at times",
        OURS, fading=FITTED,
    ),
    "fikf-r": Recipe("extended Kalman filter with the fading of fiqkf-r", OURS, "linearised",
                     fading=BLOCK),
    "kf-intq": Recipe(f"extended Kalman filter, {_INTQ}", OURS, "linearised",
                      interval_q=BY_SCALE),
    "qkf-intq": Recipe(f"quadrature filter, {_INTQ}", OURS, interval_q=BY_SCALE),
    "qkf-int2": Recipe(f"quadrature filter, {_INT2}", OURS, interval_q=IntervalQ()),
    "qkf-int3": Recipe(f"quadrature filter, {_INT3}", OURS, interval_q=BY_CLOCK),
    "fiqkf-r-intq": Recipe(f"fiqkf-r, {_INTQ}", OURS, fading=BLOCK, interval_q=BY_SCALE),
    "fiqkf-r-int2": Recipe(f"fiqkf-r, {_INT2}", OURS, fading=BLOCK, interval_q=IntervalQ()),
    "fiqkf-r-int3": Recipe(f"fiqkf-r, {_INT3}", OURS, fading=BLOCK, interval_q=BY_CLOCK),
    "qkf-vrw0.03": Recipe(f"quadrature filter, 0.03 m/s/sqrt(s) of {_VRW}", OURS,
                          velocity_q=VelocityQ(0.03)),
    "qkf-vrw0.1": Recipe(f"quadrature filter, 0.1 m/s/sqrt(s) of {_VRW}", OURS,
                         velocity_q=VelocityQ(0.1)),
    "qkf-sqrt": Recipe(f"{_QKF}, 7 points; square-root form",
                       "Arasaratnam & Haykin, Proc. IEEE 95 (2007); Carlson (1973)",
                       form="square-root"),
    "qkf-ud": Recipe(f"{_QKF}, 7 points; UD form", "Bierman (1977); Thornton & Bierman (1976)",
                     form="ud"),
    "qkf-cf": Recipe("quadrature filter, moments of model C in closed form", OURS, "closed-form"),
    "fiqkf-r-cf": Recipe("fiqkf-r, moments of model C in closed form", OURS, "closed-form",
                         fading=BLOCK),
    "qkf-20": Recipe(f"quadrature filter {_20}", "Groves, 2nd ed., ch. 14", states=20),
    "fiqkf-r-20": Recipe(f"fiqkf-r {_20}", OURS, fading=BLOCK, states=20),
    "imm2": Recipe("two quadrature filters, without and with velocity noise, mixed", _IMM,
                   several=ImmOptions()),
    "imm3": Recipe("three of them", _IMM, several=IMM3),
    "mmae": Recipe("five quadrature filters of different velocity noise, weighed, not mixed",
                   "Magill, IEEE TAC 10 (1965)", "gh3", several=MMAE),
    "jtq": Recipe(f"{_JTQ}, four hypotheses", _SIZES, "gh3", 4, several=JTQ),
    "jtq-e": Recipe(f"{_JTQ}, four hypotheses, half-bit prompts kept apart", _SIZES, "gh3", 4,
                    several=JTQ_E),
    "jtq-r": Recipe("jtq-e opened along the change of force, deaf to usual vibration, restless"
                    " after a score test; meant for receiver.fall_back = true",
                    _SIZES, "gh3", 4, several=JTQ_R),
    "j1": Recipe(f"{_JTQ}, one hypothesis with everything opened", _SIZES, "gh3", 4, several=J1),
    "kf-sage-husa": Recipe(f"{_EKF} of estimated R and Q", WEI, "linearised", noise=SageHusa()),
    "kf-sage-husa-1": Recipe(
        f"{_EKF} of estimated R and Q, with the terms that (28) adds; zero with the gain of R^_k",
        WEI, "linearised", noise=SageHusa(complete=True),
    ),
    "kf-sage-husa-2": Recipe(
        f"{_EKF} of R and Q blended with the first ones, (29)", WEI, "linearised",
        noise=SageHusa(a=(0.1, 0.4), complete=True),
    ),
    "kf-sage-husa-r": Recipe(f"{_EKF} of estimated R", WEI, "linearised", noise=SageHusa(Q=False)),
    "kf-sage-husa-q": Recipe(f"{_EKF} of estimated Q", WEI, "linearised", noise=SageHusa(R=False)),
    "kf-residual-r": Recipe(f"{_EKF} of R estimated from residuals", DUAN, "linearised",
                            noise=Ishakf(adaptive=False, robust=False)),
    "kf-residual-forgetting": Recipe(
        f"{_EKF} of R estimated from residuals, with adaptive forgetting", DUAN, "linearised",
        # R is held at one outlier only: without the reduced gain more of them break the loop
        noise=Ishakf(robust=False, max_reject=1),
    ),
    "kf-robust-gain": Recipe(f"{_EKF} whose gain gives way to outliers, per channel", DUAN,
                             "linearised", noise=Ishakf(R=False, adaptive=False)),
    "kf-ishakf": Recipe(f"{_EKF} with all three", DUAN, "linearised", noise=Ishakf()),
    "kf-acekf": Recipe(
        f"{_EKF} in UD form; R raised per channel by the class of its residual", GUO, "linearised",
        weights=Classified(), form="ud",
    ),
    "kf-rekf": Recipe(
        f"{_EKF}; R raised number by number where a channel's NIS is large", SOKEN, "linearised",
        weights=REKF,
    ),
    "kf-aekf": Recipe(f"{_EKF}; R raised by one factor per channel, at all times", YU, "linearised",
                      weights=AEKF),
    "kf-gate": Recipe(f"{_EKF}; a channel whose NIS is beyond the 95 % point is left out",
                      "Bar-Shalom, Li & Kirubarajan (2001), 5.4", "linearised", weights=GATE),
    "io": Recipe("relinearised quadrature filter, reopened by a score test alone", _SIZES, "gh3",
                 4, several=IO),
}  # fmt: skip
"""Name -> recipe"""


def reads_taps(name: str) -> bool:
    """Is this a recipe of the catalogue that needs to know what the taps say, not only of what?

    Moments in closed form are those of taps, and JTQ and its kin relinearise them.
    """
    recipe = CATALOG.get(name)
    if recipe is None:
        return False
    return get_rule(recipe.rule).closed_form or isinstance(recipe.several, JumpOptions)


class RecipeFilter:
    """A recipe at work; its only memory is the fading factor's, or the estimates of the noises."""

    def __init__(self, recipe: Recipe) -> None:
        several = recipe.fading or recipe.noise or recipe.several
        if recipe.form != PLAIN and several is not None:
            raise ValueError(f"form: {recipe.form!r}, expected {PLAIN!r} beside {several}")
        whole("iterations", recipe.iterations, 1)
        self.recipe = recipe
        self.rule = get_rule(recipe.rule)
        self.fading = None if recipe.fading is None else Fading(recipe.fading)
        self.pair = make_pair(recipe.form)
        self.noise = None if recipe.noise is None else recipe.noise.memory()
        self.weights = None if recipe.weights is None else recipe.weights.memory(self.pair)
        # others may hand out an indefinite P themselves: negative weights, printed intersections
        self._definite = bool(recipe.noise or recipe.weights or self.at_once)

    @property
    def states(self) -> int:
        """How many error states it wants, without the channels' phases."""
        return self.recipe.states

    @property
    def at_once(self) -> Rule | None:
        """The rule of a recipe that is no more than one prediction and one update by blocks.

        Fading apart.  Such a step can be made in one compiled call, with the kernels of this one.
        """
        r = self.recipe
        more = (r.interval_q, r.velocity_q, r.noise, r.weights, r.intersect)
        if type(self).step is not RecipeFilter.step or any(part is not None for part in more):
            return None
        simple = r.iterations == 1 and r.form == PLAIN and self.rule.block_diagonal
        return self.rule if simple else None

    def reset(self) -> None:
        """Forget the innovations seen."""
        if self.fading is not None:
            self.fading.reset()
        if self.noise is not None:
            self.noise.reset()
        if self.weights is not None:
            self.weights.reset()

    def step(self, state: Gaussian, prediction: Prediction, measurement: Measurement) -> Update:
        """Widen, predict, update (twice where P is inflated), intersect."""
        recipe = self.recipe
        check_step(state, prediction, measurement, self._definite)
        if recipe.interval_q is not None:
            state, prediction = recipe.interval_q.apply(state, prediction)
        if recipe.velocity_q is not None:
            prediction = recipe.velocity_q.apply(prediction)
        adaptive = self.noise or self.weights
        if adaptive is not None:
            found = adaptive.step(state, prediction, measurement, self.rule, recipe.iterations)
            return finite(found, measurement)
        if self.fading is not None:
            prior, result = self.fading.step(
                state, prediction, measurement, self.rule, recipe.iterations
            )
        else:
            prior = self.pair.predict(state, prediction.phi, prediction.q)
            result = self.pair.update(prior, measurement, self.rule, recipe.iterations)
        return result if recipe.intersect is None else recipe.intersect(prior, result)


def _refuse_idle_parts(recipe: Recipe) -> None:
    """ValueError where one part would keep another from being used."""
    one = {n: getattr(recipe, n) for n in ("several", "noise", "weights", "fading")}
    given = [n for n, part in one.items() if part is not None]
    if recipe.intersect is not None and given != ["fading"]:
        given += ["intersect"]
    if len(given) > 1:
        raise ValueError(f"{', '.join(given)}: expected one of these in a filter")
    for n, kinds in (("noise", (SageHusa, Ishakf)), ("weights", (Classified,))):
        if one[n] is not None and not isinstance(one[n], kinds):
            names = " or ".join(kind.__name__ for kind in kinds)
            raise ValueError(f"{n}: {one[n]!r}, expected {names}")


def make_filter(name: str, **changes: Any) -> Filter:
    """The filter of that name, one per run; ``changes`` replace fields of its `Recipe`.

    A name with a colon is a user's own filter, see `own`.

    >>> make_filter("qkf-intq", iterations=3, interval_q=IntervalQ(scale_factor=5e-3))
    """
    if own.is_own(name) and not changes:
        return own.make(name)
    if name not in CATALOG:
        raise ValueError(f'"{name}" given, expected one of {", ".join(CATALOG)}')
    try:
        recipe = replace(CATALOG[name], **changes)
    except TypeError as error:
        fields = ", ".join(Recipe.__dataclass_fields__)
        raise ValueError(f"filter {name!r}: {error}; expected fields {fields}") from None
    _refuse_idle_parts(recipe)
    if recipe.several is not None and recipe.form == PLAIN:
        return recipe.several.make(get_rule(recipe.rule), recipe.iterations)
    return RecipeFilter(recipe)
