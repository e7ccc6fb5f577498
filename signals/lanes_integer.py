"""The integer engine's inner loop in 512-bit vectors; its twin is `sum_plain` of
`signals.correlator_integer`.

A vector is 32 samples as 16-bit words.  4 instructions take the carrier off; one window of the
code serves all taps of a *cluster*, which lie within a few entries: one comparison and one
selection find the indices of a delay, a permutation looks it up, two dot products add I and Q.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from signals import lanes as v

SPAN = 8192
"""Most samples in a cell"""

STRIDE = 256
"""Samples that share a coarse carrier phasor and an int32 sum"""

VECTOR = 32
"""Samples in a vector, and table entries in the window that it looks up"""

MOST = 6
"""Most taps of a cluster: their sums stay in registers"""

_FLOATS = 16
_I8 = ir.IntType(8)
_WORDS, _SUMS = ir.VectorType(v.I16, VECTOR), ir.VectorType(v.I32, _FLOATS)
_NEEDS = {"+avx512f", "+avx512bw", "+avx512dq", "+avx512vl", "+avx512vnni"}

binding.initialize_native_asmparser()  # for the one instruction that is written out below


def able() -> bool:
    """True where numba may use the instructions."""
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    return set(features.split(",")) >= _NEEDS


def _words(value: int) -> Any:
    return v.same(v.I16, value, VECTOR)


def _call(b: Any, name: str, *args: Any) -> Any:
    """Call of an LLVM function that gives words."""
    kind = ir.FunctionType(_WORDS, [a.type for a in args])
    return b.call(cgutils.get_or_insert_function(b.module, kind, name), args)


def _add_products(b: Any, total: Any, x: Any, y: Any) -> Any:
    """total (16 int32) plus the products of the words x and y, two neighbours each.

    Written out, as LLVM has changed the operands of its name for it, and splits a chain of them
    into twice as many instructions.
    """
    kind = ir.FunctionType(_SUMS, [_SUMS, _WORDS, _WORDS])
    return b.asm(kind, "vpdpwssd $3, $2, $0", "=v,0,v,v", [total, x, y], side_effect=False)


def _opaque(b: Any, value: Any) -> Any:
    """The same value, of which LLVM knows nothing."""
    kind = ir.FunctionType(value.type, [value.type])
    register = "=v,0" if value.type == _WORDS else "=r,0"
    return b.asm(kind, "", register, [value], side_effect=False)


def _emit_phasors(b: Any, first: Any, line: Sequence[Any], scale: Any) -> list[Any]:
    """Tables of cos and sin times ``scale`` in the middle of each stride from sample ``first``."""
    lanes, (base, step, bend, n) = _FLOATS, line
    tables = [v.emit_stack(b, v.F32, SPAN // STRIDE) for _ in range(2)]
    ints = ir.VectorType(v.I32, lanes)
    start = b.add(base, b.mul(step, first))
    start = b.add(start, b.ashr(b.mul(step, v.int64(STRIDE - 1)), v.int64(1)))
    start = v.emit_splat(b, start, lanes)
    rise = v.emit_splat(b, b.mul(step, v.int64(STRIDE)), lanes)
    last, begin = (v.emit_splat(b, b.sitofp(x, v.F32), lanes) for x in (n, first))
    for m in range(0, SPAN // STRIDE, lanes):
        phase = b.add(start, b.mul(rise, v.vector(v.I64, range(m, m + lanes))))
        phase = b.trunc(b.lshr(phase, v.same(v.I64, 16, lanes)), ints)
        middles = [STRIDE * (m + k + 0.5) - 0.5 for k in range(lanes)]
        j = b.fadd(begin, v.vector(v.F32, middles))
        bow = b.fmul(b.fmul(v.emit_splat(b, bend, lanes), j), b.fsub(last, j))
        phase = b.add(phase, b.fptosi(bow, ints))
        for value, table in zip(v.emit_cos_sin(b, phase), tables, strict=True):
            v.emit_store(b, b.fmul(value, v.emit_splat(b, scale, lanes)), table, v.int64(m))
    return tables


def _emit_lane_steps(b: Any, step: Any, delays: Sequence[Any]) -> tuple[list[Any], Any]:
    """For delays [2^-32 entries] with a common fraction: entries that each lane is ahead of the
    cluster's start, per delay, and the fraction of 2^16 from which on it is one more."""
    lanes, bits = v.vector(v.I32, range(VECTOR)), v.same(v.I32, 16, VECTOR)
    low_bits = v.same(v.I32, 0xFFFF, VECTOR)
    step = v.emit_splat(b, b.trunc(step, v.I32), VECTOR)
    delay = v.emit_splat(b, b.trunc(delays[0], v.I32), VECTOR)
    low = b.add(b.mul(lanes, b.and_(step, low_bits)), b.and_(delay, low_bits))
    ahead = b.add(b.mul(lanes, b.lshr(step, bits)), b.lshr(delay, bits))
    ahead = b.add(ahead, b.lshr(low, bits))
    whole = b.trunc(b.lshr(ahead, bits), _WORDS)
    threshold = b.xor(b.trunc(ahead, _WORDS), _words(-1))
    entries = [b.trunc(b.lshr(d, v.int64(32)), v.I16) for d in delays]
    wholes = [b.add(whole, v.emit_splat(b, e, VECTOR)) for e in entries]
    # a choice of two registers is one instruction; whole + carry would be two
    return [(w, _opaque(b, b.add(w, _words(1)))) for w in wholes], threshold


