"""Gravity torque at a single pose: the two passes of the kernel unrolled into straight-line Python for one arm.

A loop over joints spends most of its time on the loop. Unrolled, and without products by the zeros and ones of
right-angled twists, a seven-joint arm takes a few microseconds.
"""

from collections.abc import Callable
from math import cos, sin
from typing import Any

import numpy as np

from gcomp.arm.arm import Arm
from gcomp.arrays import Array

EXACT = 1e-15
"""Cosine or sine of a twist below which it counts as zero: the rounding of a right angle is below 1e-16."""


def exact_cosine_and_sine(alpha: float) -> tuple[float, float]:
    """(cos α, sin α), exact if α is a multiple of 90° up to rounding."""
    ca, sa = float(np.cos(alpha)), float(np.sin(alpha))
    if abs(ca) < EXACT:
        return 0.0, float(np.sign(sa))
    if abs(sa) < EXACT:
        return float(np.sign(ca)), 0.0
    return ca, sa


def compile_single_pose(arm: Arm, beta: Array) -> Callable[[Array], Array]:
    """A function from one pose q (n,) [rad] to the holding torque (n,) [N·m] for mass moments β (2n,) [kg·m]."""
    names = [f"q{i}" for i in range(arm.n)]
    lines = ["def torque(q):", f"    {', '.join(names)}, = q.tolist()", *_outwards(arm), *_inwards(arm, beta)]
    lines.append(f"    return array(({', '.join(f't{i}' for i in range(arm.n))},))")
    scope: dict[str, Any] = {"cos": cos, "sin": sin, "array": np.array, "nan": float("nan")}
    exec("\n".join(lines), scope)
    compiled: Callable[[Array], Array] = scope["torque"]
    return compiled


def _outwards(arm: Arm) -> list[str]:
    """Lines that compute cosine c, sine s and gravity (x, y) of every bar frame."""
    lines = []
    gx, gy, gz = (_number(component) for component in arm.gravity)
    for i, alpha in enumerate(arm.alpha):
        angle = f"q{i}" if arm.theta_offset[i] == 0 else f"q{i} + {_number(arm.theta_offset[i])}"
        ca, sa = exact_cosine_and_sine(alpha)
        lines += [
            f"    a = {angle}",
            f"    c{i} = cos(a); s{i} = sin(a)",
            f"    x{i} = {_sum((f'c{i}', gx), (f's{i}', gy))}",
            f"    y{i} = {_sum((f'c{i}', gy), (f'-s{i}', gx))}",
            f"    gy{i} = {_sum((_number(ca), f'y{i}'), (_number(sa), gz))}",
            f"    gz{i} = {_sum((_number(ca), gz), (_number(-sa), f'y{i}'))}",
        ]
        gx, gy, gz = f"x{i}", f"gy{i}", f"gz{i}"
    return lines


def _inwards(arm: Arm, beta: Array) -> list[str]:
    """Lines that compute composite mass moments (u, v, w) and the torques."""
    lines, last = [], arm.n - 1
    x, y, z = _number(beta[2 * last]), _number(beta[2 * last + 1]), "0.0"
    for i in range(last, -1, -1):
        lines.append(f"    t{i} = {_sum((f'x{i}', y), (f'-y{i}', x))}")
        if i == 0:
            break
        ca, sa = exact_cosine_and_sine(arm.alpha[i - 1])
        lines += [
            f"    b = {_sum((f's{i}', x), (f'c{i}', y))}",
            f"    u{i} = {_sum((f'c{i}', x), (f'-s{i}', y), ('1.0', _number(beta[2 * i - 2])))}",
            f"    v{i} = {_sum((_number(ca), 'b'), (_number(-sa), z), ('1.0', _number(beta[2 * i - 1])))}",
            f"    w{i} = {_sum((_number(sa), 'b'), (_number(ca), z))}",
        ]
        x, y, z = f"u{i}", f"v{i}", f"w{i}"
    return lines


def _number(value: float) -> str:
    return repr(float(value))


def _sum(*products: tuple[str, str]) -> str:
    """Source text of a sum of products, without products by zero and factors of one."""
    terms = []
    for pair in products:
        if any(factor in ("0.0", "-0.0") for factor in pair):
            continue
        sign = "-" if sum(factor.startswith("-") for factor in pair) == 1 else ""
        factors = [factor.removeprefix("-") for factor in pair if factor not in ("1.0", "-1.0")]
        terms.append(sign + (" * ".join(factors) or "1.0"))
    return (" + ".join(terms) or "0.0").replace("+ -", "- ")
