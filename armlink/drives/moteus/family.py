"""The moteus family, as the registry finds it."""

from armlink.drives.family import Family
from armlink.drives.moteus.drives import TRAITS, MoteusDrives
from armlink.drives.moteus.settings import MoteusSettings

FAMILY = Family("moteus", TRAITS, MoteusSettings, MoteusDrives, summary="mjbots moteus r4, c1, n1, x1, on CAN FD")
