"""The moteus family, as the registry finds it."""

from armlink.drives.family import Family
from armlink.drives.moteus.drives import TRAITS, MoteusDrives, MoteusSettings

FAMILY = Family("moteus", TRAITS, MoteusSettings, MoteusDrives, summary="mjbots moteus r4, c1, n1, x1, on CAN FD")