class _Cluster:
    """Taps that are looked up in one window: what stays the same over the samples."""

    def __init__(self, b: Any, code: Any, start: Any, step: Any, groups: Any) -> None:
        origin, self.phase = start
        self.code = b.gep(code, [origin])
        self.jump = b.mul(step, v.int64(VECTOR))
        self.size = sum(len(g) for g in groups)
        self.groups = [_emit_lane_steps(b, step, g) for g in groups]

    def add(self, b: Any, phase: Any, pair: Sequence[Any], sums: Sequence[Any]) -> list[Any]:
        """The sums, I and Q of each tap, and a vector of samples."""
        part = v.emit_splat(b, b.trunc(b.lshr(phase, v.int64(16)), v.I16), VECTOR)
        window = v.emit_load(b, self.code, b.lshr(phase, v.int64(32)), VECTOR, v.I16)
        chips = []
        for wholes, threshold in self.groups:
            more = b.icmp_unsigned(">=", part, threshold)
            for whole, next_ in wholes:
                index = b.select(more, next_, whole)
                chips.append(_call(b, "llvm.x86.avx512.permvar.hi.512", window, index))
        twice = [chip for chip in chips for _ in pair]
        return [
            _add_products(b, s, chip, word)
            for s, chip, word in zip(sums, twice, [*pair] * len(chips), strict=True)
        ]


def _emit_wipe(b: Any, source: Any, tables: Sequence[Any], at: Any, k: Any, left: Any) -> list[Any]:
    """Words I and Q of samples at + k ... without the fine carrier; zero from ``left`` on."""
    table, bias = tables
    x = v.emit_load(b, source, b.shl(b.add(at, k), v.int64(1)), 2 * VECTOR, _I8)
    words = []
    for row in range(2):
        here = b.add(k, v.int64(row * STRIDE))
        turn = v.emit_load(b, table, b.shl(here, v.int64(1)), 2 * VECTOR, _I8)
        word = _call(b, "llvm.x86.avx512.pmaddubs.w.512", x, turn)
        word = b.sub(word, v.emit_load(b, bias, here, VECTOR, v.I16))
        if left is not None:
            keep = v.emit_splat(b, b.trunc(b.sub(left, k), v.I16), VECTOR)
            keep = b.icmp_signed("<", v.vector(v.I16, range(VECTOR)), keep)
            word = b.select(keep, word, _words(0))
        words.append(word)
    return words


def _emit_turn(b: Any, words: Sequence[Any], turn: Sequence[Any], sums: Sequence[Any]) -> list[Any]:
    """The float sums and a stride's int32 sums, I and Q of each tap, turned back."""
    (c, s), out = turn, []
    for k in range(0, len(words), 2):
        i, q = (b.sitofp(w, ir.VectorType(v.F32, _FLOATS)) for w in words[k : k + 2])
        out.append(v.emit_fma(b, i, c, v.emit_fma(b, q, s, sums[k])))
        out.append(v.emit_fma(b, q, c, v.emit_fma(b, b.fneg(i), s, sums[k + 1])))
    return out


def _emit_sums(b: Any, vectors: Sequence[Any]) -> list[Any]:
    """Sum over the lanes of each float vector: sixteen at a time, by halves, side by side."""
    out = []
    for first in range(0, len(vectors), _FLOATS):
        some = list(vectors[first : first + _FLOATS])
        count, half = len(some), _FLOATS // 2
        while half:
            some += some[-1:] * (len(some) % 2)
            starts = range(0, 2 * _FLOATS, 2 * half)
            low, high = (
                v.vector(v.I32, [j for k in starts for j in range(k + side, k + side + half)])
                for side in (0, half)
            )
            some = [
                b.fadd(b.shuffle_vector(x, y, low), b.shuffle_vector(x, y, high))
                for x, y in zip(some[::2], some[1::2], strict=True)
            ]
            half //= 2
        out += [b.extract_element(some[0], v.int32(k)) for k in range(count)]
    return out


def _lots(clusters: Sequence[_Cluster]) -> list[list[int]]:
    """Numbers of the clusters that are summed in one pass over a stride."""
    lots: list[list[int]] = [[]]
    for k, cluster in enumerate(clusters):
        if lots[-1] and sum(clusters[j].size for j in lots[-1]) + cluster.size > MOST:
            lots.append([])
        lots[-1].append(k)
    return lots


