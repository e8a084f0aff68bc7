"""Physically feasible inertials: masses above a bound, centres of mass inside a box, exactly these mass moments.

Mass moments are linear in x = (m_i, m_i s_i), and so are the bounds: nearest feasible inertials are a least-distance
problem, solved exactly by Lawson and Hanson's reduction to non-negative least squares (Solving Least Squares Problems,
chapter 23).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from gcomp.arrays import Array, as_array, frozen
from gcomp.errors import GcompError

LENGTH = 0.1
"""Shift of a centre of mass [m] that is weighted like a change of the mass by 100 %: a choice, the radius of a link."""

MomentMap = Callable[[Array, Array], Array]
"""(mass (n,), first_moment (n, 3)) → mass moments β (2n,), linear."""


class NotFeasible(GcompError):
    """No inertials within the bounds have these mass moments."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Allowed inertials: masses from `mass` (n,) [kg], centres of mass in boxes (n, 3) [m] in bar frames."""

    mass: Array
    com_lower: Array
    com_upper: Array

    def __post_init__(self) -> None:
        n = len(self.mass)
        frozen(self, mass=as_array("mass", self.mass, (n,)))
        for key in ("com_lower", "com_upper"):
            frozen(self, **{key: as_array(key, getattr(self, key), (n, 3), finite=False)})

    @classmethod
    def positive(cls, mass: Array) -> "Bounds":
        """Masses from these (n,) [kg] and centres of mass anywhere."""
        nowhere = np.full((len(mass), 3), np.inf)
        return cls(mass, -nowhere, nowhere)

    def rows(self) -> tuple[Array, Array]:
        """(C, d) with C x ≥ d for x = (m_1, m_1 s_1, m_2, …) (4n,)."""
        n, rows, limits = len(self.mass), [], []
        for i in range(n):
            unit = np.zeros(4 * n)
            unit[4 * i] = 1.0
            rows.append(unit)
            limits.append(self.mass[i])
            for axis in range(3):
                for sign, bound in ((1.0, self.com_lower[i, axis]), (-1.0, self.com_upper[i, axis])):
                    if np.isfinite(bound):
                        row = np.zeros(4 * n)
                        row[4 * i], row[4 * i + 1 + axis] = -sign * bound, sign
                        rows.append(row)
                        limits.append(0.0)
        return np.array(rows), np.array(limits)


@dataclass(frozen=True, eq=False)
class Inertials:
    """Masses (n,) [kg] and first moments (n, 3) [kg·m] in bar frames."""

    mass: Array
    first_moment: Array

    @property
    def com(self) -> Array:
        """Centres of mass (n, 3) [m] in bar frames."""
        return self.first_moment / self.mass[:, None]


def nearest_inertials(beta: Array, nominal: Inertials, bounds: Bounds, moments: MomentMap) -> Inertials:
    """The inertials nearest to the nominal ones that have mass moments β (2n,) [kg·m] exactly and keep the bounds.

    Nearest: least sum of squares of Δm_i/m_i and |Δ(m_i s_i)|/(m_i 0.1 m). A moment that is NaN in β stays free.
    Raises NotFeasible if the bounds leave none.
    """
    n, start = len(nominal.mass), _pack(nominal)
    unit = np.repeat(nominal.mass, 4) * np.tile([1.0, LENGTH, LENGTH, LENGTH], n)
    known = ~np.isnan(beta)
    linear = _matrix(n, moments)[known]
    left, values, right = np.linalg.svd(linear * unit)
    rank = int(np.sum(values > 1e-12 * values[0]))
    shift = right[:rank].T @ ((left.T @ (beta[known] - linear @ start))[:rank] / values[:rank])
    if not np.allclose(linear @ (start + unit * shift), beta[known], rtol=0, atol=1e-9):
        raise NotFeasible("mass moments that no inertials of this arm have")
    free = right[rank:].T
    rows, limits = bounds.rows()
    further = least_distance(rows * unit @ free, limits - rows @ (start + unit * shift))
    if further is None:
        raise NotFeasible("no masses above their bounds with centres of mass inside theirs have these mass moments")
    return _unpack(start + unit * (shift + free @ further))


def least_distance(rows: Array, limits: Array) -> Array | None:
    """The shortest u (p,) with rows (m, p) u ≥ limits (m,), None if there is none."""
    if np.all(limits <= 0):
        return np.zeros(rows.shape[1])
    scale = np.linalg.norm(np.column_stack([rows, limits]), axis=1)
    scale[scale == 0] = 1.0
    system = np.vstack([(rows / scale[:, None]).T, limits / scale])
    target = np.zeros(len(system))
    target[-1] = 1.0
    dual, left = nnls(system, target, maxiter=100 * system.shape[1])
    if left < 1e-9:
        return None
    residual = system @ dual - target
    shortest: Array = -residual[:-1] / residual[-1]
    return shortest


def _matrix(n: int, moments: MomentMap) -> Array:
    """The linear map (2n, 4n) from x = (m_1, m_1 s_1, …) to β."""
    columns = []
    for unit in np.eye(4 * n):
        inertials = _unpack(unit)
        columns.append(moments(inertials.mass, inertials.first_moment))
    return np.array(columns).T


def _pack(inertials: Inertials) -> Array:
    return np.column_stack([inertials.mass, inertials.first_moment]).ravel()


def _unpack(x: Array) -> Inertials:
    each = x.reshape(-1, 4)
    return Inertials(each[:, 0].copy(), each[:, 1:].copy())
