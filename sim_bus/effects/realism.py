"""A realistic arm: all small troubles of a real one at once, each drawn at its published level (`sim.realism`).

`LEVELS` are the levels at `level` 1, what good arms have after calibration; each grows in proportion to `level`, and
3 is what bad ones have. Encoder, clock and noise stay as the arm file has them.
"""

import numpy as np

from armlink.arrays import Array
from sim_bus.effects.state import Imperfections

LEVELS = {
    # encoder disc of 65 mm off centre by 10 µm: 412.5 e/D arc seconds (Celera Motion, on scale eccentricity) [rad]
    "eccentricity": 3e-4,
    # 0.083 % (arXiv 2603.16040) to 0.5 % of full scale (strain gauges) [of full scale, at full scale]
    "cubic": 1e-3,
    # torque sensors of accuracy class 0.05 (VDI/VDE 2646) [of rated torque]
    "hysteresis": 5e-4,
    # 0.79 % of a bending moment without cross-roller bearings (SSRN 10.2139/ssrn.4216744), 0.2 % with
    "crosstalk": 2.5e-3,
    # zero of class 0.05 per 10 K (VDI/VDE 2646), a joint that warms by 20 K in an hour [of rated torque]
    "warm_up": 1e-3,
    # Lin et al. 2019, gravity compensation of the dVRK's master arms: cables pull by per cents of gravity there [of
    # rated torque per rad]
    "cable": 1e-3,
    # the same: half of a cable's pull depends on where it comes from [of rated torque]
    "cable_lag": 5e-4,
    # 1 mrad of a gear of 3 to 6·10⁴ N·m/rad (Harmonic Drive CSG-25), encoder behind it [rad at rated torque]
    "sag": 3e-4,
    # Nubiola and Bonev 2013: an uncalibrated ABB IRB 1600 is off by 1 mm (mean) to 2.2 mm at the tool [rad]
    "axis": 1e-3,
    # the same [m]
    "length": 1e-3,
    # a base set up by spirit level, 0.1° [rad]
    "tilt": 2e-3,
    # Bittencourt and Gunnarsson 2012, static friction in a robot joint: joint angle [of Coulomb friction]
    "friction_position": 0.1,
    # the same: load torque
    "friction_load": 5e-3,
    # the same: 30 to 80 °C [of Coulomb friction]
    "friction_warm_up": 0.3,
}
"""Size of each trouble at level 1, with its source and unit."""
SMALLEST, LARGEST = 0.5, 1.5
"""Range of a drawn size, as a share of its level."""
COLD = 1200.0
"""Mean time constant of warming up [s]."""
BEND = 0.5
"""Mean turn of a cable's bend per turn of the neighbouring joint."""


def add_realism(state: Imperfections, rated: Array, level: float, seed: int) -> None:
    """Add all troubles at a level to `state`, drawn from `seed`; rated torques (n,) [N·m]."""
    if level == 0:
        return
    n, random = len(rated), np.random.default_rng([seed, 41])

    def drawn(name: str, shape: int | tuple[int, ...] = n) -> Array:
        size = level * LEVELS[name] * random.uniform(SMALLEST, LARGEST, shape)
        signed: Array = size * random.choice([-1.0, 1.0], shape)
        return signed

    turn = 2 * np.pi
    own = np.column_stack([np.abs(drawn("eccentricity")), random.uniform(0, turn, n)])
    state.eccentricity[:] = np.where(state.eccentricity[:, :1] > 0, state.eccentricity, own)
    state.cubic += drawn("cubic")
    state.hysteresis += np.abs(drawn("hysteresis")) * rated
    for joint in range(n):
        for neighbour in {joint - 1, joint + 1} & set(range(n)):
            state.crosstalk[joint, neighbour] += drawn("crosstalk", 1)[0]
    state.warm_up[:] = np.column_stack([drawn("warm_up") * rated, COLD * random.uniform(SMALLEST, LARGEST, n)])
    state.cable[:] = np.column_stack(
        [
            np.abs(drawn("cable")) * rated,
            BEND * random.uniform(-LARGEST, LARGEST, n),
            random.uniform(-0.3, 0.3, n),
            np.abs(drawn("cable_lag")) * rated,
            random.uniform(0.1, 0.4, n),
        ]
    )
    state.compliance += np.abs(drawn("sag")) / rated
    state.frame_turn += random.uniform(-1, 1, (n, 3)) * level * LEVELS["axis"]
    state.frame_shift += random.uniform(-1, 1, (n, 3)) * level * LEVELS["length"]
    state.tilt += random.uniform(-1, 1, 2) * level * LEVELS["tilt"]
    state.uneven[:] = np.column_stack(
        [
            np.minimum(np.abs(drawn("friction_position")), 0.9),
            random.uniform(0, turn, n),
            np.abs(drawn("friction_load")),
            np.abs(drawn("friction_warm_up")),
        ]
    )