def _emit_segment(
    b: Any, source: Any, tables: Sequence[Any], turns: Sequence[Any], n: Any,
    clusters: Sequence[_Cluster],
) -> list[Any]:  # fmt: skip
    """Float vectors, I and Q of each tap, of n samples."""
    lots = _lots(clusters)
    count = len(clusters)
    plane = v.emit_stack(b, v.I16, 2 * STRIDE) if len(lots) > 1 else None

    def stride(m: Any, left: Any, state: Sequence[Any]) -> list[Any]:
        at = b.mul(m, v.int64(STRIDE))
        turn = [v.emit_splat(b, b.load(b.gep(t, [m])), _FLOATS) for t in turns]
        vectors = v.int64(STRIDE // VECTOR)
        if left is not None:
            vectors = b.sdiv(b.add(left, v.int64(VECTOR - 1)), v.int64(VECTOR))
        phases: list[Any] = []
        sums: list[Any] = []
        for number, lot in enumerate(lots):
            taps = sum(clusters[j].size for j in lot)

            def some(k: Any, *state: Any, number: int = number, lot: Any = lot) -> list[Any]:
                k = b.mul(k, v.int64(VECTOR))
                rows = [b.add(k, v.int64(row * STRIDE)) for row in range(2)]
                if number:
                    pair = [v.emit_load(b, plane, row, VECTOR, v.I16) for row in rows]
                else:
                    pair = _emit_wipe(b, source, tables, at, k, left)
                    if plane is not None:
                        for word, row in zip(pair, rows, strict=True):
                            v.emit_store(b, word, plane, row)
                phases, words = state[: len(lot)], state[len(lot) :]
                done: list[Any] = []
                for j, phase in zip(lot, phases, strict=True):
                    size = 2 * clusters[j].size
                    done += clusters[j].add(b, phase, pair, words[len(done) : len(done) + size])
                jumps = [clusters[j].jump for j in lot]
                return [*(b.add(p, q) for p, q in zip(phases, jumps, strict=True)), *done]

            # a loop of unknown length is not unrolled: unrolled, its registers do not suffice
            start = [state[j] for j in lot] + [v.same(v.I32, 0, _FLOATS)] * (2 * taps)
            after = v.emit_loop(b, _opaque(b, vectors), start, some)
            phases += after[: len(lot)]
            first = count + len(sums)
            sums += _emit_turn(b, after[len(lot) :], turn, state[first : first + 2 * taps])
        return [*phases, *sums]

    full = b.sdiv(n, v.int64(STRIDE))
    taps = sum(cluster.size for cluster in clusters)
    state = [cluster.phase for cluster in clusters] + [v.same(v.F32, 0.0, _FLOATS)] * (2 * taps)
    state = v.emit_loop(b, full, state, lambda m, *now: stride(m, None, now))
    left = b.sub(n, b.mul(full, v.int64(STRIDE)))
    some = b.zext(b.icmp_signed(">", left, v.int64(0)), v.I64)
    state = v.emit_loop(b, some, state, lambda _, *now: stride(full, left, now))
    return state[count:]


@intrinsic
def sum_32(
    typingctx: Any, samples: Any, first: Any, n: Any, line: Any, scale: Any, row: Any, table: Any,
    bias: Any, code: Any, step: Any, starts: Any, ahead: Any, channel: Any, cluster: Any,
    shape: Any, sums: Any, words: Any,
) -> Any:  # fmt: skip
    """`sum_plain`; the types in ``shape`` tell clusters, groups and taps."""
    signature = types.void(
        samples, types.int64, types.int64, line, types.float32, types.int64, table, bias, code,
        types.int64, starts, ahead, types.int64, cluster, shape, sums, words,
    )  # fmt: skip
    sizes = [[len(group) for group in groups] for groups in shape]
    taps = sum(map(sum, sizes))

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        source, fine, biases, codes, start, delay, result = (
            v.data_pointer(context, b, signature.args[k], args[k]) for k in (0, 6, 7, 8, 10, 11, 15)
        )
        first, n, row, step = args[1], args[2], args[5], args[9]
        source = b.gep(source, [b.shl(first, v.int64(1))])
        fine = b.gep(fine, [b.mul(row, v.int64(4 * STRIDE))])
        biases = b.gep(biases, [b.mul(row, v.int64(2 * STRIDE))])
        delay = b.gep(delay, [b.mul(args[12], v.int64(taps))])
        turns = _emit_phasors(b, first, [b.extract_value(args[3], k) for k in range(4)], args[4])
        ahead = iter([b.load(b.gep(delay, [v.int64(k)])) for k in range(taps)])
        made = []
        for k, groups in enumerate(sizes):
            begin = [b.load(b.gep(start, [v.int64(j)])) for j in (2 * k, 2 * k + 1)]
            made.append(
                _Cluster(b, codes, begin, step, [[next(ahead) for _ in range(g)] for g in groups])
            )
        sums = _emit_segment(b, source, (fine, biases), turns, n, made)
        for k, total in enumerate(_emit_sums(b, sums)):
            b.store(b.fpext(total, ir.DoubleType()), b.gep(result, [v.int64(k)]))
        return context.get_dummy_value()

    return signature, codegen
