"""An ultra-tight epoch in three compiled calls, for filters that predict once and update once.

Before the update: half-bit dumps are paired, measurement and transition formed, the covariance is
predicted.  The update is that of every `TapModel`.  After it: the innovations are remembered, the
estimate is fed back, the lock indicators move.  These are the kernels that the closure otherwise
calls one after the other from Python, and the same bits; the arrays are used again in every epoch.
What happens seldom is left to Python: the outcome says how far it came.

The update is no part of a longer kernel, where it would be optimised once more, and differ in the
last bit from what `ultratight.filters.gaussian.update` gives (see `signals.compiled`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from signals.compiled import kernel
from signals.nco import Taps
from ultratight.filters.conditioning import innovation_variance, predict_into
from ultratight.filters.fading import Fading, watch_innovations
from ultratight.filters.gaussian import Gaussian, Measurement, Update
from ultratight.filters.rules import Rule
from ultratight.ins.error_state import Layout
from ultratight.tracking.epoch import ABSURD, FINE, NOT_FINITE, settle, transition_of
from ultratight.tracking.half_bits import pair_into
from ultratight.tracking.lock import follow, normalised_square
from ultratight.tracking.measurements import measure_into
from ultratight.tracking.tap_model import TapModel, condition_taps

BIT_MISSING, TO_FILTER, GATE_OPEN = range(3, 6)
"""What else may come of an epoch; the last two leave its update, or what follows, to the filter"""
CODES = 3
"""Where the facts have `code_rows`"""
BY_BIT = ("channel", "number", "span", "iq", "params", "z", "A", "R", "noise")
"""Arrays of a room with a row per bit"""


class Room(NamedTuple):
    """Arrays of an epoch with ``most`` bits; n states, d projected numbers, m = 3 most."""

    channel: np.ndarray  # (most,) int64, as in `Bits`
    number: np.ndarray  # (most,) int64
    span: np.ndarray  # (most, 3)
    iq: np.ndarray  # (most, 2, n_tap) complex
    params: np.ndarray  # (most, n_param) of the `TapModel`
    z: np.ndarray  # (most, 3), as in `Measurement`
    A: np.ndarray  # (most, d, n)
    R: np.ndarray  # (most, 3, 3)
    phi: np.ndarray  # (n, n), as in `Prediction`
    q: np.ndarray  # (n, n)
    force: np.ndarray  # (2, 3)
    work: np.ndarray  # (n + 1, n)
    zero: np.ndarray  # (n,) the mean before: all that was estimated has been fed back
    m0: np.ndarray  # (n,) prior
    P0: np.ndarray  # (n, n)
    nu: np.ndarray  # (m,) innovation
    H: np.ndarray  # (m, n)
    noise: np.ndarray  # (most, 3, 3) of Omega + R
    m1: np.ndarray  # (n,) posterior
    P1: np.ndarray  # (n, n)
    V: np.ndarray  # (m, m) remembered innovations


def new_room(most: int, n_tap: int, n_param: int, n: int, d: int) -> tuple[np.ndarray, Room]:
    """Room for an epoch, and the block that most of its arrays are views of."""
    m = 3 * most
    block = np.zeros(most * (15 + n_param + d * n) + (4 * n + 3) * n + 6)
    span, params, z, A, R, phi, q, force, work, zero, m0, P0 = _parts(block, most, n_param, n, d)
    return block, Room(
        np.empty(most, np.int64), np.empty(most, np.int64), span,
        np.empty((most, 2, n_tap), np.complex128), params, z, A, R, phi, q, force, work, zero, m0,
        P0, np.empty(m), np.empty((m, n)), np.empty((most, 3, 3)), np.empty(n), np.empty((n, n)),
        np.empty((m, m)),
    )  # fmt: skip


Part = tuple[Room, tuple[Any, ...], tuple[np.ndarray, ...], tuple[np.ndarray, np.ndarray]]
"""Room of some bits, arguments of the update, of `after_update`; channel and z"""


class AtOnce:
    """The filter's part of an epoch, for one layout of the error state.

    Parameters
    ----------
    rule, fading : how moments are taken; the fading factor's memory, prepared, None for none.
    layout : of the error state.
    facts, memory, lock, numbers : what is known of the channels, what changes, what says whether
        they are locked, plain numbers: as the kernels below take them apart.
        To hand over an array costs 60 ns, hence few of them.
    """

    def __init__(
        self,
        rule: Rule,
        fading: Fading | None,
        layout: Layout,
        facts: tuple[np.ndarray, ...],
        memory: tuple[np.ndarray, ...],
        lock: tuple[np.ndarray, ...],
        numbers: np.ndarray,
    ) -> None:
        self.rule, self.fading, self.layout = rule, fading, layout
        self.facts, self.memory, self.lock, self.numbers = facts, memory, lock, numbers
        self.d = 3 if layout.n_phase else 2
        self.table = rule.table(self.d)
        if fading is None:
            self.watched = (np.zeros(0), np.zeros((0, 0)), np.zeros(0, np.bool_), 0.0, 0.0, 0)
        else:
            o = fading.options
            row = min(o.information_row, 2)
            self.watched = (fading.inflated, fading.V0, fading.seen, o.rho, o.gate, row)
        self.rooms: dict[int, Part] = {}
        self.most, self.n_bit = 0, 0
        self.seen: tuple[np.ndarray, np.ndarray]
        """Channel and z of the bits"""

    def __call__(
        self,
        taps: Taps,
        cov: np.ndarray,
        sky: np.ndarray,
        no_phase: np.ndarray,
        t_s: float,
        T: float,
        is_first: bool,
    ) -> tuple[int, int, float, float, float]:
        """The epoch of T seconds that ends at t_s; ``cov`` becomes the posterior where it is FINE.

        Returns what came of it, the row where lock changed first (or the bit that is missing), NIS,
        mean in-phase measurement, and mean normalised square of Q in model C.
        """
        if taps.channel.size > self.most:
            self._make_room(taps.channel.size, taps.iq.shape[1])
        n_bit, missing = before_update(
            taps[:6], self.facts, self.memory, self.numbers, self._whole, cov, t_s, is_first
        )
        self.n_bit = n_bit
        if missing >= 0:
            return BIT_MISSING, missing, math.nan, math.nan, math.nan
        if n_bit == 0:
            return TO_FILTER, 0, math.nan, math.nan, math.nan
        _, update, after, self.seen = self.rooms.get(n_bit) or self._part(n_bit)
        nis = condition_taps(*update)
        if nis != nis:  # S is not positive definite
            return TO_FILTER, 0, nis, math.nan, math.nan
        may_open = False
        if self.fading is not None:
            self.fading.elapsed_s += T
            may_open = self.fading.elapsed_s > self.fading.options.start_s
        outcome, row, in_phase, square = after_update(
            after, self.lock, self.watched, self.numbers, cov, sky, no_phase, t_s, may_open
        )
        return outcome, row, nis, in_phase, square

    def _make_room(self, most: int, n_tap: int) -> None:
        """Room for so many bits."""
        self.most = most
        n, n_param = self.layout.n, self.facts[CODES].shape[1]
        block, self.whole = new_room(most, n_tap, n_param, n, self.d)
        self._whole = (self.whole.channel, self.whole.number, self.whole.iq, block)
        self.rooms.clear()

    def _part(self, nb: int) -> Part:
        """The part of the room that nb bits take."""
        r, m = self.whole, 3 * nb
        part = r._replace(
            **{name: getattr(r, name)[:nb] for name in BY_BIT}, nu=r.nu[:m], H=r.H[:m],
            V=r.V.reshape(-1)[: m * m].reshape(m, m),
        )  # fmt: skip
        table, inner = self.table
        update = (
            part.params, inner, r.m0, r.P0, r.m0, r.P0, part.z, part.A, part.R, table, part.nu,
            part.H, part.noise, r.m1, r.P1,
        )  # fmt: skip
        after = (part.channel, part.z, r.q, r.P0, part.nu, part.H, part.noise, r.m1, r.P1, part.V)
        self.rooms[nb] = part, update, after, (part.channel, part.z)
        return self.rooms[nb]

    def room(self) -> Room:
        """A copy of what the epoch has left behind."""
        part = (self.rooms.get(self.n_bit) or self._part(self.n_bit))[0]
        return Room(*(x.copy() for x in part))

    @staticmethod
    def measurement(room: Room) -> Measurement:
        """What was measured in the epoch."""
        model = TapModel(room.params)
        return Measurement(
            room.z, room.A, room.R, model, model.jacobian, room.channel, room.span
        )  # fmt: skip

    def faded(self, room: Room, nis: float) -> Update:
        """The update of an epoch in which the fading factor's gate is open."""
        if self.fading is None:
            raise ValueError("a filter without fading has no gate")
        prior = Gaussian(room.m0, room.P0)
        plain = Update(
            room.m1, room.P1, room.nu, nis=nis, H=room.H, prior_cov=room.P0, noise=room.noise
        )
        measured = self.measurement(room)
        return self.fading.faded(prior, plain, room.V, room.q, measured, self.rule)[1]


