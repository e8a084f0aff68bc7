"""Ranges of Damiao models as the maker delivers them: PMAX [rad], VMAX [rad/s], TMAX [N·m] (registers 21 to 23).

They are taken only where the drive cannot be asked: to listen beside another host, until its registers are heard. A
start always reads the registers. Source: the maker's register defaults as in python-damiao-driver 1.0.6.
"""

from armlink.drives.mit_packing import Ranges

MODELS: dict[str, Ranges] = {
    "DM3507": Ranges(12.566, 50.0, 5.0),
    "DM4310": Ranges(12.5, 30.0, 10.0),
    "DM4310P": Ranges(12.5, 50.0, 10.0),
    "DM4340": Ranges(12.5, 10.0, 28.0),
    "DM4340P": Ranges(12.5, 10.0, 28.0),
    "DM6006": Ranges(12.5, 45.0, 20.0),
    "DM8006": Ranges(12.5, 45.0, 40.0),
    "DM8009": Ranges(12.5, 45.0, 54.0),
    "DM10010": Ranges(12.5, 20.0, 200.0),
    "DM6248P": Ranges(12.566, 20.0, 120.0),
}
"""By the name on the label."""


def delivered(model: str) -> Ranges | None:
    """Ranges that a model is delivered with; None for one that is not known, whatever the case of its letters."""
    return MODELS.get(model.upper())
