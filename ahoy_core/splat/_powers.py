"""Square root, power of two and logarithm, lane by lane."""

from __future__ import annotations

from typing import Any, Final

from llvmlite import ir

from ahoy_core.splat._jit import intrinsic
from ahoy_core.splat._vectors import LANES, call_llvm, suffix


@intrinsic
def sqrt(typingctx: Any, a: Any) -> Any:
    """Lane-wise square root."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call_llvm(builder, f"llvm.sqrt.{suffix(sig.return_type)}", args[0].type, list(args))

    return a(a), codegen


_LOG2_TERMS: Final = 12


@intrinsic
def log2(typingctx: Any, value: Any) -> Any:
    """Base-2 logarithm of float64 lanes that are positive normal numbers; other lanes give garbage.

    With the mantissa m in [sqrt(1/2), sqrt(2)) and s = (m - 1) / (m + 1): log2 m = 2 / ln 2 (s + s^3 / 3 + ...), of
    which twelve terms leave less than 1e-17.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = args[0].type
        integers = ir.VectorType(ir.IntType(64), LANES)

        def whole(number: int) -> Any:
            return ir.Constant(integers, [number] * LANES)

        def real(number: float) -> Any:
            return ir.Constant(kind, [number] * LANES)

        root_half = 0x3FE6A09E667F3BCD
        shifted = builder.sub(builder.bitcast(args[0], integers), whole(root_half))
        exponent = builder.ashr(shifted, whole(52))
        mantissa = builder.sub(builder.bitcast(args[0], integers), builder.shl(exponent, whole(52)))
        m = builder.bitcast(mantissa, kind)
        s = builder.fdiv(builder.fsub(m, real(1.0)), builder.fadd(m, real(1.0)))
        square = builder.fmul(s, s)
        total = real(1.0 / (2 * _LOG2_TERMS - 1))
        for k in range(_LOG2_TERMS - 2, -1, -1):
            total = call_llvm(
                builder, f"llvm.fmuladd.{suffix(sig.args[0])}", kind, [total, square, real(1 / (2 * k + 1))]
            )
        fraction = builder.fmul(builder.fmul(s, total), real(2 / 0.6931471805599453))
        return builder.fadd(builder.sitofp(exponent, kind), fraction)

    return value(value), codegen


_EXP2_TERMS: Final = {32: 6, 64: 13}
_EXP2_MAGIC: Final = {32: 1.5 * 2.0**23, 64: 1.5 * 2.0**52}
_EXP2_MINIMAX_32: Final = (0.00132764721, 0.0096755414, 0.0555071327, 0.240221197, 0.693146967, 1.00000007)


def _exp2_coefficients(bitwidth: int) -> list[float]:
    """Highest power first. float64 takes the Taylor series, whose 14th term is under 1e-17 on [-1/2, 1/2]."""
    if bitwidth == 32:
        return list(_EXP2_MINIMAX_32)
    coefficients, term = [], 1.0
    for k in range(_EXP2_TERMS[64] + 1):
        coefficients.append(term)
        term *= 0.6931471805599453 / (k + 1)
    return coefficients[::-1]


@intrinsic
def exp2(typingctx: Any, power: Any) -> Any:
    """2**power for powers whose result is a normal number; lanes outside give garbage and must be masked.

    The integer part goes into the exponent by the round-to-nearest trick of adding 1.5 * 2**mantissa bits, the rest
    through a polynomial (relative error 2e-7 in float32, where the minimax fit alone has 7.5e-8; 1e-15 in float64).
    """
    width = power.scalar.bitwidth

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = args[0].type
        integers = ir.VectorType(ir.IntType(width), LANES)

        def constant(value: float) -> Any:
            return ir.Constant(kind, [value] * LANES)

        magic = constant(_EXP2_MAGIC[width])
        shifted = builder.fadd(args[0], magic)
        rest = builder.fsub(args[0], builder.fsub(shifted, magic))
        terms = _exp2_coefficients(width)
        total = constant(terms[0])
        for term in terms[1:]:
            total = call_llvm(builder, f"llvm.fmuladd.{suffix(sig.args[0])}", kind, [total, rest, constant(term)])
        places = ir.Constant(integers, [23 if width == 32 else 52] * LANES)
        exponent = builder.shl(builder.bitcast(shifted, integers), places)
        return builder.bitcast(builder.add(builder.bitcast(total, integers), exponent), kind)

    return power(power), codegen