# ---- kernels ---------------------------------------------------------------------------------


def _parts(block: np.ndarray, most: int, n_param: int, n: int, d: int) -> tuple[np.ndarray, ...]:
    """Span, params, z, A, R, phi, q, force, work, zero, m0, P0 of a room."""
    a = 3 * most
    b = a + n_param * most
    c = b + 3 * most
    e = c + d * n * most
    f = e + 9 * most
    g = f + n * n
    h = g + n * n
    i = h + 6
    j = i + (n + 1) * n
    return (
        block[:a].reshape((most, 3)),
        block[a:b].reshape((most, n_param)),
        block[b:c].reshape((most, 3)),
        block[c:e].reshape((most, d, n)),
        block[e:f].reshape((most, 3, 3)),
        block[f:g].reshape((n, n)),
        block[g:h].reshape((n, n)),
        block[h:i].reshape((2, 3)),
        block[i:j].reshape((n + 1, n)),
        block[j : j + n],
        block[j + n : j + 2 * n],
        block[j + 2 * n : j + 2 * n + n * n].reshape((n, n)),
    )


parts = kernel(_parts, inline="always")
"""`_parts` for compiled steps"""


@kernel
def before_update(
    taps: Any,
    facts: Any,
    memory: Any,
    numbers: Any,
    room: Any,
    cov: np.ndarray,
    t_s: float,
    is_first: bool,
) -> tuple[int, int]:
    """The number of bits, and the one whose data is missing, -1 for none.

    taps: first six of `Taps`; room: channel, number, iq and the block of a `Room`.
    """
    whole_facts, overlay, pilot, codes, data_bits, density = facts
    dump_chips, symbol_chips, overlay_length, overlay_start = (
        whole_facts[0], whole_facts[1], whole_facts[2], whole_facts[3],
    )  # fmt: skip
    wait_number, wait_t, wait_iq, buffer, amplitude2, prompt, u_before = memory
    n_scale, n_phase, phase_start = int(numbers[0]), int(numbers[1]), int(numbers[2])
    spacing, clock_sf, lag_s, epoch_s = numbers[3], numbers[4], numbers[5], numbers[6]
    channel, number, iq, block = room
    span, params, z, A, R, phi, q, force, work, zero, m0, P0 = parts(
        block, channel.size, codes.shape[1], cov.shape[0], 3 if n_phase else 2
    )
    tap_channel, tap_number, t_start, t_end, tap_iq, noise_var = taps
    nb = pair_into(
        dump_chips, symbol_chips, overlay, overlay_length, overlay_start, tap_channel, tap_number,
        t_start, t_end, tap_iq, noise_var, wait_number, wait_t, wait_iq, buffer, channel, number,
        span, iq,
    )  # fmt: skip
    missing = measure_into(
        channel[:nb], number[:nb], span[:nb], iq[:nb], buffer, t_s, phase_start, codes, pilot,
        spacing, clock_sf, amplitude2, prompt, data_bits, int(numbers[7]), lag_s, epoch_s,
        params[:nb], z[:nb], A[:nb], R[:nb],
    )  # fmt: skip
    transition_of(
        buffer, epoch_s, u_before, n_scale, n_phase, lag_s, density, is_first, work, phi, q, force
    )
    predict_into(zero, cov, phi, q, m0, P0)
    return nb, missing


