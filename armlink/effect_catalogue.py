"""Catalogue of effects: the ids, parameters and units of every imperfection that armlink simulates, fits or looks for.

The forms of an effect share these entries and nothing else: the forward form (`sim_bus.effects`) applies it to the
simulated arm, the inverse form (`sim_gap.effects`) finds it in a recording, the blind form (`sim_gap.blind.effects`)
draws it for sealed test cases, and `calib` tests sweeps and readings for some of them.
"""

from dataclasses import dataclass

JOINT = "joint"
"""Unit of a parameter whose value is a joint: its name in an arm file, its number from 1 in a diagnosis."""


@dataclass(frozen=True)
class Parameter:
    name: str
    unit: str
    components: tuple[str, ...] = ()
    """Names under which a diagnosis reports the components of a vector; empty for a scalar."""
    reported_as: str = ""
    """Name in a diagnosis, if it differs from the one in an arm file."""

    @property
    def reported(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each number that a diagnosis reports for this parameter."""
        unit = "joint number" if self.unit == JOINT else self.unit
        return tuple((name, unit) for name in self.components or (self.reported_as or self.name,))


@dataclass(frozen=True)
class CatalogueEntry:
    """One effect: its id (`family.name`), one line of description, and its parameters as in an arm file."""

    id: str
    description: str
    parameters: tuple[Parameter, ...]
    whole_arm: bool = False
    """Whether it belongs to the arm as a whole instead of to one joint or link."""
    estimated: tuple[Parameter, ...] = ()
    """Further parameters, which only a diagnosis reports."""

    @property
    def family(self) -> str:
        return self.id.partition(".")[0]

    @property
    def reported(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of every number that a diagnosis reports, in order."""
        return tuple(pair for each in (*self.parameters, *self.estimated) for pair in each.reported)


_ENTRIES = (
    CatalogueEntry("actuator.gain", "wrong torque constant: the motor's torque is scaled", (Parameter("gain", "1"),)),
    CatalogueEntry("actuator.rotor_inertia", "rotor inertia, reflected to the joint", (Parameter("inertia", "kg·m²"),)),
    CatalogueEntry("actuator.lag", "first-order lag from torque command to motor torque", (Parameter("time", "s"),)),
    CatalogueEntry("actuator.delay", "dead time from torque command to motor torque", (Parameter("time", "s"),)),
    CatalogueEntry("actuator.saturation", "motor torque clipped at a limit", (Parameter("limit", "N·m"),)),
    CatalogueEntry(
        "base.tilt",
        "base tilted relative to the model: gravity comes from another direction",
        (Parameter("angles", "rad", ("angle_1", "angle_2")),),
        whole_arm=True,
    ),
    CatalogueEntry(
        "friction.bearing",
        "friction of bearings and seals on the link side of the torque sensor",
        (Parameter("torque", "N·m"), Parameter("damping", "N·m·s/rad")),
    ),
    CatalogueEntry("friction.coulomb", "Coulomb friction, independent of speed", (Parameter("torque", "N·m"),)),
    CatalogueEntry("friction.viscous", "viscous friction, proportional to speed", (Parameter("damping", "N·m·s/rad"),)),
    CatalogueEntry(
        "friction.stribeck",
        "Stribeck effect: friction changes at low speed",
        (Parameter("breakaway", "N·m"), Parameter("velocity", "rad/s")),
    ),
    CatalogueEntry("friction.asymmetric", "friction that differs between directions", (Parameter("ratio", "1"),)),
    CatalogueEntry(
        "friction.load",
        "friction proportional to the transmitted torque",
        (Parameter("coefficient", "N·m/(N·m)"),),
    ),
    CatalogueEntry(
        "link.mass_moment",
        "first mass moment (mass or centre of mass) of a link differs from the model",
        (Parameter("moment", "kg·m", ("x", "y", "z")),),
    ),
    CatalogueEntry(
        "link.inertia",
        "inertia of a link differs from the model",
        (Parameter("inertia", "kg·m²", ("xx", "xy", "xz", "yy", "yz", "zz")),),
    ),
    CatalogueEntry(
        "link.payload",
        "payload at the tip that the model does not have",
        (Parameter("mass", "kg"), Parameter("com", "m", ("x", "y", "z"))),
        whole_arm=True,
    ),
    CatalogueEntry("position.offset", "constant error of the position sensor", (Parameter("offset", "rad"),)),
    CatalogueEntry("position.gain", "scale error of the position sensor", (Parameter("gain", "1"),)),
    CatalogueEntry(
        "position.eccentricity",
        "eccentric encoder disc: a position error with a period of one turn",
        (Parameter("amplitude", "rad"), Parameter("phase", "rad")),
    ),
    CatalogueEntry("timing.delay", "torque reading later than the position reading", (Parameter("delay", "s"),)),
    CatalogueEntry("torque.offset", "zero error of the torque sensor", (Parameter("offset", "N·m"),)),
    CatalogueEntry("torque.gain", "gain error of the torque sensor", (Parameter("gain", "1"),)),
    CatalogueEntry("torque.drift", "zero of the torque sensor drifts with time", (Parameter("rate", "N·m/s"),)),
    CatalogueEntry(
        "torque.crosstalk",
        "torque sensor also reads the torque of another joint",
        (Parameter("coefficient", "N·m/(N·m)"), Parameter("source", JOINT)),
    ),
    CatalogueEntry("torque.hysteresis", "hysteresis of the torque sensor", (Parameter("width", "N·m"),)),
    CatalogueEntry("torque.deadband", "dead band of the torque sensor", (Parameter("width", "N·m"),)),
    CatalogueEntry("torque.saturation", "torque reading clipped at a limit", (Parameter("limit", "N·m"),)),
    CatalogueEntry(
        "torque.nonlinearity",
        "gain of the torque sensor varies with the load",
        (Parameter("gain_change", "1"),),
    ),
    CatalogueEntry(
        "transmission.ripple",
        "torque ripple of the gear, periodic in position",
        (Parameter("amplitude", "N·m"), Parameter("cycles", "1/rad"), Parameter("phase", "rad")),
    ),
    CatalogueEntry(
        "transmission.spring",
        "spring at the joint, such as a cable bundle",
        (Parameter("stiffness", "N·m/rad"), Parameter("rest", "rad")),
    ),
    CatalogueEntry("transmission.elasticity", "elastic transmission", (Parameter("stiffness", "N·m/rad"),)),
    CatalogueEntry("transmission.backlash", "backlash of the transmission (full width)", (Parameter("width", "rad"),)),
    CatalogueEntry(
        "transmission.coupling",
        "motor also turns when another joint turns",
        (Parameter("coefficient", "1"), Parameter("source", JOINT, reported_as="other_joint")),
        estimated=(
            Parameter("inertia", "kg·m²"),
            Parameter("coulomb", "N·m"),
            Parameter("viscous", "N·m·s/rad"),
        ),
    ),
)
CATALOGUE = {entry.id: entry for entry in _ENTRIES}