@kernel
def after_update(
    room: Any,
    memory: Any,
    watched: Any,
    numbers: Any,
    cov: np.ndarray,
    sky: np.ndarray,
    no_phase: np.ndarray,
    t_s: float,
    may_open: bool,
) -> tuple[int, int, float, float]:
    """Outcome, row where lock changed first, mean in-phase, mean normalised square of Q.

    ``cov`` becomes P1 where P1 is finite.
    """
    channel, z, q, P0, nu, H, noise, m1, P1, V = room
    buffer, indicator, locked = memory
    inflated, V0, seen, rho, gate, row = watched
    n_phase, phase_start, gain = int(numbers[1]), int(numbers[2]), numbers[8]
    square = math.nan
    if inflated.size > 0:
        is_open = watch_innovations(
            V0, seen, channel, nu, rho, V, P0, q, inflated, H, noise, row, gate
        )
        if is_open and may_open:
            return GATE_OPEN, 0, square, square
    outcome = settle(buffer, sky, m1, P1, phase_start, no_phase, t_s)
    if outcome == NOT_FINITE:
        return outcome, 0, square, square
    for i in range(cov.shape[0]):
        for j in range(cov.shape[0]):
            cov[i, j] = P1[i, j]
    if outcome == ABSURD:
        return outcome, 0, square, square
    if n_phase:
        variance = np.empty(channel.size)
        innovation_variance(H, P0, noise, 1, 3, variance)
        square = normalised_square(nu, 1, 3, variance)
    changed, in_phase = follow(channel, z, 0, gain, indicator, locked)
    return FINE, changed, in_phase, square
